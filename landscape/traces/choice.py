"""The choice of a method for a trace, made from the first probes of Hutchinson's estimator.

k probes z_i of random signs have cost k products y_i = H z_i.  There are three ways to go on, and each uses them:

    hutchinson  more probes.  The variance after m probes is 2 p_2 / m, where p_2 = |H|_F^2 without the diagonal is estimated
                from the pairs of probes (`quadratic`)
    xtrace      the z_i become the test vectors of XTrace (`sketched`), for k more products.  With Q_i = orth(y_j, j != i) its
                variance is at most kappa 2 r / k, where r = |(I - Q_i Q_i^T) H|_F^2 is the part of H outside the sketch and
                kappa >= 1 counts that all test vectors share one sketch; kappa = 2 is assumed
    exact       the product with every column of the identity, n more products

**The part outside the sketch** is known from the products at hand: Q_i does not depend on z_i, and E z z^T = I, so that
E |(I - Q_i Q_i^T) y_i|^2 = r.  This square is 1 / (G^-1)_ii for the Gram matrix G_ij = y_i . y_j; r is estimated by the mean.

**The rule.**  At m = 2 k products XTrace has the smaller variance where 4 r < p_2.  r falls as the sketch grows, so XTrace
stays the better one.  Where the first k probes do not reveal the decay of the spectrum yet, a later look can.  A change also
has to pay: Hutchinson's estimator needs about m = k (half width / goal)^2 probes for the error asked for, or max_probes if that
is less.  A sketch is worth its 2 k products where m >= 2 k, and the identity its k + n products where m >= k + n.

A run with a fixed number m of probes looks once, at m / 2; an adaptive run looks each time it looks at its error.  Both keep
probes and products while a sketch with as many test vectors fits into `TraceSettings.memory` (four vectors each) and
max_probes.  The seed alone determines the choice.
"""

from math import inf
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.linalg import gram
from landscape.operators.operator import SymmetricOperator
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import LEAST, Hutchinson, TraceSettings, joined
from landscape.traces.sketched import by_identity, most_test_vectors, xtrace

WORSE = 4.0  # p_2 / r above which a sketch pays: 2 for the two products of a test vector, times kappa = 2
EPS = torch.finfo(torch.float64).eps


def chosen(
    operator: SymmetricOperator, generator: torch.Generator, settings: TraceSettings, name: str = "all"
) -> TraceEstimate:
    """The trace of an operator by the method that its first probes favour."""
    if operator.dim <= settings.min_probes:
        return by_identity(operator, settings, name, generator.device)
    keep = most_test_vectors(operator, settings)
    run = Hutchinson(operator, {name: slice(0, operator.dim)}, generator, settings, keep=keep)
    first = settings.min_probes if settings.adaptive else max(LEAST, settings.max_probes // 2)
    for estimates, ended in run.looks(first):
        estimate = estimates[name]
        better = None if ended or estimate.reason == "tolerance" else _better_method(run, estimate)
        if better == "exact":
            return by_identity(operator, settings, name, generator.device, estimate.matvecs)
        if better == "xtrace":
            return xtrace(operator, generator, settings, name, joined(run.kept))
    return estimate


def _better_method(run: Hutchinson, estimate: TraceEstimate) -> Literal["xtrace", "exact"] | None:
    """The method that reaches the goal with fewer products than more probes do, if there is one."""
    settings, probes, error = run.settings, estimate.probes, estimate.standard_error
    goal = max(settings.rtol * abs(estimate.value), settings.atol)
    needed = min(probes * (estimate.half_width / goal) ** 2 if goal > 0 else inf, settings.max_probes)
    if run.kept and 2 * probes <= needed and error > 0:
        # in units of the error: squares stay in the range of floats
        outside = outside_sketch(joined(run.kept)[1] / error)
        if WORSE * outside < probes / 2:  # p_2 = k error^2 / 2
            return "xtrace"
    return "exact" if probes + run.operator.dim <= needed else None


def outside_sketch(Y: Float[Tensor, "n k"]) -> float:
    """The mean over the columns of Y of |part orthogonal to the other columns|^2.

    >>> round(outside_sketch(torch.tensor([[1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])), 6)  # of (1, 0): 1/2, of (1, 1): 1
    0.75
    """
    values, vectors = torch.linalg.eigh(gram(Y, Y))
    inverse = (vectors.square() / values.clamp_min(EPS * float(values[-1]) or 1.0)).sum(dim=1)
    return float((1 / inverse).mean())
