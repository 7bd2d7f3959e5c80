"""The subspace of Davidson's method: it grows where a known approximation of the operator says that the ends lie.

Of H an approximation D is known whose functions f(D) are cheap (the blocks of single Gaussians, say).  To a Ritz pair (lambda,
v) with the residual r belongs the correction (Davidson 1975; at right angles to v: Olsen, Jorgensen and Simons 1990)

    t = M r - (v . M r / v . M v) M v,   M = 1 / |lambda - D|

which is the error of v to first order where D is near H (its negative at the lower end).  At an end of the spectrum lambda - D
has one sign: where D are diagonal blocks of H no eigenvalue of D lies outside those of H (Cauchy), nor outside the Ritz values
once the subspace has the steepest of them.  What lies on the wrong side, or nearer than CLOSEST |lambda|, is taken to be that
far away.

Every product is kept with its vector, so residuals are known up to the noise of the products.  The corrections of all open
pairs take one product together.

**That the ends are the ends.**  A recurrence comes across them by itself (`EigenEnds.beyond`); a subspace that goes where D
points need not.  So a random vector begins beside the given ones, and a chain of CHAIN vectors is built on it: what H makes of
the one before, at right angles to all that is known.  And beside the wanted pairs a guard at each end is resolved to its
distance from them.  Where couplings make the ends (150 random matrices, two largest and smallest to 1%, 10% and 0.1%) a run so
took another value for an end once, without guards 21 times, without the chain 12 times, and a recurrence from the same start 15
times.
"""

from collections.abc import Callable
from math import inf
from typing import Protocol

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.lanczos import norm, orthogonalise, unit_columns
from landscape.operator import SymmetricOperator
from landscape.probes import draw_probes
from landscape.subspace import CHUNK, EigenSettings, Goal, Ritz, Subspace, recombine

CHAIN = 6  # products with the random vector's successors
CLOSEST = 0.1  # of |lambda|: what the approximation may be off by


class Approximation(Protocol):
    """A symmetric D like the operator."""

    def function(self, f: Callable[[Tensor], Tensor], V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """f(D) V; f takes eigenvalues of D, elementwise."""
        ...


class Davidson(Subspace):
    """Grows by the corrections of the open pairs.  Of `settings.basis` half is for the products.

    images: H times the rows of the basis.  vectors, residuals: v and r of the latest wanted pairs and guards, as rows.
    rounds: products so far; for CHAIN of them the last row is the newest of the chain.
    """

    method = "davidson"

    def __init__(
        self,
        operator: SymmetricOperator,
        generator: torch.Generator,
        settings: EigenSettings,
        approximation: Approximation,
        start: Float[Tensor, "n *k"] | None,
    ) -> None:
        given = 0 if start is None else start.numel() // operator.dim
        first = draw_probes(operator.dim, max(1, settings.wanted - given), generator, operator.dtype)
        if start is not None:
            room = settings.max_matvecs - settings.wanted - 2 - first.shape[1]
            first = torch.cat([start.reshape(operator.dim, -1)[:, :room].to(first), first], dim=1)
        most = _most(settings)
        capacity = max(settings.basis // 2, first.shape[1])
        super().__init__(operator, generator, settings, capacity, most, first.shape[1])
        self._random = first.shape[1] - 1
        self.approximation, self.images = approximation, torch.empty_like(self.basis)
        self.vectors = self.residuals = self.basis[:0]
        self.rounds = 0
        self.append(unit_columns(first).T.contiguous(), 1.0)

    def expand(self, near_noise: bool) -> None:
        old, new = self.size, self.size + self.width
        self.images[old:new] = self.products(near_noise)
        components = (self.basis[:new] @ self.images[old:new].T).double().cpu()
        if old and not self.restarted:
            foreseen = (self.basis[old:new] @ self.images[self._random]).double().cpu()
            self.surprise += float((components[self._random] - foreseen).square().sum())
            self.pairs += self.width
        self.project(components)
        self.rounds += 1

    def ritz(self) -> Ritz:
        m, s = self.size, self.settings
        values, coordinates = torch.linalg.eigh(self.T[:m, :m])
        largest, smallest = self.outermost()
        next_to = [m - 1 - s.largest] * (s.largest > 0) + [s.smallest] * (s.smallest > 0)
        guards = [i for i in dict.fromkeys(next_to) if s.smallest <= i < m - s.largest]
        chosen = largest + smallest + guards
        combination = coordinates[:, chosen].T.to(self.basis)
        self.vectors = combination @ self.basis[:m]
        self.residuals = combination @ self.images[:m] - values[chosen].to(self.basis)[:, None] * self.vectors
        residuals = torch.full_like(values, inf)
        residuals[chosen] = torch.linalg.vector_norm(self.residuals, dim=1, dtype=torch.float64).cpu()
        return Ritz(values, coordinates, residuals, largest, smallest, guards)

    def aim(self, ritz: Ritz, goal: Goal) -> None:
        """At the open pairs, or at the wanted ones where none is; and at what H makes of the newest row of the chain."""
        chosen = {index: row for row, index in enumerate(ritz.wanted + ritz.guards)}
        targets = ritz.open(goal) or (ritz.wanted if self.certain else [])
        rows = [self._correction(ritz, index, chosen[index]) for index in targets]
        if self.rounds < CHAIN:
            following = self.images[self.size - 1]
            rows.append(following / (norm(following) or 1.0))
        rows = torch.stack(rows)
        if self.size + len(rows) > self.capacity:
            recombine(self.images, self.restart(ritz, self.capacity - self.most))
        orthogonalise(rows, self.basis[: self.size])
        self.append(rows, 1.0)

    @staticmethod
    def fits(settings: EigenSettings) -> bool:
        """Whether its least number of vectors, each with its product, stays within the memory budget."""
        return settings.basis >= 4 * _most(settings)

    @property
    def certain(self) -> bool:
        return self.rounds >= CHAIN

    def _correction(self, ritz: Ritz, index: int, row: int) -> Float[Tensor, " n"]:
        """t of a pair, of unit length; 0 where r is."""
        value, top = float(ritz.values[index]), len(ritz.values) - 1 - self.settings.largest
        side = 1.0 if self.settings.largest and index >= top else -1.0
        closest = max(CLOSEST * abs(value), self.rounding(ritz)) or 1.0
        v, r = self.vectors[row], self.residuals[row]

        def inverse(eigenvalues: Tensor) -> Tensor:
            return 1 / (side * (value - eigenvalues)).clamp_min(closest)

        Mr, Mv = self.approximation.function(inverse, torch.stack([r, v], dim=1)).T
        t = Mr - (v @ Mr) / (v @ Mv) * Mv
        return t / (norm(t) or 1.0)

    def remainders(self, ritz: Ritz) -> Float[Tensor, "n k"]:
        return self.residuals[: len(ritz.wanted)].T

    def all_residuals(self, ritz: Ritz) -> Float64[Tensor, " m"]:
        Y, squares = ritz.coordinates.to(self.basis), torch.zeros_like(ritz.values)
        for first in range(0, self.operator.dim, CHUNK):
            Q, W = (rows[: self.size, first : first + CHUNK].T for rows in (self.basis, self.images))
            squares += (W @ Y - ritz.values.to(Q) * (Q @ Y)).double().square().sum(dim=0).cpu()
        return squares.sqrt()

    def beyond(self, ritz: Ritz) -> float:
        return 0.0 if self.size == self.operator.dim else inf


def _most(settings: EigenSettings) -> int:
    """Rows that come next at most: for the wanted pairs, two guards and the chain."""
    return settings.wanted + 2 + 1
