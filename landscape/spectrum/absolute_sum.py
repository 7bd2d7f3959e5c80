"""sum |lambda_i| from the Gauss rules of stochastic Lanczos quadrature, bracketed without any assumption on the spectrum.

|x| has a kink at 0.  The measures of at most m points that share the moments of degree up to 2m - 2 are the rules of T(a),
which is T with any number a for its last diagonal entry (Golub 1973).  The least and the largest integral of |x| over all
measures with these moments are among theirs, as a polynomial of degree 2m - 2 on one side of |x| touches it in m points at
most.  The least has a node at 0: T(a) is singular.

The value is the mean of two rules.  The Gauss rule of m - 1 points is off to one side or the other, depending on where 0 lies
between its nodes; its anti-Gauss rule, that of T with its last off-diagonal entries times the root of 2, is off about as far to
the other side (Laurie 1996).
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
ROUNDS, FINER = 7, 11  # of these steps, each round but the first refines them by a factor of 5
FAR = 1e8  # in units of the largest node; a node there adds 1 / FAR to the integral at most, and costs eps FAR in precision


def absolute_sum(density: SpectralDensity, confidence: float = 0.95) -> Bracket:
    """sum_i |lambda_i|, the nuclear norm: the mean of `absolute_integral` over start vectors.

    The bracket is made of the means of its lower and upper bounds, widened by what start vectors differ by (`rules`) at this
    confidence.
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
    """`absolute_integral` of each start vector; several indices need them."""
    return torch.tensor([absolute_integral(*rule) for rule in density.rules()], dtype=torch.float64).T


def absolute_integral(nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"]) -> tuple[float, float, float]:
    """The integral of |x| over a measure that has this m-point Gauss rule: its lower bound, value and upper bound.

    A rule with weights of 0 is that of an invariant subspace: the measure itself.

    >>> nodes, weights = torch.tensor([[-1.0, 1.0], [0.5, 0.5]], dtype=torch.float64)  # E x = 0, E x^2 = 1, E x^3 = 0
    >>> low, value, high = absolute_integral(nodes, weights)
    >>> low, round(value, 9), high
    (0.0, 0.707106781, 1.0)
    """
    if not len(nodes):
        return 0.0, 0.0, 0.0
    kept, scale = weights > 0, float(nodes.abs().max())
    gauss = float((weights * nodes.abs()).sum())
    if scale == 0 or int(kept.sum()) == 1 or not kept.all():
        return gauss, gauss, gauss
    (rule,) = lanczos(DenseOperator(torch.diag(nodes / scale)), weights.sqrt()[:, None], len(nodes))
    T, size = rule.T, scale * float(weights.sum())
    if len(T) == 1:  # all nodes are the same to round-off
        return gauss, gauss, gauss
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
    low, high = min(below, gauss), max(float(found.max()), gauss)
    return low, min(max(size * _averaged(T), low), high), high


def _averaged(T: Float64[Tensor, "m m"]) -> float:
    """The integral of |x| by the mean of the (m - 1)-point Gauss rule and its anti-Gauss rule."""
    anti = T.clone()
    anti[-1, -2] *= 2**0.5
    anti[-2, -1] *= 2**0.5
    spectra = (torch.linalg.eigh(rule) for rule in (T[:-1, :-1], anti))
    return sum(float((S[0].square() * values.abs()).sum()) for values, S in spectra) / 2


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
