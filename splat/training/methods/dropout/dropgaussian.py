"""DropGaussian (Park et al., CVPR 2025): each training render leaves out a random share of the Gaussians.

    opacity <- scale opacity,   scale = 0 with probability p, else 1 / (1 - p)
    p = p_max t / T                                                             at step t of T

so that the expectation of every opacity stays what it was; p_max = 0.2 in the paper and its code
(DCVL-3D/DropGaussian_release, gaussian_renderer).  The step's image, its loss and the screen-space gradient of density control
are all of the opacities after this; evaluation keeps every Gaussian.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from splat.training.state import Method, MethodSettings, Step


@dataclass(frozen=True)
class DropGaussian(MethodSettings):
    """p_max: the share of the Gaussians that is left out at the last step."""

    name: Literal["dropgaussian"] = "dropgaussian"
    p_max: Annotated[float, Meta(gt=0, lt=1)] = 0.2

    def create(self, seed: int) -> Method:
        return DropGaussianMethod(self, seed)


class DropGaussianMethod(Method[DropGaussian]):
    def opacity_scale(self, step: Step) -> Float[Tensor, " n"]:
        return rising_dropout(step, self.settings.p_max, self.generator)


def rising_dropout(step: Step, p_max: float, generator: torch.Generator) -> Float[Tensor, " n"]:
    """The scales of the opacities at a step, as above."""
    p = p_max * step.number / step.config.iterations
    return dropout(len(step.gaussians), p, step.gaussians.flat.dtype, generator) / (1 - p)


def dropout(n: int, p: float, dtype: torch.dtype, generator: torch.Generator) -> Float[Tensor, " n"]:
    """0 with probability p for each Gaussian alone, else 1."""
    return (torch.rand(n, generator=generator, dtype=torch.float64) >= p).to(dtype)
