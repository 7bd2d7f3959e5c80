"""Eigenpairs at the two ends of the spectrum, by Lanczos with thick restarts.

`extreme_eigenpairs` runs one (block) Lanczos recurrence for both ends (Wu and Simon 2000).  The projected matrix
T = Q^T H Q is kept whole, so that nothing is assumed of its shape after a restart.  When the memory budget of basis
vectors is full, the Ritz vectors next to both ends are kept and the recurrence goes on from them.

A run ends when every wanted pair has an estimated residual |B s| under max(rtol |lambda|, atol), or under the round-off
of the matvec, or at its budget.  The recurrence knows r_i = H v_i - lambda_i v_i, its next vectors times B s_i, up to the
noise of its products: their rounding, or whatever else sets them off.

**What the recurrence sees of it.**  By symmetry a product H q_j has the components T_ij on all the q_i before it, which are
known already.  Each is off by q_i . e_j - e_i . q_j, e the noise of a product.  As the q begin at a random vector, they see
noise as random vectors do: 2 |e|^2 / n in the mean square, over m (m - 1) / 2 pairs in m steps.  MARGIN of this |e| is added to
the |r_i| reported, or of the round-off that a product of this precision has at best, eps |lambda|_max.  No product is spent on
the noise where that sum is as small as was asked for, or where less than this round-off was asked for.

**What it does not see.**  The components are sums in the vectors' precision, which in long float32 vectors is the larger
noise.  Then one product with all the k pairs, signs at random,

    f = H x - sum_i +-(lambda_i v_i + r_i),  x = sum_i +-v_i

shows what the recurrence does not know, |f|^2 = k times the mean square of one pair's on average, and |r_i +- f| is the
residual.  Where that is more than was asked for, as at the end of a budget, each pair has a product of its own.  And the noise
is measured once before, with one vector more, when an estimate that is still above its goal has come near what the
recurrence sees of it: from there on steps might be made in vain.
"""

from dataclasses import dataclass
from math import inf, isnan, log, nan, sqrt
from time import monotonic

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.checks import SCALE
from landscape.lanczos import is_dust, norm, orthogonalise
from landscape.operator import SymmetricOperator
from landscape.probes import draw_probes
from landscape.results import EigenEnds, Eigenpairs, Progress, StopReason

KEEP = 0.6  # share of the basis that a restart keeps
CHUNK = 1 << 16  # rows of vectors that a restart recombines at a time
MARGIN = 4.0  # of the noise that the recurrence sees: what it may be in the directions of the wanted vectors
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
    and two lowest eigenvalues 1.5% apart in 40% of the runs at 1, in 85% at 0.3, in 2% from a random start.
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


def extreme_eigenpairs(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: EigenSettings = EigenSettings(),
    start: Float[Tensor, "n *k"] | None = None,
    progress: Progress | None = None,
) -> EigenEnds:
    """The largest and smallest eigenvalues with vectors and residuals.

    start: vectors to begin from (those of an earlier checkpoint, say); the recurrence begins at the sum of their
    directions with a random vector of settings.noise of its length.  Progress counts matvecs.

    >>> from landscape.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.linspace(-1, 3, 50, dtype=torch.float64)))
    >>> ends = extreme_eigenpairs(H, torch.Generator().manual_seed(0), EigenSettings(rtol=1e-8))
    >>> print(f"{float(ends.largest.values):.6f} {float(ends.smallest.values):.6f} {ends.largest.reason}")
    3.000000 -1.000000 tolerance
    """
    n = operator.dim
    if settings.wanted > n:
        raise ValueError(f"expected at most {n} eigenpairs of an operator with {n} rows, got {settings.wanted}")
    krylov = _Krylov(operator, generator, settings, start)
    deadline = monotonic() + settings.max_seconds
    strictness, near = 1.0, False
    while True:
        krylov.expand(near)
        if krylov.size < settings.wanted:
            continue
        ritz = krylov.ritz()
        if progress:
            progress(krylov.matvecs, settings.max_matvecs, ritz.state())
        spent = krylov.matvecs + settings.block + settings.wanted + 2 > settings.max_matvecs
        late = monotonic() > deadline
        goal = strictness * settings.rtol, max(strictness * settings.atol, krylov.floor(ritz))
        near, converged = ritz.near(krylov.seen_noise, *goal), ritz.converged(*goal)
        if converged or spent or late:
            ends, more = krylov.measured(ritz, "time budget" if late else "matvec budget", converged)
            if not more or spent or late:
                return ends
            strictness /= 2
        if krylov.full:
            krylov.restart(ritz)


