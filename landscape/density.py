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
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf

import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.lanczos import lanczos
from landscape.operator import DenseOperator, SymmetricOperator
from landscape.probes import draw_probes
from landscape.results import Bracket, Progress, SpectralDensity, t_interval

REACH, RESOLUTION = 20.0, 40  # a = centre +- sinh(20) |b| in steps of half an e-fold
ROUNDS, FINER = 7, 11  # of these steps, each round but the first refines them by a factor of 5
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
    """Gauss rules of `starts` random vectors, `batch` of them at a time (memory: batch * steps vectors).

    active: leaves the eigenvalues of a known null space out; `dim` of the result is then the rank.

    >>> H = DenseOperator(torch.diag(torch.tensor([-1.0, 2.0, 5.0], dtype=torch.float64)))
    >>> density = spectral_density(H, torch.Generator().manual_seed(0), starts=2, steps=3)
    >>> [round(x, 9) for x in density.nodes[0].tolist()]  # as many steps as rows: the eigenvalues themselves
    [-1.0, 2.0, 5.0]
    """
    if starts < 2 or steps < 2 or batch < 1:
        raise ValueError(f"expected starts >= 2, steps >= 2 and batch >= 1, got {starts}, {steps} and {batch}")
    rank = operator.dim if active is None else active.rank
    steps = min(steps, rank)
    nodes = torch.zeros(starts, steps, dtype=torch.float64)
    weights = torch.zeros(starts, steps, dtype=torch.float64)
    matvecs = 0

    def report(done: int, _: int, state: str) -> None:
        if progress:
            progress(matvecs + done, starts * steps, f"density: {state}")

    for first in range(0, starts, batch):
        count = min(batch, starts - first)
        Z = draw_probes(operator.dim, count, generator, operator.dtype, "rademacher")
        if active is not None:
            Z = active.project(Z)
        seen = Z.double().square().sum(dim=0) / rank  # 1, or 1 on average: keeps the sums unbiased
        factorizations = lanczos(operator, Z, steps, report)
        matvecs += sum(len(f.T) for f in factorizations)
        for row, factorization, share in zip(range(first, starts), factorizations, seen, strict=False):
            size = len(factorization.T)  # below steps where the start vector's invariant subspace is complete
            values, vectors = torch.linalg.eigh(factorization.T)
            nodes[row, :size], weights[row, :size] = values, share * vectors[0].square()
    return SpectralDensity(nodes, weights, rank, matvecs)


def absolute_sum(density: SpectralDensity, confidence: float = 0.95) -> Bracket:
    """sum_i |lambda_i| by the Gauss rules, in the bounds of `absolute_bounds`, widened by the spread over start vectors."""
    rules = zip(density.nodes, density.weights, strict=True)
    below, above = torch.tensor([absolute_bounds(*rule) for rule in rules], dtype=torch.float64).T * density.dim
    middle = float((density.weights * density.nodes.abs()).sum(dim=1).mean()) * density.dim
    low, high = t_interval(below, confidence)[2], t_interval(above, confidence)[3]
    width = float((above - below).mean())
    return Bracket(middle, max(low, 0.0), high, f"quadrature width {width:.3g}, {len(below)} start vectors")


def absolute_bounds(nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"]) -> tuple[float, float]:
    """Lower and upper bound of the integral of |x| over any measure that has this m-point Gauss rule.

    A rule with weights of 0 is that of an invariant subspace: the measure itself.

    >>> nodes, weights = torch.tensor([[-1.0, 1.0], [0.5, 0.5]], dtype=torch.float64)  # E x = 0, E x^2 = 1, E x^3 = 0
    >>> absolute_bounds(nodes, weights)
    (0.0, 1.0)
    """
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
