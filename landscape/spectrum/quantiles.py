"""Quantiles of a spectrum from stochastic Lanczos quadrature, with brackets that assume nothing of the spectrum.

    quantile            lambda that the share p of all eigenvalues lies at or below
    absolute_quantile   t such that the share p of sum |lambda_i| comes from |lambda_i| <= t

**One start vector.**  Its measure mu has a Gauss rule, nodes x_1 < x_2 < ... and weights w_j.  Whatever mu is (Chebyshev,
Markov and Stieltjes; Akhiezer 1965, Sec. 2.5),

    sum_{j<k} w_j  <=  mu(x < x_k)  <=  mu(x <= x_k)  <=  sum_{j<=k} w_j

and the same holds for integrals from a node to infinity of an f whose derivatives f, f', f'', ... have the signs +, -, +, ...
there.  For the curvature at magnitudes above t take y = x^2 and the measure y dmu, whose Gauss rule (nodes y_j, weights u_j)
follows from that of mu: f(y) = y^(-1/2) gives

    sum_{j>k} u_j / sqrt(y_j)  <=  sum of |lambda| over lambda^2 > y_k, or >= y_k  <=  sum_{j>=k} u_j / sqrt(y_j)

**All start vectors.**  For random signs z the share of eigenvalues that z sees in a set of true share F is F on average, with
a variance of at most 2 F (1 - F) / n a start vector: the beta distribution of that mean and variance says how far the mean
over the start vectors may be off at F = p.  The sums of curvature are compared by Student's interval of (curvature above t) -
(1 - p) (all curvature), which is linear in what the start vectors see.  A bracket ends where the test just fails to exclude t.
Eigenvalues that are known are counted as such, each somewhere within its residual, and the tests are of the others.
"""

from collections.abc import Sequence
from math import exp, inf, log

import numpy as np
import torch
from jaxtyping import Float64
from scipy.special import betaincinv
from torch import Tensor

from landscape.eigen.lanczos import lanczos
from landscape.errors import InputError
from landscape.operators.operator import DenseOperator
from landscape.results import Bracket, standard_deviation, t_quantile
from landscape.spectrum.absolute_sum import integrals_of_rules
from landscape.spectrum.rules import SpectralDensity

EPS = torch.finfo(torch.float64).eps
TINY = torch.finfo(torch.float64).tiny


def quantile(density: SpectralDensity, p: float, confidence: float = 0.95) -> Bracket:
    """The eigenvalue that the share p (0 < p < 1) of all eigenvalues lies at or below: 0.5 is the median.

    confidence: that the bracket holds the truth; an end of it that no node bounds is infinite.

    >>> from landscape.spectrum.density import spectral_density
    >>> H = DenseOperator(torch.diag(torch.linspace(0, 1, 1001, dtype=torch.float64)))
    >>> median = quantile(spectral_density(H, torch.Generator().manual_seed(0), matvecs=160, starts=4), 0.5)
    >>> 0.4 < median.low < 0.5 < median.high < 0.6
    True
    """
    _require_share(p)
    rules = list(zip(density.nodes, density.weights, strict=True))
    first, last = (density.known - density.residuals).sort().values, (density.known + density.residuals).sort().values
    grid = torch.cat([density.nodes[density.weights > 0], first, last]).unique()
    below, upto = (torch.zeros(len(rules), len(grid), dtype=torch.float64) for _ in range(2))
    for i, (nodes, weights) in enumerate(rules):
        nodes, order = nodes[weights > 0].sort()
        sums = torch.nn.functional.pad((weights[weights > 0][order] / weights.sum().clamp_min(TINY)).cumsum(0), (1, 0))
        # mu(x <= grid) is at least the sum before its last node that is not above, at most the sum to the next node
        below[i] = sums[(torch.searchsorted(nodes, grid, right=True) - 1).clamp_min(0)]
        upto[i] = sums[(torch.searchsorted(nodes, grid) + 1).clamp_max(len(nodes))]
    # of the others, the share that has to lie at or below as well: beside all known ones that may, and those that must
    least, most = (
        (p * density.dim - torch.searchsorted(known, grid, right=True)) / max(density.rest, 1)
        for known in (first, last)
    )
    size = max(len(rules) * density.rest / 2, TINY)
    tail = (1 - confidence) / 2
    above = grid[(least > 0) & ((upto.mean(dim=0) < _mean_quantile(least, size, tail)) | (least > 1))]
    reached = grid[(most <= 0) | ((below.mean(dim=0) >= _mean_quantile(most, size, 1 - tail)) & (most <= 1))]
    high = _first(reached, inf)
    nodes, weights = density.table()
    at, order = nodes.flatten().sort()
    sums = weights.flatten()[order].cumsum(0)
    value = float(at[int(torch.searchsorted(sums, p * sums[-1]).clamp_max(len(at) - 1))])
    return _within(density, value, above.max() if len(above) else -inf, high)