@dataclass(frozen=True, eq=False)
class _Ritz:
    """Ritz values (ascending), their coordinates in the basis, estimated residuals, and which of them are wanted."""

    values: Float64[Tensor, " m"]
    coordinates: Float64[Tensor, "m m"]
    residuals: Float64[Tensor, " m"]
    largest: list[int]
    smallest: list[int]

    @property
    def wanted(self) -> list[int]:
        return self.largest + self.smallest

    def converged(self, rtol: float, floor: float) -> bool:
        return not self._open(rtol, floor).numel()

    def near(self, noise: float, rtol: float, floor: float) -> bool:
        """Whether an open residual is near this noise."""
        return bool((self._open(rtol, floor) < min(NEAR * noise, NEAREST * float(self.values.abs().max()))).any())

    def _open(self, rtol: float, floor: float) -> Float64[Tensor, " k"]:
        """The residuals above their goals."""
        residuals = self.residuals[self.wanted]
        return residuals[residuals > (rtol * self.values[self.wanted].abs()).clamp_min(floor)]

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


class _Krylov:
    """The growing basis: rows 0..size orthonormal with T = Q^T H Q known, then `width` rows that come next."""

    def __init__(
        self, operator: SymmetricOperator, generator: torch.Generator, settings: EigenSettings, start: Tensor | None
    ) -> None:
        self.operator, self.generator, self.settings = operator, generator, settings
        self.capacity = min(settings.basis, operator.dim)
        self.T = torch.zeros(self.capacity, self.capacity, dtype=torch.float64)
        self.size, self.width, self.scale = 0, 0, 1.0
        self.coupling = torch.zeros(0, 0, dtype=torch.float64)
        # components that were known before, and the sum of squares that they are off by
        self.pairs, self.surprise = 0, 0.0
        self.random_share, self.first_cycle = 1.0, 0
        first = draw_probes(operator.dim, min(settings.block, self.capacity), generator, operator.dtype)
        self.basis = first.new_empty(self.capacity + settings.block, operator.dim)
        if start is not None:
            first[:, 0] = _mixed(start, first[:, 0], settings.noise)
            self.random_share = settings.noise / (1 + settings.noise)
        self._append(first.T.contiguous())
        self.foreseen = torch.zeros(0, self.width, dtype=torch.float64)
        self.noise, self.matvecs, self._restarted = nan, 0, False

    @property
    def full(self) -> bool:
        return self.size + self.width > self.capacity

    @property
    def seen_noise(self) -> float:
        """The noise of a product as far as symmetry shows it; nan: not yet."""
        return sqrt(self.operator.dim * self.surprise / (2 * self.pairs)) if self.pairs >= PAIRS else nan

    def expand(self, near_noise: bool) -> None:
        """Apply H to the next rows, project, and find the rows after them; the first time near the noise, measure it."""
        old, new = self.size, self.size + self.width
        V = self.basis[old:new].T
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
        self.scale = max(self.scale if old else 0.0, *(norm(w) for w in W))
        components = orthogonalise(W, self.basis[:new])
        self.surprise += float((components[:old] - self.foreseen).square().sum())
        self.pairs += self.foreseen.numel()
        self.T[:new, old:new] = components
        self.T[old:new, :new] = components.T
        self.T[old:new, old:new] = (components[old:] + components[old:].T) / 2
        self.size = new
        self.coupling = self._append(W)
        self.foreseen = torch.zeros(new, self.width, dtype=torch.float64)
        self.foreseen[old:] = self.coupling.T
        self.first_cycle += not self._restarted

    def _append(self, W: Float[Tensor, "b n"]) -> Float64[Tensor, "next b"]:
        """Orthonormal rows after the first `size` that span the rows of W; B with W^T = next^T B.

        A row that is round-off alone (an invariant subspace is complete) is replaced by a random one, with B = 0.
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
            if length < before / 10:  # cancellation brought the round-off of earlier passes forward
                orthogonalise(w[None], self.basis[: self.size + self.width])
                length = norm(w)
            if is_dust(length, self.scale, w.dtype):
                w.normal_(generator=self.generator)
                orthogonalise(w[None], self.basis[: self.size + self.width])
                torch.div(w, norm(w), out=self.basis[self.size + self.width])
            else:
                B[self.width, j] = length
                torch.div(w, length, out=self.basis[self.size + self.width])
            self.width += 1
        return B[: self.width]

    def ritz(self) -> _Ritz:
        m, s = self.size, self.settings
        values, coordinates = torch.linalg.eigh(self.T[:m, :m])
        last = coordinates[m - self.coupling.shape[1] :]
        residuals = torch.linalg.vector_norm(self.coupling @ last, dim=0)
        return _Ritz(values, coordinates, residuals, list(range(m - 1, m - 1 - s.largest, -1)), list(range(s.smallest)))

    def floor(self, ritz: _Ritz) -> float:
        """The residual that the matvec's noise leaves at least, as far as it was measured."""
        return self.rounding(ritz) if isnan(self.noise) else max(self.noise, self.rounding(ritz))

    def rounding(self, ritz: _Ritz) -> float:
        """What rounding leaves of a product at best, independent in every row."""
        return torch.finfo(self.basis.dtype).eps * float(ritz.values.abs().max())

    def restart(self, ritz: _Ritz) -> None:
        """Keep the share KEEP of the memory in Ritz vectors, and the rows that come next.

        The vectors kept beyond the wanted ones come from both ends evenly, whichever end is still open: those of its
        own end speed it up where the spectrum is dense there, those of the other end where that one reaches far.
        """
        s, m = self.settings, self.size
        keep = max(s.wanted, min(int(self.capacity * KEEP), self.capacity - 2 * s.block))
        top = s.largest + (keep - s.wanted) // 2
        kept = list(range(keep - top)) + list(range(m - top, m))
        combination = ritz.coordinates[:, kept].T.to(self.basis)
        for first in range(0, self.basis.shape[1], CHUNK):
            columns = slice(first, first + CHUNK)
            self.basis[:keep, columns] = combination @ self.basis[:m, columns]
        self.basis[keep : keep + self.width] = self.basis[m : m + self.width].clone()
        self.T.zero_()
        self.T[:keep, :keep] = torch.diag(ritz.values[kept])
        self.foreseen = (self.coupling @ ritz.coordinates[m - self.coupling.shape[1] :, kept]).T
        self.size, self._restarted = keep, True

    def measured(self, ritz: _Ritz, budget: StopReason, converged: bool) -> tuple[EigenEnds, bool]:
        """The wanted pairs with residuals by the operator itself, and whether more steps would make them better."""
        s = self.settings
        vectors = self.basis[: self.size].T @ ritz.coordinates[:, ritz.wanted].to(self.basis)
        vectors /= torch.linalg.vector_norm(vectors, dim=0)  # restarts leave a little of their round-off
        values = ritz.values[ritz.wanted]
        estimated = ritz.residuals[ritz.wanted]
        rounding = self.rounding(ritz)
        residuals = estimated + MARGIN * max(self.seen_noise, rounding)
        asked = (s.rtol * values.abs()).clamp_min(s.atol)
        out_of_reach = (asked <= rounding) & (self.seen_noise <= MARGIN * rounding)
        if not (converged and ((residuals <= asked) | out_of_reach).all()):
            enough = asked.clamp_min(self.floor(ritz))
            residuals = self._together(ritz, vectors) if converged else torch.full_like(values, inf)
            if not (residuals <= enough).all():
                values, residuals = rayleigh(self.operator, vectors)
                self.matvecs += s.wanted
        # a residual far above the recurrence's estimate is the matvec's round-off: more steps cannot lower it
        stuck = (estimated <= residuals / 4) | (estimated <= self.floor(ritz))
        reached = residuals <= asked
        errors = residuals / ritz.gaps()

        def end(part: slice, descending: bool) -> Eigenpairs:
            reason: StopReason = budget
            if (reached | stuck)[part].all():
                reason = "tolerance" if reached[part].all() else "noise floor"
            order = torch.argsort(values[part], descending=descending)
            pairs = [quantity[part][order] for quantity in (values, residuals, errors)]
            return Eigenpairs(pairs[0], vectors[:, part][:, order], pairs[1], pairs[2], reason)

        spread = float(ritz.values[-1] - ritz.values[0])
        beyond = _beyond(self.operator.dim, self.first_cycle, spread, self.random_share)
        largest, smallest = end(slice(0, s.largest), True), end(slice(s.largest, s.wanted), False)
        spectrum = torch.stack([ritz.values, ritz.residuals])
        noise = self.seen_noise if isnan(self.noise) else self.noise
        ends = EigenEnds(largest, smallest, "lanczos", self.matvecs, beyond, noise, spectrum)
        return ends, not bool((reached | stuck).all())

    def _together(self, ritz: _Ritz, vectors: Float[Tensor, "n k"]) -> Float64[Tensor, " k"]:
        """Residuals of all pairs from one product; measures the noise."""
        signs = draw_probes(len(ritz.wanted), 1, self.generator, torch.float64, "rademacher")[:, 0]
        last = ritz.coordinates[self.size - self.coupling.shape[1] : self.size, ritz.wanted]
        unknown = self.operator.apply((vectors @ signs.to(vectors.dtype))[:, None])[:, 0].double()
        self.matvecs += 1
        following = self.basis[self.size : self.size + self.width]
        known = following.T @ (self.coupling @ last).to(vectors)
        for i, value in enumerate(ritz.values[ritz.wanted]):
            unknown -= signs[i] * (value * vectors[:, i] + known[:, i])
        self.noise = norm(unknown) / len(signs) ** 0.5
        return torch.tensor([norm(signs[i] * known[:, i] + unknown) for i in range(len(signs))], dtype=torch.float64)


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


def _mixed(start: Tensor, random: Tensor, noise: float) -> Tensor:
    """The normalised sum of the start vectors' directions, with so much of the random vector."""
    columns = start.reshape(random.numel(), -1).to(random.dtype)
    lengths = torch.linalg.vector_norm(columns, dim=0)
    if not ((lengths > 0) & torch.isfinite(lengths)).all():
        raise ValueError(f"expected finite start vectors that are not zero, got lengths {lengths.tolist()}")
    total = (columns / lengths).sum(dim=1)
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
