"""Random dropout regularisation of DropoutGS (Xu et al., CVPR 2025): the image without some Gaussians agrees with that of all.

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

from msgspec import Meta

from splat.model.typed import Positive
from splat.render.loss_and_gradient import LossAndGradient
from splat.training.methods.agreement import agreement
from splat.training.methods.dropout.dropgaussian import dropout
from splat.training.state import Method, MethodSettings, Step


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
