"""Which eigenpairs are looked for, and what a subspace knows of them.

With an orthonormal Q and T = Q^T H Q, T y = lambda y gives the Ritz pair (lambda, v = Q y) with the residual r = H v -
lambda v: an eigenvalue lies within |r| of lambda.  A pair is wanted if it is one of those asked for at either end, and open
as long as its |r| is above what was asked for.  How Q grows is left to `krylov`.
"""

from dataclasses import dataclass
from math import inf

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import norm
from landscape.operators.operator import SymmetricOperator, product

NEAR = 30.0  # of a product's noise, from which on a residual is near it
NEAREST = 3e-4  # of the largest value: root of the eps of float32, which rounding stays below in either precision
CHUNK = 1 << 16  # entries of vectors that are combined at a time


@dataclass(frozen=True)
class EigenSettings:
    """How many pairs at each end, to which residual, with how much memory and work.

    largest, smallest: pairs of the largest and of the smallest (signed) eigenvalues.
    rtol, atol: a pair is good enough when its residual |H v - lambda v| is max(rtol |lambda|, atol) or less.
    basis: vectors kept at a time, `block` more in work (the memory budget): at least largest + smallest + 3 block.
    block: vectors per application of the operator; more than one helps with multiple eigenvalues and where the operator is
        cheaper per vector in blocks.
    noise: length of a random vector added to a given start of unit length, so that an end that the start misses is still
        found.  The shorter, the fewer products from a good start, and the likelier to take the neighbour of an end for it,
        where they are about rtol apart: with rtol = 1% and two lowest eigenvalues 1.5% apart in 40% of the runs at 1, in 85%
        at 0.3, in 2% from a random start.  With a start of several directions (`splat.curvature.block_eigenvectors.LEADS`) it
        makes no difference.
    max_matvecs, max_seconds: budgets of both ends together; a step under way at the end of the time is finished.
    """

    largest: int = 1
    smallest: int = 1
    rtol: float = 1e-3
    atol: float = 0.0
    basis: int = 64
    block: int = 1
    noise: float = 1.0
    max_matvecs: int = 1000
    max_seconds: float = inf

    def __post_init__(self) -> None:
        if min(self.largest, self.smallest) < 0 or self.wanted < 1 or self.block < 1:
            raise InputError(
                f"expected largest, smallest >= 0 (not both 0) and block >= 1, "
                f"got {self.largest}, {self.smallest} and {self.block}"
            )
        if not (self.rtol >= 0 and self.atol >= 0 and self.max_seconds >= 0 and 0 < self.noise < inf):
            raise InputError(
                f"expected rtol, atol, max_seconds >= 0 and a finite noise > 0, got {self.rtol}, {self.atol}, "
                f"{self.max_seconds} and {self.noise}"
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
    """The largest residual that is good enough: rtol |lambda|, or floor where that is more."""

    rtol: float
    floor: float

    def of(self, values: Float64[Tensor, " k"]) -> Float64[Tensor, " k"]:
        return (self.rtol * values.abs()).clamp_min(self.floor)


@dataclass(frozen=True, eq=False)
class Ritz:
    """Ritz values (ascending), their vectors' coordinates in the basis (columns), |residuals|, and the wanted ones' indices."""

    values: Float64[Tensor, " m"]
    coordinates: Float64[Tensor, "m m"]
    residuals: Float64[Tensor, " m"]
    largest: list[int]
    smallest: list[int]

    @property
    def wanted(self) -> list[int]:
        return self.largest + self.smallest

    def open(self, goal: Goal) -> list[int]:
        """Indices of the wanted pairs whose residuals are above the goal."""
        asked = goal.of(self.values)
        return [i for i in self.wanted if not self.residuals[i] <= asked[i]]

    def moved(self, before: Float64[Tensor, " k"] | None, goal: Goal) -> bool:
        """Whether a wanted value differs from its value before by more than the goal; True where there was none before."""
        values = self.values[self.wanted]
        return before is None or not ((values - before).abs() <= goal.of(values)).all()

    def near(self, noise: float, goal: Goal) -> bool:
        """Whether an open pair's residual is so small that this noise of a product may be all that is left of it."""
        limit = min(NEAR * noise, NEAREST * float(self.values.abs().max()))
        return any(float(self.residuals[i]) < limit for i in self.open(goal))

    def gaps(self) -> Float64[Tensor, " k"]:
        """Distance of each wanted value to the nearest other one."""
        steps = torch.diff(self.values, prepend=torch.tensor([-inf]), append=torch.tensor([inf]))
        return torch.minimum(steps[:-1], steps[1:])[self.wanted]

    def state(self) -> str:
        parts = [
            f"{name} {float(self.values[i]):.4g} +- {float(self.residuals[i]):.1e}"
            for name, indices in (("largest", self.largest), ("smallest", self.smallest))
            for i in indices[:1]
        ]
        return ", ".join(parts)


def recombine(rows: Float[Tensor, "m n"], combination: Float64[Tensor, "kept size"]) -> None:
    """The first rows become these combinations of the first `size`, in place."""
    C = combination.to(rows)
    for first in range(0, rows.shape[1], CHUNK):
        columns = slice(first, first + CHUNK)
        rows[: len(C), columns] = C @ rows[: C.shape[1], columns]


def rayleigh(
    operator: SymmetricOperator, vectors: Float[Tensor, "n k"]
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
    """Rayleigh quotients and residuals of k vectors that are near to unit length, added up in float64."""
    values, residuals = [], []
    for v, w in zip(vectors.T, product(operator, vectors.contiguous()).T, strict=True):
        length = norm(v)
        value = float(torch.dot(v.double(), w.double())) / length**2
        values.append(value)
        residuals.append(norm(w.double() - value * v.double()) / length)
    return torch.tensor(values, dtype=torch.float64), torch.tensor(residuals, dtype=torch.float64)


def turned(vectors: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The columns with their largest entries positive, so that slices along them look alike from run to run."""
    peaks = vectors.gather(0, vectors.abs().argmax(dim=0, keepdim=True))
    return torch.where(peaks < 0, -vectors, vectors)
