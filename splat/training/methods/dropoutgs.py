"""Random dropout regularisation of DropoutGS (Xu et al., CVPR 2025): the image with Gaussians left out agrees with that of all.

    L = L_recon(I) + weight l(I, I_drop)
    I_drop   the sampled view rendered without a random share `p` of the Gaussians; the others keep their opacity
    l        the loss of training, between the two images, differentiated in both

p and weight are constant from the first step; 0.4 and 0.2 are what the published code uses for LLFF with 3 views.  The
step's own render, and with it density control, sees every Gaussian.  Two more renders a step.

Their second part, splitting large Gaussians at image edges (edge-guided splitting), is density control and is not here.
"""

from dataclasses import dataclass
from math import inf
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.autograd import consistency_loss
from splat.render.loss_and_gradient import LossAndGradient
from splat.render.render import render
from splat.training.methods.dropgaussian import dropout
from splat.training.state import Method, Regularizer, Step


@dataclass(frozen=True)
class DropoutGS(Method):
    """p: share of the Gaussians that is left out; weight: of the agreement."""

    name: Literal["dropoutgs"] = "dropoutgs"
    p: float = 0.4
    weight: float = 0.2

    def __post_init__(self) -> None:
        if not (0 < self.p < 1 and 0 < self.weight < inf):
            raise ValueError(
                f"expected p above 0 and below 1 and a finite weight above 0, got {self.p} and {self.weight}; "
                "for 0 use the method 3dgs"
            )

    def regularizer(self, seed: int) -> "DropoutRegularizer":
        return DropoutRegularizer(self, seed)


class DropoutRegularizer(Regularizer):
    """Holds nothing between steps but the generator."""

    def __init__(self, settings: DropoutGS, seed: int):
        super().__init__(seed)
        self.settings = settings

    def gradient(self, step: Step, base: LossAndGradient) -> Float[Tensor, " p"]:
        flat = step.gaussians.flat.detach().requires_grad_()
        keep = dropout(len(step.gaussians), self.settings.p, flat.dtype, self.generator)
        whole, dropped = (
            render(
                step.gaussians.with_flat(flat), step.camera, step.background, step.config.render, opacity_scale=gain
            ).image
            for gain in (None, keep)
        )
        loss = self.settings.weight * consistency_loss(whole, dropped, step.config.loss)
        return base.gradient + torch.autograd.grad(loss, flat)[0]