def absolute_quantile(density: SpectralDensity, p: float = 0.05, confidence: float = 0.95) -> Bracket:
    """The magnitude t such that the share p (0 < p < 1) of sum |lambda| comes from eigenvalues with |lambda| <= t."""
    _require_share(p)
    totals = integrals_of_rules(density).T.tolist()
    tails = [_Tail(*rule, (low, high)) for rule, (low, _, high) in zip(density.rules(), totals, strict=True)]
    known = density.known.abs()
    first, last = (known - density.residuals).clamp_min(0.0), known + density.residuals
    zero = torch.zeros(1, dtype=torch.float64)
    grid = torch.cat([zero, first, last, *(tail.magnitudes for tail in tails)]).unique()
    if len(grid) == 1:
        return Bracket(None, 0.0, inf, "the operator is zero")
    # what is known above t, less (1 - p) of all that is known
    unknown = zip(*(tail.excess(grid, p) for tail in tails), strict=True)
    least, most = (
        density.rest * torch.stack(column) + _sum_above(known, limits, grid) - (1 - p) * known.sum()
        for column, limits in zip(unknown, (first, last), strict=True)
    )
    error = 2 * density.of_known(torch.abs)  # of two sums
    margin = t_quantile(len(tails) - 1, confidence) / len(tails) ** 0.5
    # t is certainly too low, up to the next of the grid; certainly high enough
    beneath = least.mean(dim=0) - margin * standard_deviation(least) > error
    beyond = most.mean(dim=0) + margin * standard_deviation(most) <= -error
    totals = density.rest * torch.tensor([tail.total[0] for tail in tails], dtype=torch.float64) + known.sum() - error
    # n eigenvalues up to t add up to n t at most
    floor = p * float(totals.mean() - margin * standard_deviation(totals)) / density.dim
    low = float(grid[int(beneath.long().cumprod(0).sum().clamp_max(len(grid) - 1))])
    enough = int(beyond.long().flip(0).cumprod(0).sum())
    high = float(grid[-enough]) if enough else inf
    return _within(density, _middle_of_magnitudes(density, tails, p), max(low, floor), high)


def _sum_above(
    values: Float64[Tensor, " k"], limits: Float64[Tensor, " k"], grid: Float64[Tensor, " g"]
) -> Float64[Tensor, " g"]:
    """The sum of the values whose limits are above each number of the grid."""
    limits, order = limits.sort()
    sums = torch.nn.functional.pad(values[order].flip(0).cumsum(0).flip(0), (0, 1))
    return sums[torch.searchsorted(limits, grid, right=True)]


class _Tail:
    """Curvature at magnitudes above t, as one start vector estimates it."""

    def __init__(
        self, nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"], total: tuple[float, float]
    ) -> None:
        self.total = total
        scale = float(nodes.abs().max()) if len(nodes) else 0.0
        squares = (nodes / scale).square() if scale else torch.zeros_like(nodes)
        mass = weights * squares
        kept = mass > 0
        steps = (len(nodes) - 1) // 2  # x^2 dmu is known to degree 2 m - 3 in x: to m - 2 in y
        if not kept.any() or steps == 0:
            self.magnitudes = self.carried = torch.zeros(0, dtype=torch.float64)
            return
        (rule,) = lanczos(DenseOperator(torch.diag(squares[kept])), mass[kept].sqrt()[:, None], steps)
        y, vectors = torch.linalg.eigh(rule.T)
        positive = y > 0  # all are, up to round-off
        root = y[positive].sqrt()
        self.magnitudes = scale * root
        self.carried = scale * float(mass.sum()) * vectors[0, positive].square() / root

    def excess(self, t: Float64[Tensor, " g"], p: float) -> tuple[Float64[Tensor, " g"], Float64[Tensor, " g"]]:
        """Bounds of (curvature above t) - (1 - p) (all curvature), for t and all that follows up to the next node."""
        low, high = self.total
        above = torch.nn.functional.pad(self.carried.flip(0).cumsum(0).flip(0), (0, 2))  # at node k and beyond
        following = torch.searchsorted(self.magnitudes, t, right=True)  # the first node above t
        least = above[following + 1]
        most = torch.where(following > 0, above[(following - 1).clamp_min(0)], torch.full_like(t, high)).clamp_max(high)
        return least - (1 - p) * high, most - (1 - p) * low


