"""The nuclear norm sum |lambda_i| from the Gauss rules of stochastic Lanczos quadrature, bracketed for any spectrum.

Lanczos with m steps gives a tridiagonal T (m, m), which fixes the moments of degree up to 2m - 2 of the start vector's spectral
measure.  The measures of at most m points with these moments are the rules of T(a): T with any number a for its last diagonal
entry (Golub 1973).  Among them are those with the least and the largest integral of |x| over all measures with these moments,
as a polynomial of degree 2m - 2 on one side of |x| touches it in m points at most.  The least has a node at 0, the kink of |x|,
so that T(a) is singular; the largest is searched for over a.

The value is the mean of two rules.  The Gauss rule of m - 1 points errs to a side that depends on where 0 lies between its
nodes; its anti-Gauss rule, that of T with its last off-diagonal entries times sqrt 2, errs about as far to the other side
(Laurie 1996).
"""

from functools import lru_cache
from math import inf

import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.eigen.lanczos import lanczos
from landscape.operators.operator import DenseOperator
from landscape.results import Bracket
from landscape.spectrum.rules import SpectralDensity

REACH, RESOLUTION = 20.0, 40  # a = centre +- sinh(20) |b| in steps of half an e-fold
ROUNDS, FINER = 7, 11  # of the search for the largest; points of each round but the first, which refine its steps by 5
FAR = 1e8  # largest |a|, in units of the largest node: a node there adds at most 1 / FAR to the integral, and costs eps FAR


def absolute_sum(density: SpectralDensity, confidence: float = 0.95) -> Bracket:
    """sum_i |lambda_i|, the nuclear norm: the mean of `absolute_integral` over start vectors.

    Bracket: the means of its lower and upper bounds, widened by the spread over start vectors (`rules`) at this confidence.
    """
    certain = float(density.known.abs().sum())
    shift, error = density.by_trace(torch.abs, confidence)
    below, middle, above = (density.rest * part + certain + shift for part in integrals_of_rules(density))
    values = density.nodes.abs() - density.slope(torch.abs) * density.nodes
    down, up = density.reach(values, middle, confidence, error)
    known = density.of_known(torch.abs)
    low, high = float(below.mean()) - down - known, float(above.mean()) + up + known
    note = f"quadrature width {float((above - below).mean()):.3g}, {len(below)} start vectors"
    return Bracket(float(middle.mean()), max(low, 0.0), high, note)


@lru_cache(maxsize=16)
def integrals_of_rules(density: SpectralDensity) -> Float64[Tensor, "3 starts"]:
    """`absolute_integral` of each start vector; cached, as several indices need them."""
    return torch.tensor([absolute_integral(*rule) for rule in density.rules()], dtype=torch.float64).T


