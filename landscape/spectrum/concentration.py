"""In how few directions the curvature lies: sums of the largest magnitudes |lambda_1| >= |lambda_2| >= ... of a spectrum.

    S(k)      the sum of the k largest       = min over t >= 0 of [k t + F(t)],   F(t) = sum_i max(|lambda_i| - t, 0)
    top(k)    their share of all curvature   = S(k) / F(0)
    half      the least number of directions that hold half of it
                                             = max over t > 0 of [F(0) / 2 - F(t)] / t

S is linear in k between whole k.  The first line is the dual of a linear programme, known from finance as conditional value
at risk (Rockafellar and Uryasev 2000); the third solves it for k.  Both need F alone.  max(|x| - t, 0) is max(x - t, 0), with
a kink at t, plus max(-x - t, 0), with one at -t; a start vector's moments bound the integral of each, and
`rules_of_moments` has the rules that reach these bounds.  One rule alone mostly makes S too small: a node stands for many
eigenvalues as if they were alike.

A bracket is the number at the bounds of F (means over start vectors), widened by Student's interval for their spread.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.results import Bracket, t_quantile
from landscape.spectrum.absolute_sum import rules_of_moments
from landscape.spectrum.rules import SpectralDensity

CONFIDENCE = 0.95


def half(density: SpectralDensity) -> Bracket:
    """The number of directions that hold half of all curvature.

    >>> one = torch.tensor([[3.0, -1.0, 0.0], [0.1, 0.9, 0.0]]).double()  # a measure, whose rule ends in weights of 0
    >>> nodes, weights = one[:, None].expand(2, 2, 3)
    >>> round(half(SpectralDensity(nodes, weights, 10, 6)).value, 3)  # one of 3, and three of the nine of -1
    4.0
    """

    def directions(t: Tensor, excess: Tensor, total: float) -> float:
        return float(((total / 2 - excess) / t)[t > 0].max())

    return _bracket(density, directions, float(density.dim), rises=False)


def top(density: SpectralDensity, count: int) -> Bracket:
    """The share of all curvature that so many directions hold, the largest first."""

    def share(t: Tensor, excess: Tensor, total: float) -> float:
        return float((count * t + excess).min()) / total

    return _bracket(density, share, 1.0, rises=True)


def _bracket(
    density: SpectralDensity, number: Callable[[Tensor, Tensor, float], float], most: float, rises: bool
) -> Bracket:
    """number(t, F, F(0)), at most `most`, which rises or falls with F."""
    t, least, largest = excesses(density)
    middle = (least + largest) / 2
    if not float(middle[:, 0].mean()):
        return Bracket(None, 0.0, most, "the operator is zero")
    value, low, high = middle.mean(0), least.mean(0), largest.mean(0)
    # a bound has F at one end and the whole, F(0), at the other
    ends = [(low, float(high[0])), (high, float(low[0]))]
    below, above = (number(t, excess, total) for excess, total in (ends if rises else ends[::-1]))
    reach = 0.0
    if density.rest:
        starts = len(middle)
        found = [number(t, one, float(one[0])) for one in middle]
        reach = t_quantile(starts - 1, CONFIDENCE) * float(np.std(found, ddof=1)) / starts**0.5
    note = f"{len(middle)} start vectors"
    return Bracket(number(t, value, float(value[0])), max(below - reach, 0.0), min(above + reach, most), note)


@lru_cache(maxsize=4)
def excesses(
    density: SpectralDensity,
) -> tuple[Float64[Tensor, " t"], Float64[Tensor, "starts t"], Float64[Tensor, "starts t"]]:
    """t from 0 on, and the least and the largest F(t) that each start vector's moments allow; kept for the next number."""
    sizes = torch.cat([density.nodes[density.weights > 0], density.known, density.known.new_zeros(1)]).abs().unique()
    t = torch.cat([sizes, (sizes[:-1] + sizes[1:]) / 2]).sort().values
    known, least, largest = (density.known.abs()[:, None] - t).clamp(min=0).sum(dim=0), [], []
    for nodes, weights in density.rules():
        x, w = rules_of_moments(nodes, weights, torch.cat([t, -t]))
        sides = [_excess(x, w, t), _excess(-x.flip(1), w.flip(1), t)]
        least.append(known + density.rest * sum(side.amin(dim=0) for side in sides))
        largest.append(known + density.rest * sum(side.amax(dim=0) for side in sides))
    return t, torch.stack(least), torch.stack(largest)


def _excess(x: Float64[Tensor, "a m"], w: Float64[Tensor, "a m"], t: Float64[Tensor, " t"]) -> Float64[Tensor, "a t"]:
    """sum_j w_j max(x_j - t, 0) of rules with ascending nodes."""
    # sums from each node to the last, and 0 beyond it
    above, mass = (torch.nn.functional.pad(part.flip(1).cumsum(1).flip(1), (0, 1)) for part in (w * x, w))
    first = torch.searchsorted(x.contiguous(), t.expand(len(x), -1).contiguous(), right=True)
    return above.gather(1, first) - t * mass.gather(1, first)
