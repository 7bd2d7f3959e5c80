"""A subspace in which both ends of a spectrum are looked for, and what is reported of the pairs found in it.

Q is orthonormal and T = Q^T H Q known; T y = lambda y gives the Ritz pair (lambda, v = Q y) with the residual r = H v - lambda
v.  How Q grows and where r comes from is left to `krylov`.

**What is seen of a product's noise.**  By symmetry a product H q_j has components q_i . H q_j that are known already.  Each
is off by q_i . e_j - e_i . q_j, e the noise of a product: its rounding, or whatever else sets it off.  Where one of the two
vectors is a random one it sees noise as random vectors do, 2 |e|^2 / n in the mean square.  MARGIN of this |e| is added to the
|r| reported, or of the round-off that a product of this precision has at best, eps |lambda|_max.  No product is spent on the
noise where that sum is as small as was asked for, or where less than this round-off was asked for.

**What is not seen.**  The components are sums in the vectors' precision, which in long float32 vectors is the larger
noise.  Then one product with all the k pairs, signs at random,

    f = H x - sum_i +-(lambda_i v_i + r_i),  x = sum_i +-v_i

shows what the subspace does not know, |f|^2 = k times the mean square of one pair's on average, and |r_i +- f| is the
residual.  Where that is more than was asked for, as at the end of a budget, each pair has a product of its own.  And the noise
is measured once before, with one vector more, when a residual that is still above its goal has come near what is
seen of it: from there on steps might be made in vain.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import inf, isnan, nan, sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.checks import SCALE
from landscape.lanczos import is_dust, norm, orthogonalise
from landscape.operator import SymmetricOperator
from landscape.probes import draw_probes
from landscape.results import EigenEnds, Eigenpairs, StopReason

KEEP = 0.6  # share of the basis that a restart keeps
CHUNK = 1 << 16  # rows of vectors that a restart recombines at a time
MARGIN = 4.0  # of the noise that is seen: what it may be in the directions of the wanted vectors
NEAR = 30.0  # of that noise, from which on it is measured
NEAREST = 3e-4  # of the largest value: root of the eps of float32, which rounding stays below in either precision
PAIRS = 10  # from which it can be told


@dataclass(frozen=True)
class EigenSettings:
    """How many pairs at each end, to which residual, with how much memory and work.

    basis: vectors kept at a time (the memory budget).  block: vectors per application of the operator; more than one
    helps with multiple eigenvalues and where the operator is cheaper per vector in blocks.  noise: length of a random vector
    beside a given start of unit length, so that an end that the start misses is still found.  The shorter, the fewer products
    from a good start, and the likelier to take the neighbour of an end for it, where they are about rtol apart: with rtol = 1%
    and two lowest eigenvalues 1.5% apart in 40% of the runs at 1, in 85% at 0.3, in 2% from a random start; on five scenes
    with rtol = 10%, from their Gaussians' own steepest directions, in 4 of 30 runs at 0.3, in none at 1.
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
            raise ValueError(
                f"expected largest, smallest >= 0 (not both 0) and block >= 1, "
                f"got {self.largest}, {self.smallest} and {self.block}"
            )
        if self.rtol < 0 or self.atol < 0 or self.noise <= 0:
            raise ValueError(
                f"expected rtol and atol >= 0 and noise > 0, got {self.rtol}, {self.atol} and {self.noise}"
            )
        if self.basis < self.wanted + 3 * self.block:
            raise ValueError(f"expected a basis of at least {self.wanted + 3 * self.block} vectors, got {self.basis}")
        if self.max_matvecs < 2 * self.wanted + self.block + 2:
            raise ValueError(f"expected max_matvecs >= {2 * self.wanted + self.block + 2}, got {self.max_matvecs}")

    @property
    def wanted(self) -> int:
        return self.largest + self.smallest


@dataclass(frozen=True)
class Goal:
    """What a residual may be: rtol |lambda|, or floor where that is more."""

    rtol: float
    floor: float

    def of(self, values: Float64[Tensor, " k"]) -> Float64[Tensor, " k"]:
        return (self.rtol * values.abs()).clamp_min(self.floor)


@dataclass(frozen=True, eq=False)
class Ritz:
    """Ritz values (ascending), their coordinates in the basis, residuals, and which of them are wanted."""

    values: Float64[Tensor, " m"]
    coordinates: Float64[Tensor, "m m"]
    residuals: Float64[Tensor, " m"]
    largest: list[int]
    smallest: list[int]

    @property
    def wanted(self) -> list[int]:
        return self.largest + self.smallest

    def open(self, goal: Goal) -> list[int]:
        """Which wanted residuals are above their goals."""
        asked = goal.of(self.values)
        return [i for i in self.wanted if not self.residuals[i] <= asked[i]]

    def moved(self, before: Float64[Tensor, " k"] | None, goal: Goal) -> bool:
        """Whether a wanted value is another than it was."""
        values = self.values[self.wanted]
        return before is None or not ((values - before).abs() <= goal.of(values)).all()

    def near(self, noise: float, goal: Goal) -> bool:
        """Whether an open residual is near this noise."""
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