def _within(density: SpectralDensity, value: float, low: Tensor | float, high: Tensor | float) -> Bracket:
    """The bracket with the value in it, and what it was made of."""
    low, high = float(low), float(high)
    steps = int((density.weights > 0).sum(dim=1).max())
    note = f"{len(density.nodes)} start vectors of {steps} Lanczos steps at most"
    return Bracket(min(max(value, low), high), low, high, note)


class _Curve:
    """The curvature at magnitudes below t as one start vector sees it, in the middle of what is certain.

    Half of what a node carries is taken to lie below it.  A node near 0 of a measure on both sides of 0 carries less than what
    it stands for, as both signs cancel in its place; there all that `_Tail` does not see above is below.  Between nodes the
    curvature below t goes with a power of t, as it does below them all, there between t (a density of eigenvalues that rises as
    1 / t towards 0) and t^2 (one that stays finite).  total: the value of all curvature.
    """

    def __init__(self, nodes: Float64[Tensor, " m"], weights: Float64[Tensor, " m"], tail: _Tail, total: float) -> None:
        if len(tail.magnitudes) and float(nodes.min()) < 0 < float(nodes.max()):
            at, carried, rest = tail.magnitudes, tail.carried, max(total - float(tail.carried.sum()), 0.0)
        else:
            at, order = nodes.abs().sort()
            carried, rest = (weights * nodes.abs())[order], 0.0
        below = rest + carried.cumsum(0) - carried / 2
        kept = (at > 0) & (below > 0)
        self.total = rest + float(carried.sum())
        self.at, self.below = at[kept].log().numpy(), below[kept].log().numpy()
        rise, run = (float(logs[1] - logs[0]) if len(logs) > 1 else 0.0 for logs in (self.below, self.at))
        self.power = min(max(rise / run, 1.0), 2.0) if run else 1.0

    def __call__(self, t: float) -> float:
        if not len(self.at) or t == 0:
            return 0.0
        if log(t) < self.at[0]:
            return exp(self.below[0] + self.power * (log(t) - self.at[0]))
        return float(np.exp(np.interp(log(t), self.at, self.below))) if log(t) <= self.at[-1] else self.total


def _middle_of_magnitudes(density: SpectralDensity, tails: Sequence[_Tail], p: float) -> float:
    """The magnitude that the share p of sum |lambda| lies at or below, in the middle of what is certain (`_Curve`).

    What is known, and the nodes of a rule that is the measure itself, are where they are.
    """
    exact, curves = [(density.known.abs(), density.known.abs())], []
    each = density.rest / len(tails)
    for (nodes, weights), tail, total in zip(density.rules(), tails, integrals_of_rules(density)[1], strict=True):
        if (weights > 0).all():
            curves.append(_Curve(nodes, weights, tail, float(total)))
        else:
            exact.append((nodes.abs(), each * weights * nodes.abs()))
    at, mass = (torch.cat(parts) for parts in zip(*exact, strict=True))
    at, order = at.sort()
    sums = torch.nn.functional.pad(mass[order].cumsum(0), (1, 0))
    goal = p * (float(sums[-1]) + each * sum(curve.total for curve in curves))
    low, high = (
        0.0,
        max(float(density.nodes.abs().max()) if density.nodes.numel() else 0.0, float(at[-1]) if len(at) else 0.0),
    )
    while low < (middle := (low + high) / 2) < high:
        known = float(sums[int(torch.searchsorted(at, middle, right=True))])
        enough = known + each * sum(curve(middle) for curve in curves) >= goal
        low, high = (low, middle) if enough else (middle, high)
    return high


def _mean_quantile(share: Float64[Tensor, " g"], size: float, level: float) -> Float64[Tensor, " g"]:
    """Quantile of the mean share over start vectors, given theirs with their errors: of the beta distribution of `size`."""
    inner = share.clamp(TINY, 1 - EPS).numpy()
    return torch.from_numpy(betaincinv(size * inner, size * (1 - inner), level))


def _first(values: Tensor, otherwise: float) -> Tensor | float:
    return values.min() if len(values) else otherwise


def _require_share(p: float) -> None:
    if not 0 < p < 1:
        raise InputError(f"expected a share p between 0 and 1, got {p}")
