"""The whole spectrum, by stochastic Lanczos quadrature (Golub and Meurant 1994; Ubaru, Chen and Saad 2017).

For a start vector z of length 1 the Ritz values theta_j of m Lanczos steps and the squared first components w_j of T's
eigenvectors are the Gauss rule of the measure mu_z(x) = sum_i (z . v_i)^2 delta(x - lambda_i):

    z^T f(H) z = sum_j w_j f(theta_j)     exactly for polynomials f of degree below 2m
    tr f(H)    = n E z^T f(H) z           for z = +-1 / sqrt(n)

sum |lambda_i|, which has a kink at 0, is bracketed without any assumption on the spectrum.  The measures of at most m points
that share the moments of degree up to 2m - 2 are the rules of T(a), which is T with any number a for its last diagonal
entry (Golub 1973).  The least and the largest integral of |x| over all measures with these moments are among theirs, as a
polynomial of degree 2m - 2 on one side of |x| touches it in m points at most.  The least has a node at 0: T(a) is singular.

Where a null space is known, with P the projector off it and r the rank of P, the start vectors are P z / |P z|.  The density is
then that of the r other eigenvalues, and sums over them are r times its integrals.

**Eigenvalues that are found.**  A few eigenvalues that dominate are most of the variance over start vectors, and those are what
the recurrence finds first.  A Ritz pair with a residual of at most SETTLED times its distance to the others is an eigenpair;
its eigenvalue is simple where two start vectors come to the same eigenvector (of a multiple one each sees another, unless
the operator is diagonal: then what is left of it is among the others).  It is then
counted as the one eigenvalue that it is, instead of (z . v)^2 times: its node is taken out of the rules of the start vectors
that found it, what is left of them being the Gauss rules of what is left of their measures, and the start vectors to come are
projected off v, as off a null space.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.lanczos import LanczosFactorization, lanczos, norm
from landscape.operator import DenseOperator, SymmetricOperator
from landscape.probes import draw_probes
from landscape.quadratic import gram
from landscape.results import Bracket, Progress, SpectralDensity, t_interval

REACH, RESOLUTION = 20.0, 40  # a = centre +- sinh(20) |b| in steps of half an e-fold
ROUNDS, FINER = 7, 11  # of these steps, each round but the first refines them by a factor of 5
SETTLED = 1e-4  # the error of an eigenvector
SAME = 1e-6  # by which the squared cosine between two of them may miss 1
FAR = 1e8  # in units of the largest node; a node there adds 1 / FAR to the integral at most, and costs eps FAR in precision


@dataclass(frozen=True, eq=False)
class ActiveSpace:
    """What a known null space of P H P leaves: the orthogonal projector `project(V) -> P V` and its rank."""

    project: Callable[[Tensor], Tensor]
    rank: int

    def __post_init__(self) -> None:
        if self.rank < 1:
            raise ValueError(f"expected a projector of rank 1 or more, got {self.rank}")


def spectral_density(
    operator: SymmetricOperator,
    generator: torch.Generator,
    starts: int = 6,
    steps: int = 32,
    batch: int = 2,
    progress: Progress | None = None,
    active: ActiveSpace | None = None,
) -> SpectralDensity:
    """Gauss rules of `starts` random vectors, `batch` of them at a time (memory: (batch + 1) * steps vectors).

    active: leaves the eigenvalues of a known null space out; `dim` of the result is then the rank.  Eigenvalues are found where
    the batch is 2 or more.

    >>> H = DenseOperator(torch.diag(torch.tensor([5.0, -1.0, *[2.0] * 98], dtype=torch.float64)))
    >>> density = spectral_density(H, torch.Generator().manual_seed(0), starts=2, steps=3)
    >>> [round(x, 9) for x in density.known.tolist()], density.rest, round(density.integral(torch.abs).value, 9)
    ([-1.0, 5.0], 98, 202.0)
    """
    if starts < 2 or steps < 2 or batch < 1:
        raise ValueError(f"expected starts >= 2, steps >= 2 and batch >= 1, got {starts}, {steps} and {batch}")
    rank = operator.dim if active is None else active.rank
    steps = min(steps, rank)
    nodes = torch.zeros(starts, steps, dtype=torch.float64)
    weights = torch.zeros(starts, steps, dtype=torch.float64)
    complete = torch.zeros(starts, dtype=torch.bool)
    known = torch.zeros(0, dtype=torch.float64)
    V = torch.zeros(operator.dim, 0, dtype=operator.dtype, device=generator.device)
    matvecs = 0

    def report(done: int, _: int, state: str) -> None:
        if progress:
            progress(matvecs + done, starts * steps, f"density: {state}")

    for first in range(0, starts, batch):
        count = min(batch, starts - first)
        Z = draw_probes(operator.dim, count, generator, operator.dtype, "rademacher")
        if active is not None:
            Z = active.project(Z)
        if len(known) == rank:
            complete[first:] = True
            break
        Z = Z - V @ (V.T @ Z)
        factorizations = lanczos(operator, Z, steps, report, float(known.abs().max()) if len(known) else 0.0)
        matvecs += sum(len(f.T) for f in factorizations)
        rules = [torch.linalg.eigh(f.T) for f in factorizations]
        others = [torch.ones_like(values, dtype=torch.bool) for values, _ in rules]
        if first == 0 and count > 1:
            known, V, others = found_by_all(factorizations, rules)
        # 1, or 1 on average: keeps the sums unbiased
        seen = Z.double().square().sum(dim=0).cpu() / max(rank - len(known), 1)
        for i, (values, vectors) in enumerate(rules):
            left = int(others[i].sum())
            nodes[first + i, :left] = values[others[i]]
            weights[first + i, :left] = seen[i] * vectors[0, others[i]].square()
            complete[first + i] = len(values) < steps  # the start vector's invariant subspace
    return SpectralDensity(nodes, weights, rank, matvecs, known, complete)


def found_by_all(
    runs: Sequence[LanczosFactorization], rules: Sequence[tuple[Tensor, Tensor]]
) -> tuple[Float64[Tensor, " k"], Float[Tensor, "n k"], list[Bool[Tensor, " m"]]]:
    """The simple eigenvalues that all runs have found, with vectors, and which nodes of each run are others."""
    vectors, settled = [], []
    for run, (values, S) in zip(runs, rules, strict=True):
        far = torch.tensor([inf], dtype=torch.float64)
        steps = torch.diff(values, prepend=-far, append=far)
        settled.append(norm(run.r) * S[-1].abs() <= SETTLED * torch.minimum(steps[:-1], steps[1:]))
        vectors.append(run.Q @ S[:, settled[-1]].to(run.Q))
    same = [gram(vectors[0], other).cpu().square() > 1 - SAME for other in vectors]
    common = torch.stack([match.any(dim=1) for match in same]).all(dim=0)
    others = []
    for match, mask in zip(same, settled, strict=True):
        others.append(~mask)
        others[-1][mask] = ~match[common].any(dim=0)
    return rules[0][0][settled[0]][common], vectors[0][:, common], others


def absolute_sum(density: SpectralDensity, confidence: float = 0.95) -> Bracket:
    """sum_i |lambda_i| by the Gauss rules, in the bounds of `absolute_bounds`, widened by the spread over start vectors."""
    certain = float(density.known.abs().sum())
    below, above = (density.rest * bound + certain for bound in bounds_of_rules(density))
    middle = float((density.weights * density.nodes.abs()).sum(dim=1).mean()) * density.rest + certain
    low, high = t_interval(below, confidence)[2], t_interval(above, confidence)[3]
    width = float((above - below).mean())
    return Bracket(middle, max(low, 0.0), high, f"quadrature width {width:.3g}, {len(below)} start vectors")


@lru_cache(maxsize=16)
def bounds_of_rules(density: SpectralDensity) -> tuple[Float64[Tensor, " starts"], Float64[Tensor, " starts"]]:
    """`absolute_bounds` of each start vector; several indices need them."""
    below, above = torch.tensor([absolute_bounds(*rule) for rule in density.rules()], dtype=torch.float64).T
    return below, above


def absolute_bounds(nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"]) -> tuple[float, float]:
    """Lower and upper bound of the integral of |x| over any measure that has this m-point Gauss rule.

    A rule with weights of 0 is that of an invariant subspace: the measure itself.

    >>> nodes, weights = torch.tensor([[-1.0, 1.0], [0.5, 0.5]], dtype=torch.float64)  # E x = 0, E x^2 = 1, E x^3 = 0
    >>> absolute_bounds(nodes, weights)
    (0.0, 1.0)
    """
    if not len(nodes):
        return 0.0, 0.0
    kept, scale = weights > 0, float(nodes.abs().max())
    gauss = float((weights * nodes.abs()).sum())
    if scale == 0 or int(kept.sum()) == 1 or not kept.all():
        return gauss, gauss
    (rule,) = lanczos(DenseOperator(torch.diag(nodes / scale)), weights.sqrt()[:, None], len(nodes))
    T, size = rule.T, scale * float(weights.sum())
    if len(T) == 1:  # all nodes are the same to round-off
        return gauss, gauss
    least, unit = _singular_end(T), float(T[-1, -2].abs())
    centre = least if abs(least) < FAR else float(T[-1, -1])

    def integrals(steps: Tensor) -> Float64[Tensor, " s"]:
        """At a = centre + unit sinh(step)."""
        return size * _absolute_integrals(T, centre + unit * torch.sinh(steps))

    steps = torch.linspace(-REACH, REACH, 2 * RESOLUTION + 1, dtype=torch.float64)
    for _ in range(ROUNDS):  # the largest lies between the neighbours of the largest of the grid
        found = integrals(steps)
        best = int(found.argmax().clamp(1, len(steps) - 2))
        steps = torch.linspace(float(steps[best - 1]), float(steps[best + 1]), FINER, dtype=torch.float64)
    below = size * float(_absolute_integrals(T, torch.tensor([least], dtype=torch.float64)))
    return min(below, gauss), max(float(found.max()), gauss)


def _singular_end(T: Float64[Tensor, "m m"]) -> float:
    """The last diagonal entry that makes T singular: its last pivot becomes 0."""
    pivot, coupling = float(T[0, 0]), 0.0
    for j in range(1, len(T)):
        coupling = float(T[j, j - 1]) ** 2 / pivot if pivot else inf
        pivot = float(T[j, j]) - coupling
    return coupling


def _absolute_integrals(T: Float64[Tensor, "m m"], ends: Float64[Tensor, " s"]) -> Float64[Tensor, " s"]:
    """The integral of |x| by the rules of T with each of `ends` as its last diagonal entry, for T of size 1.

    Beyond FAR that entry's node has no weight left, and the rule is that of T without its last row.
    """
    rules = T.repeat(len(ends), 1, 1)
    rules[:, -1, -1] = ends.clamp(-FAR, FAR)
    rules[ends.abs() > FAR, -1, -2] = rules[ends.abs() > FAR, -2, -1] = 0.0
    values, vectors = torch.linalg.eigh(rules)
    return (vectors[:, 0].square() * values.abs()).sum(dim=1)
