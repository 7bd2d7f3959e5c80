"""Adam (Kingma and Ba 2015, Algorithm 1) over one flat vector, with a learning rate per parameter.

    m <- beta1 m + (1 - beta1) g          first moment
    v <- beta2 v + (1 - beta2) g^2        second moment
    x <- x - rate m_hat / (sqrt(v_hat) + eps),   m_hat = m / (1 - beta1^t),   v_hat = v / (1 - beta2^t)

Entries do not see each other, so one Adam over the flat vector of `Gaussians` with a rate per attribute is exactly one
Adam per attribute.
"""

from dataclasses import dataclass
from math import sqrt

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splat.backend.device import by_triton
from splat.model.gaussians import Gaussians

BETA1, BETA2 = 0.9, 0.999
EPS = 1e-15  # 3DGS: far below the moments of a loss that is a mean over 10^5 pixels


@dataclass(eq=False)
class Adam:
    """The moments, laid out like the Gaussians that they belong to, and the number of updates so far."""

    first: Gaussians
    second: Gaussians
    updates: int = 0

    @classmethod
    def zero(cls, gaussians: Gaussians) -> "Adam":
        """No updates yet."""
        flat = gaussians.flat.detach()
        return cls(gaussians.with_flat(torch.zeros_like(flat)), gaussians.with_flat(torch.zeros_like(flat)))

    @torch.no_grad()
    def update(
        self, parameters: Float[Tensor, " p"], gradient: Float[Tensor, " p"], rates: Float[Tensor, " p"]
    ) -> None:
        """One step of the parameters, in place."""
        self.updates += 1
        m, v = self.first.flat, self.second.flat
        grid = 1024 * torch.finfo(m.dtype).tiny / torch.finfo(m.dtype).eps
        root, scale = sqrt(1 - BETA2**self.updates), 1 / (1 - BETA1**self.updates)
        if by_triton(parameters):
            from splat.training.optim.adam_cuda import update

            update(parameters, gradient, rates, m, v, root, scale, (BETA1, BETA2, EPS, grid))
            return
        m.lerp_(gradient, 1 - BETA1)
        m.add_(grid).sub_(grid)  # no subnormal numbers, to which unseen Gaussians' m would decay: they are 20x slower
        v.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
        denominator = v.sqrt().div_(root).add_(EPS)
        step = torch.div(m, denominator, out=denominator).mul_(rates)
        parameters.sub_(step, alpha=scale)

    def select(
        self, index: Int[Tensor, " n"], fresh: Bool[Tensor, " n"] | None = None, sh_degree: int | None = None
    ) -> None:
        """Follow a change of the Gaussians: `Gaussians.select(index, sh_degree)`, with zero moments where fresh."""
        self.first, self.second = (moment.select(index, sh_degree, fresh) for moment in (self.first, self.second))

    def forget(self, attribute: str) -> None:
        """Zero the moments of one attribute, whose values were overwritten."""
        for moment in (self.first, self.second):
            moment.attributes[attribute].zero_()
