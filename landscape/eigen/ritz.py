"""Settings of the search for eigenpairs, and the Ritz pairs of a subspace.

With an orthonormal Q and T = Q^T H Q, an eigenpair T y = lambda y gives the Ritz pair (lambda, v = Q y) with the residual
r = H v - lambda v; an eigenvalue of H lies within |r| of lambda.  Pairs are `wanted` if they were asked for at either end, and
`open` while |r| is above its goal.  `krylov` grows Q.
"""

from dataclasses import dataclass
from math import inf

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import norm
from landscape.operators.operator import SymmetricOperator, product

NEAR = 30.0  # a residual below this multiple of the noise of a product is near it ...
NEAREST = 3e-4  # ... if it is also below this share of the largest value: sqrt(eps) of float32
CHUNK = 1 << 16  # entries of vectors that are combined at a time


@dataclass(frozen=True)
class EigenSettings:
    """Number of pairs at each end, their residual, and limits of memory and work.

    largest, smallest: numbers of pairs of the largest and of the smallest (signed) eigenvalues.
    further: so many pairs next to these at either end are returned too, as they are found, without a goal.
    rtol, atol: a pair is done when its residual |H v - lambda v| is at most max(rtol |lambda|, atol).
    basis: memory budget in vectors, with `block` more in work: at least largest + smallest + 3 block.
    block: vectors in one application of the operator.  More than one helps with multiple eigenvalues, and where products with
        several vectors are cheaper per vector.
    noise: length of the random vector that is added to a warm start of unit length, so that an end to which the start is
        orthogonal is found.  A short one saves products from a good start, but the run can miss an extreme eigenvector that the
        start has no component in, and report a neighbour about rtol away.  A start of several directions avoids that.
    max_matvecs: budget of both ends together.
    """

    largest: int = 1
    smallest: int = 1
    rtol: float = 1e-3
    atol: float = 0.0
    basis: int = 64
    block: int = 1
    noise: float = 1.0
    max_matvecs: int = 1000
    further: int = 0

    def __post_init__(self) -> None:
        if min(self.largest, self.smallest) < 0 or self.wanted < 1 or self.block < 1:
            raise InputError(
                f"expected largest, smallest >= 0 (not both 0) and block >= 1, "
                f"got {self.largest}, {self.smallest} and {self.block}"
            )
        if not (self.rtol >= 0 and self.atol >= 0 and 0 < self.noise < inf):
            raise InputError(
                f"expected rtol, atol >= 0 and a finite noise > 0, got {self.rtol}, {self.atol} and {self.noise}"
            )
        if self.basis < self.wanted + 3 * self.block:
            raise InputError(f"expected a basis of at least {self.wanted + 3 * self.block} vectors, got {self.basis}")
        if self.max_matvecs < 2 * self.wanted + self.block + 2:
            raise InputError(f"expected max_matvecs >= {2 * self.wanted + self.block + 2}, got {self.max_matvecs}")

    @property
    def wanted(self) -> int:
        return self.largest + self.smallest


@dataclass(frozen=True)
class Goal:
    """The goal for residuals: max(rtol |lambda|, floor)."""

    rtol: float
    floor: float

    def of(self, values: Float64[Tensor, " k"]) -> Float64[Tensor, " k"]:
        return (self.rtol * values.abs()).clamp_min(self.floor)


@dataclass(frozen=True, eq=False)
class Ritz:
    """Ritz values (ascending), coordinates of their vectors in the basis (columns), |r|, and the indices of wanted pairs."""

    values: Float64[Tensor, " m"]
    coordinates: Float64[Tensor, "m m"]
    residuals: Float64[Tensor, " m"]
    largest: list[int]
    smallest: list[int]

    @property
    def wanted(self) -> list[int]:
        return self.largest + self.smallest

    def open(self, goal: Goal) -> list[int]:
        """Indices of the wanted pairs with residuals above the goal."""
        asked = goal.of(self.values)
        return [i for i in self.wanted if not self.residuals[i] <= asked[i]]

    def moved(self, before: Float64[Tensor, " k"] | None, goal: Goal) -> bool:
        """Whether a wanted value has changed by more than the goal; True where there was none before."""
        values = self.values[self.wanted]
        return before is None or not ((values - before).abs() <= goal.of(values)).all()

    def near(self, noise: float, goal: Goal) -> bool:
        """Whether the residual of an open pair is so small that it may be only the noise of a product."""
        limit = min(NEAR * noise, NEAREST * float(self.values.abs().max()))
        return any(float(self.residuals[i]) < limit for i in self.open(goal))

    def gaps(self) -> Float64[Tensor, " m"]:
        """Distance from each value to the nearest other one."""
        steps = torch.diff(self.values, prepend=torch.tensor([-inf]), append=torch.tensor([inf]))
        return torch.minimum(steps[:-1], steps[1:])

    def state(self) -> str:
        parts = [
            f"{name} {float(self.values[i]):.4g} +- {float(self.residuals[i]):.1e}"
            for name, indices in (("largest", self.largest), ("smallest", self.smallest))
            for i in indices[:1]
        ]
        return ", ".join(parts)


def recombine(rows: Float[Tensor, "m n"], combination: Float64[Tensor, "kept size"]) -> None:
    """Replace the first `kept` rows by combination @ (the first `size` rows), in place."""
    C = combination.to(rows)
    for first in range(0, rows.shape[1], CHUNK):
        columns = slice(first, first + CHUNK)
        rows[: len(C), columns] = C @ rows[: C.shape[1], columns]


def rayleigh(
    operator: SymmetricOperator, vectors: Float[Tensor, "n k"]
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
    """Rayleigh quotients and residuals of k vectors of about unit length, in float64."""
    values, residuals = [], []
    for v, w in zip(vectors.T, product(operator, vectors.contiguous()).T, strict=True):
        length = norm(v)
        value = float(torch.dot(v.double(), w.double())) / length**2
        values.append(value)
        residuals.append(norm(w.double() - value * v.double()) / length)
    return torch.tensor(values, dtype=torch.float64), torch.tensor(residuals, dtype=torch.float64)


def turned(vectors: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The columns with their signs changed so that their largest entries are positive, for slices that look alike."""
    peaks = vectors.gather(0, vectors.abs().argmax(dim=0, keepdim=True))
    return torch.where(peaks < 0, -vectors, vectors)
