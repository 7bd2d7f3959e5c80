"""Adam over one flat vector, with a learning rate per parameter; its step: `backend/cpu/adam.py`.

Entries do not see each other, so one Adam over the flat vector of `Gaussians` with a rate per attribute is exactly one
Adam per attribute.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splat.model.gaussians import Gaussians
from splat.render.backend import backend_of


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
        backend_of(parameters).adam(parameters, gradient, rates, self.first.flat, self.second.flat, self.updates)

    def select(
        self, index: Int[Tensor, " n"], fresh: Bool[Tensor, " n"] | None = None, sh_degree: int | None = None
    ) -> None:
        """Follow a change of the Gaussians: `Gaussians.select(index, sh_degree)`, with zero moments where fresh."""
        self.first, self.second = (moment.select(index, sh_degree, fresh) for moment in (self.first, self.second))

    def forget(self, attribute: str) -> None:
        """Zero the moments of one attribute, whose values were overwritten."""
        for moment in (self.first, self.second):
            moment.attributes[attribute].zero_()