def absolute_integral(nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"]) -> tuple[float, float, float]:
    """Lower bound, value and upper bound of the integral of |x| over a measure that has this m-point Gauss rule.

    A rule with weights of 0 is that of an invariant subspace: the measure itself.

    >>> nodes, weights = torch.tensor([[-1.0, 1.0], [0.5, 0.5]], dtype=torch.float64)  # E x = 0, E x^2 = 1, E x^3 = 0
    >>> low, value, high = absolute_integral(nodes, weights)
    >>> low, round(value, 9), high
    (0.0, 0.707106781, 1.0)
    """
    gauss = float((weights * nodes.abs()).sum())
    T, scale = _tridiagonal(nodes, weights)
    if T is None:
        return gauss, gauss, gauss
    size = scale * float(weights.sum())
    # T(a) that is singular has a node at 0: the lower bound
    least, unit = float(_ends(T, T.new_zeros(1))), float(T[-1, -2].abs())
    centre = least if abs(least) < FAR else float(T[-1, -1])

    def integrals(steps: Tensor) -> Float64[Tensor, " s"]:
        """Integrals by T(a), a = centre + unit sinh(step)."""
        return size * _absolute_integrals(T, centre + unit * torch.sinh(steps))

    # the upper bound: the largest integral over a, by a grid that closes in
    steps = torch.linspace(-REACH, REACH, 2 * RESOLUTION + 1, dtype=torch.float64)
    for _ in range(ROUNDS):  # the maximum lies between the neighbours of the best point of the grid
        found = integrals(steps)
        best = int(found.argmax().clamp(1, len(steps) - 2))
        steps = torch.linspace(float(steps[best - 1]), float(steps[best + 1]), FINER, dtype=torch.float64)
    below = size * float(_absolute_integrals(T, torch.tensor([least], dtype=torch.float64)))
    low, high = min(below, gauss), max(float(found.max()), gauss)
    return low, min(max(size * _anti_gauss_mean(T), low), high), high


def rules_of_moments(
    nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"], kinks: Float64[Tensor, " k"]
) -> tuple[Float64[Tensor, "a m"], Float64[Tensor, "a m"]]:
    """Nodes, ascending, and weights of the rules T(a) that have a node at a kink, and of a grid of a.

    Over all measures with these moments the integral of a function that is linear but for one kink is least, or largest, where
    T(a) has a node there, as for |x|; the other end is found to the grid's resolution.  A rule that is the measure itself has
    no others.
    """
    T, scale = _tridiagonal(nodes, weights)
    if T is None:
        x, order = nodes.sort()
        return x[None], weights[order][None]
    ends = _ends(T, kinks / scale)
    steps = T[-1, -1] + T[-1, -2].abs() * torch.sinh(torch.linspace(-REACH, REACH, 2 * RESOLUTION + 1, dtype=T.dtype))
    values, shares = _rules(T, torch.cat([ends[ends.isfinite()], steps]))
    return scale * values, float(weights.sum()) * shares


def _tridiagonal(nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"]) -> tuple[Tensor | None, float]:
    """T of this rule in units of the largest node, and this; None for a rule that is the measure itself."""
    scale = float(nodes.abs().max()) if len(nodes) else 0.0
    if scale == 0 or int((weights > 0).sum()) == 1 or not (weights > 0).all():
        return None, scale
    (rule,) = lanczos(DenseOperator(torch.diag(nodes / scale)), weights.sqrt()[:, None], len(nodes))
    return (rule.T if len(rule.T) > 1 else None), scale  # of one row: all nodes are the same to round-off


def _anti_gauss_mean(T: Float64[Tensor, "m m"]) -> float:
    """The integral of |x| by the mean of the (m - 1)-point Gauss rule and its anti-Gauss rule."""
    anti = T.clone()
    anti[-1, -2] *= 2**0.5
    anti[-2, -1] *= 2**0.5
    spectra = (torch.linalg.eigh(rule) for rule in (T[:-1, :-1], anti))
    return sum(float((S[0].square() * values.abs()).sum()) for values, S in spectra) / 2


def _ends(T: Float64[Tensor, "m m"], places: Float64[Tensor, " p"]) -> Float64[Tensor, " p"]:
    """The last diagonal entries a that give T(a) a node at each place; infinite where T without its last row has one there."""
    x, S = torch.linalg.eigh(T[:-1, :-1])
    return places + T[-1, -2].square() * (S[-1].square() / (x - places[:, None])).nan_to_num(nan=inf).sum(dim=1)


def _absolute_integrals(T: Float64[Tensor, "m m"], ends: Float64[Tensor, " s"]) -> Float64[Tensor, " s"]:
    """The integral of |x| by the rules of T(a), a in ends."""
    values, weights = _rules(T, ends)
    return (weights * values.abs()).sum(dim=1)


def _rules(
    T: Float64[Tensor, "m m"], ends: Float64[Tensor, " s"]
) -> tuple[Float64[Tensor, "s m"], Float64[Tensor, "s m"]]:
    """Nodes and weights of the rules of T(a), a in ends, for nodes in units of the largest.

    Beyond FAR the node at a has no weight left: the rule is that of T without its last row.
    """
    rules = T.repeat(len(ends), 1, 1)
    rules[:, -1, -1] = ends.clamp(-FAR, FAR)
    rules[ends.abs() > FAR, -1, -2] = rules[ends.abs() > FAR, -2, -1] = 0.0
    values, vectors = torch.linalg.eigh(rules)
    return values, vectors[:, 0].square()
