"""The whole spectrum, by stochastic Lanczos quadrature (Golub and Meurant 1994; Ubaru, Chen and Saad 2017).

For a start vector z of length 1 the Ritz values theta_j of m Lanczos steps and the squared first components w_j of T's
eigenvectors are the Gauss rule of the measure mu_z(x) = sum_i (z . v_i)^2 delta(x - lambda_i):

    z^T f(H) z = sum_j w_j f(theta_j)     exactly for polynomials f of degree below 2m
    tr f(H)    = n E z^T f(H) z           for z = +-1 / sqrt(n)

sum |lambda_i|, which has a kink at 0, is bracketed without any assumption on the spectrum.  In y = x^2 it is the
integral of sqrt(y), whose derivatives alternate in sign on y > 0; hence the Gauss rule in y lies above it and the
Gauss-Radau rule with a node at y = 0 lies below.  Both rules follow from the m nodes in x alone.

Where a null space is known, with P the projector off it and r the rank of P, the start vectors are P z / |P z|.  The density is
then that of the r other eigenvalues, and sums over them are r times its integrals.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.lanczos import lanczos
from landscape.operator import DenseOperator, SymmetricOperator
from landscape.probes import draw_probes
from landscape.results import Bracket, Progress, SpectralDensity, t_interval


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
    """sum_i |lambda_i|: the quadrature's bracket, widened by the spread over start vectors."""
    rules = zip(density.nodes, density.weights, strict=True)
    below, above = torch.tensor([absolute_bounds(*rule) for rule in rules], dtype=torch.float64).T * density.dim
    middle = float((below + above).mean()) / 2
    low, high = t_interval(below, confidence)[2], t_interval(above, confidence)[3]
    width = float((above - below).mean())
    return Bracket(middle, max(low, 0.0), high, f"quadrature width {width:.3g}, {len(below)} start vectors")


def absolute_bounds(nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"]) -> tuple[float, float]:
    """Lower and upper bound of the integral of |x| over any measure that has this m-point Gauss rule.

    >>> nodes, weights = torch.tensor([[-1.0, 1.0], [0.5, 0.5]], dtype=torch.float64)  # E x = 0, E x^2 = 1, E x^3 = 0
    >>> absolute_bounds(nodes, weights)
    (0.0, 1.0)
    """
    scale = float(nodes.abs().max())
    if scale == 0:
        return 0.0, 0.0
    squares = (nodes / scale).square()
    kept = weights > 0
    rule = DenseOperator(torch.diag(squares[kept]))
    (jacobi,) = lanczos(rule, weights[kept].sqrt()[:, None], steps=max(len(nodes) // 2, 1))
    total, size = float(weights.sum()), len(jacobi.T)
    above = _root_integral(jacobi.T)
    below = above
    if size < int(kept.sum()):  # else the rule in y has all the measure's points, and is exact
        radau = jacobi.T.clone()
        # the last diagonal entry that makes the matrix singular: its last pivot becomes 0
        pivot = torch.tensor(0.0, dtype=torch.float64)
        for j in range(size):
            coupling = radau[j, j - 1].square() / pivot if j else torch.zeros_like(pivot)
            pivot = radau[j, j] - coupling
        radau[-1, -1] -= pivot
        below = _root_integral(radau)
    return scale * total * min(below, above), scale * total * above  # the roots may cross by their round-off


def _root_integral(jacobi: Float64[Tensor, "m m"]) -> float:
    """The integral of sqrt(y) by the rule of a Jacobi matrix."""
    values, vectors = torch.linalg.eigh(jacobi)
    return float((vectors[0].square() * values.clamp_min(0).sqrt()).sum())
