"""The subspace of a (block) Lanczos recurrence with thick restarts (Wu and Simon 2000).

T is kept whole, so that nothing is assumed of its shape after a restart.  When the memory budget of basis vectors is full, the
Ritz vectors next to both ends are kept and the recurrence goes on from them.  It knows r_i = H v_i - lambda_i v_i, its next
vectors times B s_i, up to the noise of its products; and as it begins at a random vector, all m (m - 1) / 2 pairs of m steps
see that noise.
"""

from math import inf, log, sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.lanczos import norm, orthogonalise, unit_columns
from landscape.operator import SymmetricOperator
from landscape.probes import draw_probes
from landscape.subspace import EigenSettings, Ritz, Subspace


class Krylov(Subspace):
    """Grows by what H makes of its newest rows."""

    method = "lanczos"

    def __init__(
        self, operator: SymmetricOperator, generator: torch.Generator, settings: EigenSettings, start: Tensor | None
    ) -> None:
        first = draw_probes(operator.dim, min(settings.block, operator.dim), generator, operator.dtype)
        super().__init__(operator, generator, settings)
        self.scale, self.coupling = 1.0, torch.zeros(0, 0, dtype=torch.float64)
        self.random_share, self.first_cycle = 1.0, 0
        if start is not None:
            first[:, 0] = _mixed(start, first[:, 0], settings.noise)
            self.random_share = settings.noise / (1 + settings.noise)
        self.append(first.T.contiguous(), self.scale)
        self.foreseen = torch.zeros(0, self.width, dtype=torch.float64)

    def expand(self, near_noise: bool) -> None:
        old, new = self.size, self.size + self.width
        W = self.products(near_noise)
        self.scale = max(self.scale if old else 0.0, *(norm(w) for w in W))
        components = orthogonalise(W, self.basis[:new])
        self.surprise += float((components[:old] - self.foreseen).square().sum())
        self.pairs += self.foreseen.numel()
        self.project(components)
        self.coupling = self.append(W, self.scale)
        self.foreseen = torch.zeros(new, self.width, dtype=torch.float64)
        self.foreseen[old:] = self.coupling.T
        self.first_cycle += not self.restarted

    def ritz(self) -> Ritz:
        m = self.size
        values, coordinates = torch.linalg.eigh(self.T[:m, :m])
        residuals = torch.linalg.vector_norm(self.coupling @ coordinates[m - self.coupling.shape[1] :], dim=0)
        return Ritz(values, coordinates, residuals, *self.outermost())

    def leaving(self) -> float:
        return norm(self.coupling)

    def make_room(self, ritz: Ritz) -> None:
        if self.size + self.width <= self.capacity:
            return
        following = self.basis[self.size : self.size + self.width].clone()
        kept = self.restart(ritz, self.capacity - 2 * self.settings.block)
        self.basis[self.size : self.size + self.width] = following
        self.foreseen = kept[:, kept.shape[1] - self.coupling.shape[1] :] @ self.coupling.T

    def remainders(self, ritz: Ritz) -> Float[Tensor, "n k"]:
        last = ritz.coordinates[self.size - self.coupling.shape[1] : self.size, ritz.wanted]
        return self.basis[self.size : self.size + self.width].T @ (self.coupling @ last).to(self.basis)

    def all_residuals(self, ritz: Ritz) -> Float64[Tensor, " m"]:
        return ritz.residuals

    def beyond(self, ritz: Ritz) -> float:
        spread = float(ritz.values[-1] - ritz.values[0])
        return _beyond(self.operator.dim, self.first_cycle, spread, self.random_share)


def _mixed(start: Tensor, random: Tensor, noise: float) -> Tensor:
    """The normalised sum of the start vectors' directions, with so much of the random vector."""
    total = unit_columns(start.reshape(random.numel(), -1).to(random)).sum(dim=1)
    return total / norm(total) + noise * random / norm(random)


def _beyond(n: int, steps: int, spread: float, share: float = 1.0) -> float:
    """How far outside the Ritz values the spectrum may reach, with probability 0.99 over a random start.

    Kuczynski and Wozniakowski (1992), Theorem 4.2: after m steps the end is missed by more than the share eps of the
    spectrum's width with probability at most 1.648 sqrt(n) exp(-sqrt(eps) (2 m - 1)).  Beside a random vector of this share of
    the start's length a given one costs a factor of 1 / share: it lengthens the start, and the end's component of the sum is
    no likelier to be small than that of the random vector alone, whose density is symmetric and falls from 0 on.
    """
    if steps >= n:
        return 0.0
    eps = (log(2 * 1.648 * sqrt(n) / (0.01 * share)) / (2 * steps - 1)) ** 2
    return eps / (1 - 2 * eps) * spread if eps < 0.5 else inf
