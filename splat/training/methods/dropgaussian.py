"""DropGaussian (Park et al., CVPR 2025): each training render leaves out a random share of the Gaussians.

    opacity <- gain opacity,   gain = 0 with probability p, else 1 / (1 - p)
    p = p_max t / T                                                             at step t of T

so that the expectation of every opacity stays what it was; p_max = 0.2 in the paper and its code.  The step's image, its
loss and the screen-space gradient of density control are all of the opacities after this; evaluation keeps every Gaussian.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.training.state import Method, Regularizer, Step


@dataclass(frozen=True)
class DropGaussian(Method):
    """p_max: the share of the Gaussians that is left out at the last step, above 0 and below 1."""

    name: Literal["dropgaussian"] = "dropgaussian"
    p_max: float = 0.2

    def __post_init__(self) -> None:
        if not 0 < self.p_max < 1:
            raise ValueError(f"expected p_max above 0 and below 1, got {self.p_max}; for 0 use the method 3dgs")

    def regularizer(self, seed: int) -> "DropRegularizer":
        return DropRegularizer(self, seed)


class DropRegularizer(Regularizer):
    """Holds nothing between steps but the generator."""

    def __init__(self, settings: DropGaussian, seed: int):
        super().__init__(seed)
        self.settings = settings

    def opacity_scale(self, step: Step) -> Float[Tensor, " n"]:
        p = self.settings.p_max * step.number / step.config.iterations
        return dropout(len(step.gaussians), p, step.gaussians.flat.dtype, self.generator) / (1 - p)


def dropout(n: int, p: float, dtype: torch.dtype, generator: torch.Generator) -> Float[Tensor, " n"]:
    """0 with probability p for each Gaussian alone, else 1."""
    return (torch.rand(n, generator=generator, dtype=torch.float64) >= p).to(dtype)
