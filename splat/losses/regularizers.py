"""Regularisers of opacities and scales, which trainers that move Gaussians to where they are needed add to every step's loss.

    R(theta) = opacity_reg mean_i sigmoid(x_i) + scale_reg mean_ia exp(s_ia)      x: opacity logits; s: log-scales

as 3DGS-MCMC (Kheradmand et al., NeurIPS 2024), gsplat's `simple_trainer` and splatfacto have them; the means are over all N
Gaussians and, of scales, over their three axes.  R is linear in opacities and scales, and so has no Gauss-Newton part; the
Hessian is diagonal.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians


class Regularizers:
    """R of some of N Gaussians, linearised: their share of its value, and derivatives that are added to those of a loss.

    count: N.  second: the diagonal of R'', (n, ...) by attribute; none where R is 0.

    >>> found = Regularizers(Gaussians(torch.zeros(2 * 14), 0), LossSettings(opacity_reg=0.01, scale_reg=0.02), count=4)
    >>> round(found.value, 6), round(float(found.second["log_scales"][0, 0]), 6)
    (0.0125, 0.001667)
    """

    def __init__(self, gaussians: Gaussians, settings: LossSettings, count: int):
        self.value, self._rows = 0.0, gaussians.blocks
        first: dict[str, Tensor] = {}
        second: dict[str, Tensor] = {}
        if settings.opacity_reg:
            opacity, weight = gaussians.opacity_logits.detach().sigmoid(), settings.opacity_reg / count
            self.value += weight * float(opacity.sum(dtype=torch.float64))
            first["opacity_logits"] = weight * opacity * (1 - opacity)
            second["opacity_logits"] = first["opacity_logits"] * (1 - 2 * opacity)
        if settings.scale_reg:
            first["log_scales"] = settings.scale_reg / (3 * count) * gaussians.log_scales.detach().exp()
            self.value += float(first["log_scales"].sum(dtype=torch.float64))
            second["log_scales"] = first["log_scales"]
        self._first, self.second = first, second

    def add_gradient(self, gradient: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        """The gradient of a loss with that of R added to it, in its place."""
        return self._added(gradient, self._first)

    def add_product(self, product: Float[Tensor, "p k"], V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """H V of a loss with R'' V added to it, in its place."""
        return self._added(
            product, {name: part.reshape(-1, 1) * V[self._rows[name]] for name, part in self.second.items()}
        )

    def affects(self, V: Float[Tensor, "p k"]) -> bool:
        """Whether R'' V can be other than 0."""
        return any(bool(V[self._rows[name]].any()) for name in self.second)

    def _added(self, whole: Tensor, parts: Mapping[str, Tensor]) -> Tensor:
        for name, part in parts.items():
            whole[self._rows[name]] += part.reshape(whole[self._rows[name]].shape)
        return whole
