"""The spectral density, by stochastic Lanczos quadrature (Golub and Meurant 1994; Ubaru, Chen and Saad 2017).

For a start vector z of length 1 the Ritz values theta_j of m Lanczos steps and the squared first components w_j of T's
eigenvectors are the Gauss rule of the measure mu_z(x) = sum_i (z . v_i)^2 delta(x - lambda_i):

    z^T f(H) z = sum_j w_j f(theta_j)     exactly for polynomials f of degree below 2m
    tr f(H)    = n E z^T f(H) z           for independent entries of mean 0 and variance 1 / n

Where a null space is known, with P the projector off it and r the rank of P, the start vectors are P z / |P z|.  The density is
then that of the r other eigenvalues, and sums over them are r times its integrals.  |P z|^2 has the mean r, so these are ratio
estimates: unbiased for a Gaussian z, else with a bias of sd(|P z|^2) / r standard deviations.  Without the division by |P z|^2
its skewed spread would be added to every sum.

**Start vectors.**  Entries are random signs, which are exact for a diagonal matrix, times magnitudes with squares uniform on
[1 - UNEVEN, 1 + UNEVEN], which have a 600th of the variance of Gaussian entries there.  With signs alone, all k start vectors
project onto the same line of the eigenspace of an eigenvalue that two rows share, with the probability 2^(1 - k): it would seem
simple.  With uneven magnitudes the projections differ by an angle of about 0.03, 30 times what SAME resolves.

**Known eigenvalues.**  A few dominant eigenvalues are most of the variance over start vectors.  Eigenpairs found before are
projected out like a null space, and each counts as one eigenvalue instead of (z . v)^2.  So do those that the first runs find:
a Ritz pair with a residual of at most SETTLED times its distance to the others has converged, and its eigenvalue is simple
where two start vectors have converged to the same eigenvector (of a multiple one, each converges to another).  Its node is
removed from the rules of the start vectors that found it, which leaves the Gauss rule of the rest of their measure.  Later
start vectors are projected off v.

**Few long runs or many short ones.**  For a given number of products, longer runs determine sum |lambda| better where its
bounds (`absolute_sum`) are wide or more eigenvalues converge; more runs do where start vectors differ.  `Lengths` estimates
both during the first runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, inf, isnan
from statistics import NormalDist

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.eigen.krylov import MARGIN
from landscape.eigen.lanczos import LanczosFactorization, lanczos
from landscape.eigen.pairs import EigenEnds
from landscape.errors import InputError
from landscape.linalg import gram, norm, orthogonalise
from landscape.operators.operator import DenseOperator, ProjectedOperator, SymmetricOperator
from landscape.results import Progress
from landscape.spectrum.absolute_sum import absolute_integral
from landscape.spectrum.rules import SpectralDensity

UNEVEN = 0.1  # spread of the squares of a start vector's entries about 1
SETTLED = 1e-4  # largest error of an eigenvector found by the runs
FOUND, CLOSE = 1e-2, 0.1  # largest error of an eigenvector found before, and its residual over the eigenvalue
SAME = 1e-6  # largest 1 - cos^2 between equal eigenvectors
# by default: Student's interval of three is half as long again, and kernels favour blocks of four
FEWEST_STARTS = 4
FIRST_LOOK, GROWTH = 12, 4 / 3  # steps
CONFIDENCE = 0.95  # of the interval that is to be short


@dataclass(frozen=True, eq=False)
class ActiveSpace:
    """Complement of the known null space of an operator P H P: the orthogonal projector `project(V) -> P V` and its rank."""

    project: Callable[[Tensor], Tensor]
    rank: int

    def __post_init__(self) -> None:
        if self.rank < 1:
            raise ValueError(f"expected a projector of rank 1 or more, got {self.rank}")


def spectral_density(
    operator: SymmetricOperator,
    generator: torch.Generator,
    matvecs: int = 192,
    starts: int | None = None,
    longest: int | None = None,
    batch: int = FEWEST_STARTS,
    progress: Progress | None = None,
    active: ActiveSpace | None = None,
    ends: EigenEnds | None = None,
    trace: tuple[float, float] | None = None,
    watch: Callable[[Sequence[LanczosFactorization]], object] | None = None,
) -> SpectralDensity:
    """Gauss rules of random start vectors, one Lanczos run each.

    matvecs: products in all, at most.
    starts: number of start vectors (2 or more), each with matvecs // starts steps; None: length of the runs by `Lengths`, and
        as many of them as matvecs allow.  longest: the most steps of a run; None: limited by matvecs and the rank alone.
    batch: runs at a time (memory: (batch + 1) vectors for each step of a run); with 1, runs find no `known` eigenvalues.
    active: excludes the eigenvalues of a known null space; `dim` of the result is then the rank.
    ends: eigenpairs found before by `extreme_eigenpairs`; those that are accurate enough are `known` from the beginning.
    trace: of the operator, with its standard error, where known more accurately than from these start vectors.
    watch: called with the first runs, which are of H itself, before `ends` are projected out of them.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([5.0, -1.0, *[2.0] * 98], dtype=torch.float64)))
    >>> density = spectral_density(H, torch.Generator().manual_seed(0), matvecs=12)
    >>> [round(x, 9) for x in density.known.tolist()], density.rest, round(density.integral(torch.abs).value, 9)
    ([-1.0, 5.0], 98, 202.0)
    """
    least = FEWEST_STARTS if starts is None else starts
    if least < 2 or matvecs < 2 * least or batch < 1:
        raise InputError(
            f"expected starts >= 2, matvecs >= 2 a start vector and batch >= 1, got {least}, {matvecs} and {batch}"
        )
    found = _Runs(
        operator, generator, active, ends, lambda done, state: progress and progress(done, matvecs, state), watch
    )
    most = min(matvecs // least, found.rank, longest or found.rank)
    steps, count = most, least
    if starts is None:
        lengths = Lengths(matvecs, most, found.rank - len(found.known), trace is not None)
        found.add(min(batch, least), most, lengths)
        steps = lengths.best or most
        count = len(found.rules) + (matvecs - found.matvecs) // steps
    while len(found.rules) < count:
        found.add(min(count - len(found.rules), batch * most // steps), steps)
    return found.density(trace)


class Lengths:
    """Stopping rule for the length of runs, for the shortest interval of sum |lambda| with all products.

    The interval is estimated while the first runs grow; they stop at the first estimate that is wider than the last.
    best: number of steps.  traced: whether the trace is known.
    """

    def __init__(self, matvecs: int, most: int, rest: int, traced: bool) -> None:
        self.matvecs, self.most, self.rest, self.traced = matvecs, most, rest, traced
        self.best, self.half, self.next = 0, inf, FIRST_LOOK

    def __call__(self, runs: Sequence[tuple[Float64[Tensor, "m m"], float]]) -> bool:
        """Whether these runs, T and |r| of each, are long enough."""
        steps = max(len(T) for T, _ in runs)
        if steps < min(self.next, self.most):
            return False
        self.next, half = ceil(GROWTH * steps), self.half_width(runs, steps)
        if half >= self.half:
            return True
        self.best, self.half = steps, half
        return False

    def half_width(self, runs: Sequence[tuple[Float64[Tensor, "m m"], float]], steps: int) -> float:
        """Half width of the interval from runs of this length, with as many start vectors as products allow."""
        nodes, weights, found = [], [], 0
        for T, length in runs:
            values, S = torch.linalg.eigh(T)
            known = settled(values, S, length)
            nodes.append(values[~known])
            weights.append(S[0, ~known].square())
            found += int(known.sum())
        rest, starts = max(self.rest - found / len(runs), 0.0), self.matvecs / steps
        low, _, high = absolute_integral(nodes[0], weights[0])  # of one run alone, as it costs as much as a product
        x, w = torch.cat(nodes), torch.cat(weights) / len(runs)
        unit = float(x.abs().max()) or 1.0 if len(x) else 1.0  # so that squares stay in the range of floats
        x = x / unit
        squares = float((w * x.square()).sum())
        if self.traced and squares:
            squares -= float((w * x * x.abs()).sum()) ** 2 / squares
        # the variance over random signs is 2 sum f(lambda)^2 at most
        spread = unit * (2 * rest * max(squares, 0.0) / starts) ** 0.5
        return NormalDist().inv_cdf((1 + CONFIDENCE) / 2) * spread + rest * (high - low) / 2


class _Runs:
    """The rules of the runs so far, and the known eigenvalues with their vectors V.

    values: eigenvalues of the pairs found before, which `deflated`, the operator projected off their vectors, lacks; error: the
    largest of their vectors' errors.  rules: nodes, weights, and whether they are the start vector's measure itself.
    """

    def __init__(
        self,
        operator: SymmetricOperator,
        generator: torch.Generator,
        active: ActiveSpace | None,
        ends: EigenEnds | None,
        progress: Callable[[int, str], object],
        watch: Callable[[Sequence[LanczosFactorization]], object] | None,
    ) -> None:
        self.watch, self.operator = watch, operator
        self.generator, self.active, self.progress = generator, active, progress
        self.rank = operator.dim if active is None else active.rank
        self.known, self.residuals, V, self.error = found_before(ends, operator, generator.device)
        self.values = self.known
        self.deflated = ProjectedOperator(operator, lambda X: X - V @ (V.T @ X)) if V.shape[1] else operator
        self.V, self.matvecs = V, 0
        self.noise = 0.0 if ends is None or isnan(ends.noise) else ends.noise  # of a product
        self.rules: list[tuple[Float64[Tensor, " m"], Float64[Tensor, " m"], bool]] = []

    def add(self, count: int, steps: int, enough: Lengths | None = None) -> None:
        """Add `count` runs in one batch.  enough: stopping rule of their length."""
        if len(self.known) == self.rank:  # no unknown eigenvalue is left
            self.rules += [(self.known[:0], self.known[:0], True)] * count
            return
        Z = draw_starts(self.operator.dim, count, self.generator, self.operator.dtype)
        if self.active is not None:
            Z = self.active.project(Z)
        watch = None if self.rules else self.watch
        if watch is None:
            Z = Z - self.V @ (self.V.T @ Z)
        before, size = self.matvecs, float(self.known.abs().max()) if len(self.known) else 0.0

        def report(done: int, _: int, state: str) -> None:
            self.progress(before + done, f"density: {state}")

        runs = lanczos(self.deflated if watch is None else self.operator, Z, steps, report, size, enough)
        self.matvecs += sum(len(run.T) for run in runs)
        if watch is not None:
            watch(runs)
            runs = [without(run, self.V, self.values, self.error) for run in runs]
        spectra = [torch.linalg.eigh(run.T) for run in runs]
        others = [torch.ones_like(values, dtype=torch.bool) for values, _ in spectra]
        if not self.rules and count > 1:
            known, residuals, V, others = found_by_all(runs, spectra)
            rounding = torch.finfo(self.operator.dtype).eps * max(size, *(float(x.abs().max()) for x, _ in spectra))
            residuals += MARGIN * max(self.noise, rounding) + pushed(known, self.known, self.residuals)
            self.residuals = torch.cat([self.residuals, residuals])
            self.known, self.V = torch.cat([self.known, known]), torch.cat([self.V, V], dim=1)
        for run, (values, S), left in zip(runs, spectra, others, strict=True):
            mass = S[0, left].square()
            self.rules.append((values[left], mass / mass.sum(), norm(run.r) == 0))

    def density(self, trace: tuple[float, float] | None) -> SpectralDensity:
        """The density of all rules, in one table: shorter ones, and those that are the measure itself, end in weights of 0."""
        longest = max(len(nodes) + whole for nodes, _, whole in self.rules)
        nodes = torch.zeros(len(self.rules), longest, dtype=torch.float64)
        weights = torch.zeros_like(nodes)
        for i, (at, mass, _) in enumerate(self.rules):
            nodes[i, : len(at)], weights[i, : len(at)] = at, mass
        whole = torch.tensor([whole for _, _, whole in self.rules])
        known, order = self.known.sort()
        return SpectralDensity(
            nodes, weights, self.rank, self.matvecs, known, whole, trace, missed(known, self.residuals[order])
        )


def draw_starts(n: int, count: int, generator: torch.Generator, dtype: torch.dtype) -> Float[Tensor, "n count"]:
    """Random signs times uneven magnitudes; entries of mean 0 and variance 1."""
    rows = torch.empty(count, n, dtype=dtype, device=generator.device)
    for row in rows:
        row.uniform_(-1, 1, generator=generator)
    return torch.copysign((1 - UNEVEN + 2 * UNEVEN * rows.abs()).sqrt(), rows).T.contiguous()


def found_before(
    ends: EigenEnds | None, operator: SymmetricOperator, device: torch.device
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"], Float[Tensor, "n k"], float]:
    """Eigenvalues, residuals, orthonormal vectors and the largest vector error, of the pairs that are accurate enough."""
    if ends is None:
        none = torch.zeros(0, dtype=torch.float64)
        return none, none, torch.zeros(operator.dim, 0, dtype=operator.dtype, device=device), 0.0
    pairs = (ends.largest,) if ends.smallest is ends.largest else (ends.largest, ends.smallest)
    names = "values", "residuals", "vector_errors"
    values, residuals, errors = (torch.cat([getattr(pair, name) for pair in pairs]) for name in names)
    good = (errors < FOUND) & (residuals <= CLOSE * values.abs())
    vectors = torch.cat([pair.vectors for pair in pairs], dim=1)[:, good.to(ends.largest.vectors.device)]
    return values[good], residuals[good], torch.linalg.qr(vectors).Q, float(errors[good].max()) if good.any() else 0.0


def without(
    run: LanczosFactorization, V: Float[Tensor, "n k"], values: Float64[Tensor, " k"], error: float
) -> LanczosFactorization:
    """The Lanczos run of P H P, P = 1 - V V^T, from P z, without further products, for eigenvectors V of H: P and H commute.

    P Q spans its Krylov space, with the matrix T - C diag(values) C^T of P H P and the Gram matrix 1 - C C^T, C = Q^T V.
    Directions of Q within V, up to round-off and the `error` of V, are left out.
    """
    if not len(values):
        return run
    C, steps = gram(run.Q, V).cpu(), len(run.T)
    size, U = torch.linalg.eigh(torch.eye(steps, dtype=torch.float64) - C @ C.T)
    kept = size > max(torch.finfo(run.Q.dtype).eps ** 0.5, (10 * error) ** 2)
    roots, U = size[kept].sqrt(), U[:, kept]
    B = U / roots
    H = B.T @ (run.T - C @ torch.diag(values) @ C.T) @ B
    (small,) = lanczos(DenseOperator((H + H.T) / 2), (roots * U[0])[:, None], len(roots))
    B = B @ small.Q
    Q = run.Q @ B.to(run.Q) - V @ (C.T @ B).to(V)
    r = run.r[None].clone()
    orthogonalise(r, torch.cat([V, Q], dim=1).T)
    return LanczosFactorization(Q, small.T, r[0] * float(B[-1, -1]))


def missed(values: Float64[Tensor, " k"], residuals: Float64[Tensor, " k"]) -> Float64[Tensor, " k"]:
    """`SpectralDensity.missed` of known eigenvalues with these residuals; 0 for an eigenvalue of 0."""
    share = torch.where(values == 0, 0.0, residuals / values.abs())
    return 4 * share * share.clamp_max(1.0)


def pushed(
    values: Float64[Tensor, " k"], known: Float64[Tensor, " l"], residuals: Float64[Tensor, " l"]
) -> Float64[Tensor, " k"]:
    """Bound of the distance from eigenvalues of the deflated operator to eigenvalues of H.

    The known pairs couple to them by their residuals r: (hypot(g, 2 r) - g) / 2 for each at the distance g (Li and Li 2005).
    """
    gaps, reach = (values[:, None] - known).abs(), 2 * residuals.expand(len(values), -1)
    return (torch.hypot(gaps, reach) - gaps).sum(dim=1) / 2


def settled(values: Float64[Tensor, " m"], S: Float64[Tensor, "m m"], length: float) -> Bool[Tensor, " m"]:
    """Mask of the Ritz pairs that have converged.  values, S: eigenpairs of T; length: |r|."""
    far = torch.tensor([inf], dtype=torch.float64)
    gaps = torch.diff(values, prepend=-far, append=far)
    return length * S[-1].abs() <= SETTLED * torch.minimum(gaps[:-1], gaps[1:])


def found_by_all(
    runs: Sequence[LanczosFactorization], spectra: Sequence[tuple[Tensor, Tensor]]
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"], Float[Tensor, "n k"], list[Bool[Tensor, " m"]]]:
    """The simple eigenvalues that all runs have found, with residuals and vectors, and a mask of each run's other nodes."""
    masks = [settled(values, S, norm(run.r)) for run, (values, S) in zip(runs, spectra, strict=True)]
    vectors = [run.Q @ S[:, mask].to(run.Q) for run, (_, S), mask in zip(runs, spectra, masks, strict=True)]
    same = [gram(vectors[0], other).cpu().square() > 1 - SAME for other in vectors]
    common = torch.stack([match.any(dim=1) for match in same]).all(dim=0)
    others = []
    for match, mask in zip(same, masks, strict=True):
        others.append(~mask)
        others[-1][mask] = ~match[common].any(dim=0)
    values, S = spectra[0]
    residuals = norm(runs[0].r) * S[-1].abs()
    return values[masks[0]][common], residuals[masks[0]][common], vectors[0][:, common], others
