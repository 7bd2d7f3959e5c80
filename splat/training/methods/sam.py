"""SAM, sharpness-aware minimisation (Foret et al. 2021): the gradient at the worst place near by, for any model alike.

    L_SAM(Theta) = max_{|eps| <= rho} L(Theta + eps)                                    Foret's Eq. (1), p = 2
    eps = rho D (D g) / |D g|,   g the gradient of L at Theta                           Eq. (2), where D = 1
    Theta descends the gradient of L at Theta + eps, with eps constant                  Eq. (3)

L is the loss of the step's sampled view; the copy costs one more render with its backward pass.  Where g is 0, so is eps.

The ball mixes units: a world unit, an e-fold in size and a logit count alike.  metric says in which units eps is measured:

    parameters   the stored ones, D = 1, and |eps| <= rho: the method as published, which knows nothing of splats
    rates        each parameter in steps of the optimiser, D its learning rate, and rms(eps / D) <= rho: rho = 1 is as far
                 as one full step of Adam, whatever the number of Gaussians
"""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.model.typed import Positive
from splat.render.loss_and_gradient import LossAndGradient
from splat.training.state import Method, MethodSettings, Step


@dataclass(frozen=True)
class SAM(MethodSettings):
    """rho: radius of the ball in the metric's units; 0.05 is Foret's default (their Sec. 3.1) and goes with "parameters"."""

    name: Literal["sam"] = "sam"
    rho: Positive = 0.05
    metric: Literal["parameters", "rates"] = "parameters"

    def create(self, seed: int) -> Method:
        return SAMMethod(self, seed)


class SAMMethod(Method[SAM]):
    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        if self.settings.metric == "parameters":
            eps = ascent(base.gradient, torch.ones_like(base.gradient), self.settings.rho)
        else:
            rates = step.training.rates(step.number)
            eps = ascent(base.gradient, rates, self.settings.rho * sqrt(rates.numel()))
        worst = step.gaussians.with_flat(step.gaussians.flat + eps)
        return replace(base, gradient=step.loss_and_gradient(worst).gradient)


def ascent(gradient: Float[Tensor, " p"], units: Float[Tensor, " p"], length: float) -> Float[Tensor, " p"]:
    """The step of this length, measured in the units, along which the loss rises most; 0 where the gradient is.

    >>> ascent(torch.tensor([3.0, 4.0]), torch.tensor([1.0, 1.0]), 10.0).round(decimals=5).tolist()
    [6.0, 8.0]
    """
    scaled = units * gradient
    norm = scaled.norm()
    return length / norm * units * scaled if norm > 0 else torch.zeros_like(gradient)