class Subspace(ABC):
    """The growing basis: rows 0..size orthonormal with T = Q^T H Q known, then `width` rows that come next.

    capacity: rows with T known at a time.
    """

    method: str

    def __init__(
        self,
        operator: SymmetricOperator,
        generator: torch.Generator,
        settings: EigenSettings,
    ) -> None:
        self.operator, self.generator, self.settings = operator, generator, settings
        self.capacity = min(settings.basis, operator.dim)
        rows = self.capacity + settings.block
        self.basis = torch.empty(rows, operator.dim, dtype=operator.dtype, device=generator.device)
        self.T = torch.zeros(self.capacity, self.capacity, dtype=torch.float64)
        self.size, self.width, self.matvecs, self.noise, self.restarted = 0, 0, 0, nan, False
        self._exhausted = False
        # components that were known before, and the sum of squares that they are off by
        self.pairs, self.surprise = 0, 0.0

    @abstractmethod
    def expand(self, near_noise: bool) -> None:
        """Apply H to the rows that come next; near_noise: and measure the noise, if it is not known yet."""

    @abstractmethod
    def ritz(self) -> Ritz: ...

    @abstractmethod
    def make_room(self, ritz: Ritz) -> None:
        """Restart where there is none for the rows that come next."""

    @abstractmethod
    def leaving(self) -> float:
        """How long what H makes of the newest rows is at right angles to all: no residual is longer."""

    def exhausted(self, ritz: Ritz, goal: Goal) -> bool:
        """Whether H has led out of the rows no more, now or before: rows since then are random ones.

        No residual says then that another eigenvector of a wanted value is missing, so a run ends only where one more row has
        moved none.
        """
        self._exhausted |= self.leaving() <= float(goal.of(ritz.values[ritz.wanted]).max())
        return self._exhausted

    @abstractmethod
    def remainders(self, ritz: Ritz) -> Float[Tensor, "n k"]:
        """r of the wanted pairs."""

    @abstractmethod
    def all_residuals(self, ritz: Ritz) -> Float64[Tensor, " m"]:
        """|r| of all pairs."""

    @abstractmethod
    def beyond(self, ritz: Ritz) -> float:
        """See `EigenEnds`."""

    @property
    def seen_noise(self) -> float:
        """The noise of a product as far as symmetry shows it; nan: not yet."""
        return sqrt(self.operator.dim * self.surprise / (2 * self.pairs)) if self.pairs >= PAIRS else nan

    def floor(self, ritz: Ritz) -> float:
        """The residual that the matvec's noise leaves at least, as far as it was measured."""
        return self.rounding(ritz) if isnan(self.noise) else max(self.noise, self.rounding(ritz))

    def rounding(self, ritz: Ritz) -> float:
        """What rounding leaves of a product at best, independent in every row."""
        return torch.finfo(self.basis.dtype).eps * float(ritz.values.abs().max())

    def products(self, near_noise: bool) -> Float[Tensor, "width n"]:
        """H times the rows that come next."""
        V = self.basis[self.size : self.size + self.width].T
        if near_noise and isnan(self.noise):
            V = torch.cat([V, SCALE * V[:, :1]], dim=1)
        W = self.operator.apply(V.contiguous()).T.clone(memory_format=torch.contiguous_format)
        self.matvecs += len(W)
        if len(W) > self.width:
            self.noise, W = norm(W[-1].double() / SCALE - W[0].double()), W[:-1]
        if not torch.isfinite(W).all():
            raise ValueError(
                "expected finite products H v, got NaN or infinity; check the parameters with check_operator"
            )
        return W

    def project(self, components: Float64[Tensor, "new width"]) -> None:
        """T has the rows that came next too, given q_i . H q_j of all rows with these."""
        old, self.size = self.size, len(components)
        new = slice(old, self.size)
        self.T[: self.size, new] = components
        self.T[new, : self.size] = components.T
        self.T[new, new] = (components[old:] + components[old:].T) / 2

    def outermost(self) -> tuple[list[int], list[int]]:
        """Which Ritz values are the wanted ones of the upper end, descending, and of the lower one, ascending."""
        settings, last = self.settings, self.size - 1
        return list(range(last, last - settings.largest, -1)), list(range(settings.smallest))

    def append(self, W: Float[Tensor, "b n"], scale: float) -> Float64[Tensor, "next b"]:
        """Orthonormal rows after the first `size` that span the rows of W, orthogonal to these; B with W^T = next^T B.

        A row that is round-off alone, of vectors of length `scale` (an invariant subspace is complete), is replaced by a random
        one, with B = 0.
        """
        B = torch.zeros(W.shape[0], W.shape[0], dtype=torch.float64)
        self.width = 0
        for j, w in enumerate(W):
            found = self.basis[self.size : self.size + self.width]
            if self.size + self.width == self.operator.dim:
                break
            before = norm(w)
            B[: self.width, j] = orthogonalise(w[None], found)[:, 0]
            length = norm(w)
            if length < max(before, scale) / 10:  # cancellation brought the round-off of earlier passes forward
                orthogonalise(w[None], self.basis[: self.size + self.width])
                length = norm(w)
            if is_dust(length, scale, w.dtype):
                self._exhausted = True
                w.normal_(generator=self.generator)
                orthogonalise(w[None], self.basis[: self.size + self.width])
                torch.div(w, norm(w), out=self.basis[self.size + self.width])
            else:
                B[self.width, j] = length
                torch.div(w, length, out=self.basis[self.size + self.width])
            self.width += 1
        return B[: self.width]

    def restart(self, ritz: Ritz, most: int) -> Float64[Tensor, "kept size"]:
        """Go on from Ritz pairs: the share KEEP of the memory, at most so many, but the wanted ones.  Returns coordinates.

        Those beyond come from both ends evenly, whichever end is still open: those of its own end speed it up where
        the spectrum is dense there, those of the other end where that one reaches far.
        """
        settings = self.settings
        keep = max(settings.wanted, min(int(self.capacity * KEEP), most))
        top = settings.largest + (keep - settings.wanted) // 2
        kept = list(range(keep - top)) + list(range(self.size - top, self.size))
        combination = ritz.coordinates[:, kept].T
        recombine(self.basis, combination)
        self.T.zero_()
        self.T[:keep, :keep] = torch.diag(ritz.values[kept])
        self.size, self.restarted = keep, True
        return combination

    def measured(self, ritz: Ritz, budget: StopReason, converged: bool) -> tuple[EigenEnds, bool]:
        """The wanted pairs with residuals by the operator itself, and whether more steps would make them better."""
        s = self.settings
        vectors = self.basis[: self.size].T @ ritz.coordinates[:, ritz.wanted].to(self.basis)
        vectors /= torch.linalg.vector_norm(vectors, dim=0)  # restarts leave a little of their round-off
        values = ritz.values[ritz.wanted]
        known = ritz.residuals[ritz.wanted]
        rounding = self.rounding(ritz)
        residuals = known + MARGIN * max(self.seen_noise, rounding)
        asked = Goal(s.rtol, s.atol).of(values)
        out_of_reach = (asked <= rounding) & (self.seen_noise <= MARGIN * rounding)
        if not (converged and ((residuals <= asked) | out_of_reach).all()):
            enough = asked.clamp_min(self.floor(ritz))
            residuals = self._together(ritz, vectors) if converged else torch.full_like(values, inf)
            if not (residuals <= enough).all():
                values, residuals = rayleigh(self.operator, vectors)
                asked = Goal(s.rtol, s.atol).of(values)
                self.matvecs += s.wanted
        # a residual far above what the subspace knows of it is the matvec's round-off: more steps cannot lower it
        stuck = (known <= residuals / 4) | (known <= self.floor(ritz))
        reached = residuals <= asked
        errors = residuals / ritz.gaps()

        def end(part: slice, descending: bool) -> Eigenpairs:
            reason: StopReason = budget
            if (reached | stuck)[part].all():
                reason = "tolerance" if reached[part].all() else "noise floor"
            order = torch.argsort(values[part], descending=descending)
            pairs = [quantity[part][order] for quantity in (values, residuals, errors)]
            return Eigenpairs(pairs[0], turned(vectors[:, part][:, order]), pairs[1], pairs[2], reason)

        largest, smallest = end(slice(0, s.largest), True), end(slice(s.largest, s.wanted), False)
        spectrum = torch.stack([ritz.values, self.all_residuals(ritz)])
        noise = self.seen_noise if isnan(self.noise) else self.noise
        ends = EigenEnds(largest, smallest, self.method, self.matvecs, self.beyond(ritz), noise, spectrum)
        return ends, not bool((reached | stuck).all())

    def _together(self, ritz: Ritz, vectors: Float[Tensor, "n k"]) -> Float64[Tensor, " k"]:
        """Residuals of all pairs from one product; measures the noise."""
        signs = draw_probes(len(ritz.wanted), 1, self.generator, torch.float64, "rademacher")[:, 0]
        unknown = self.operator.apply((vectors @ signs.to(vectors.dtype))[:, None])[:, 0].double()
        self.matvecs += 1
        known = self.remainders(ritz)
        for i, value in enumerate(ritz.values[ritz.wanted]):
            unknown -= signs[i] * (value * vectors[:, i] + known[:, i])
        self.noise = norm(unknown) / len(signs) ** 0.5
        return torch.tensor([norm(signs[i] * known[:, i] + unknown) for i in range(len(signs))], dtype=torch.float64)


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
    for v, w in zip(vectors.T, operator.apply(vectors.contiguous()).T, strict=True):
        length = norm(v)
        value = float(torch.dot(v.double(), w.double())) / length**2
        values.append(value)
        residuals.append(norm(w.double() - value * v.double()) / length)
    return torch.tensor(values, dtype=torch.float64), torch.tensor(residuals, dtype=torch.float64)


def turned(vectors: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The columns with their largest entries positive, so that slices along them look alike from run to run."""
    peaks = vectors.gather(0, vectors.abs().argmax(dim=0, keepdim=True))
    return torch.where(peaks < 0, -vectors, vectors)
