"""In how few directions the curvature lies: partial sums of the magnitudes |lambda_1| >= |lambda_2| >= ... of a spectrum.

    half        the least number of directions that hold half of sum |lambda_i|
    top(k)      the share of sum |lambda_i| that the k largest hold

Every start vector of a density gives a rule: magnitudes with a number of eigenvalues each, which is a fraction, beside those
known one by one.  Sums between two magnitudes are interpolated.  The bracket is Student's, over the start vectors; the
error of the rules themselves is small beside it (`tests/landscape/spectrum/test_concentration.py`).
"""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.results import Bracket, t_quantile
from landscape.spectrum.rules import SpectralDensity

CONFIDENCE = 0.95


def half(density: SpectralDensity) -> Bracket:
    """The number of directions that hold half of all curvature.

    >>> nodes, weights = torch.tensor([[3.0, -1.0]] * 2).double(), torch.tensor([[0.1, 0.9]] * 2).double()
    >>> round(half(SpectralDensity(nodes, weights, 10, 4)).value, 3)  # one of 3, and three of the nine of 1
    4.0
    """
    return _bracket(density, [float(np.interp(m[-1] / 2, m, n)) for n, m in _sums(density)], float(density.dim))


def top(density: SpectralDensity, count: int) -> Bracket:
    """The share of all curvature that so many directions hold, the largest first."""
    return _bracket(density, [float(np.interp(count, n, m) / m[-1]) for n, m in _sums(density)], 1.0)


def _sums(density: SpectralDensity) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each start vector, numbers of the largest magnitudes, from 0 on, and their sums; none where all are 0."""
    found, one = [], torch.ones_like(density.known)
    for nodes, weights in density.rules():
        sizes, counts = _falling(torch.cat([nodes, density.known]).abs(), torch.cat([density.rest * weights, one]))
        number, mass = torch.cumsum(counts, 0).numpy(), torch.cumsum(counts * sizes, 0).numpy()
        if mass.size and mass[-1] > 0:
            found.append((np.concatenate([[0.0], number]), np.concatenate([[0.0], mass])))
    return found


def _falling(sizes: Float64[Tensor, " m"], counts: Float64[Tensor, " m"]) -> tuple[Tensor, Tensor]:
    order = sizes.argsort(descending=True)
    return sizes[order], counts[order]


def _bracket(density: SpectralDensity, found: list[float], most: float) -> Bracket:
    if not found:
        return Bracket(None, 0.0, most, "the operator is zero")
    value, reach = float(np.mean(found)), 0.0
    if density.rest:
        spread = float(np.std(found, ddof=1)) if len(found) > 1 else float("inf")
        reach = t_quantile(len(found) - 1, CONFIDENCE) * spread / len(found) ** 0.5 if len(found) > 1 else spread
    return Bracket(value, max(value - reach, 0.0), min(value + reach, most), f"{len(found)} start vectors")
