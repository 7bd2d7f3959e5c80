"""The methods that leave a random share of the Gaussians out of renders of a training.

DropGaussian (Park et al., CVPR 2025):

    opacity <- scale opacity,   scale = 0 with probability p, else 1 / (1 - p)
    p = p_max t / T                                                             at step t of T

so that the expectation of every opacity stays what it was; p_max = 0.2 in the paper and its code
(DCVL-3D/DropGaussian_release, gaussian_renderer).  The step's image, its loss and the screen-space gradient of density control
are all of the opacities after this; evaluation keeps every Gaussian.

DropoutGS (Xu et al., CVPR 2025), its random dropout regularisation: the image without some Gaussians agrees with that of all.

    L = L_recon(I) + weight l(I, I_drop)
    I_drop   the sampled view rendered without a random share `p` of the Gaussians; the others keep their opacity
    l        the loss of training, between the two images, differentiated in both; the pixel loss has the weight 1 - lambda even
             where it has 1 against the photograph (`loss.literal`), as published

p and weight are constant from the first step; 0.4 and 0.2 are those of the published code for LLFF with 3 views
(xuyx55/DropoutGS, scripts/train_llff.sh).  The step's render, and with it density control, sees every Gaussian.  Two more
renders a step.

Not here: edge-guided splitting, their second part, which is density control; the depth losses and neural colours of DNGaussian,
on which the published code is built.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from splat.model.typed import Positive
from splat.render.loss_and_gradient import LossAndGradient
from splat.training.methods.agreement import agreement
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


@dataclass(frozen=True)
class DropoutGS(MethodSettings):
    """p: share of the Gaussians that is left out; weight: of the agreement."""

    name: Literal["dropoutgs"] = "dropoutgs"
    p: Annotated[float, Meta(gt=0, lt=1)] = 0.4
    weight: Positive = 0.2

    def create(self, seed: int) -> Method:
        return DropoutGSMethod(self, seed)


class DropoutGSMethod(Method[DropoutGS]):
    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        keep = dropout(len(step.gaussians), self.settings.p, step.gaussians.flat.dtype, self.generator)
        fields, scales = (step.gaussians, step.gaussians), (None, keep)
        loss = replace(step.config.loss, literal=False)
        found = agreement(step, fields, step.camera, scales, self.settings.weight, loss)
        if found is None:
            return base
        return replace(base, gradient=base.gradient + (found.gradient(0) + found.gradient(1)))
