"""Figure: the density of the spectrum over curvature, smoothed by a Gaussian.

`draw_density(found)` draws a `landscape.SpectralDensity` of any objective, `figures.spectrum` that of a record: the mean of the
start vectors' quadratures, each node a Gaussian of width sigma = BROADENING of the range; a narrower peak is not resolved.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from analysis.records.quantities import exponent_of, extent, percent, power_of_ten, quantity, unit_suffix
from figures.style import BLUE, VERMILION, new_figure, style

if TYPE_CHECKING:
    from landscape.spectrum.rules import SpectralDensity  # slow: with torch

BROADENING = 0.01
POINTS = 2000
DECADES = 8  # below the highest point
ROOM = (5.0, 3.4, 1.6)  # decades above it: of words on the ends and the broadening


def draw_density(density: "SpectralDensity") -> Figure:
    """Density over curvature, logarithmic."""
    with style():
        figure = new_figure(2.2)
        axes = figure.subplots()
        draw_on(axes, np.asarray(density.nodes), np.asarray(density.weights))
        axes.set_title("Spectral density", loc="left")
    return figure


def draw_on(axes: Axes, nodes: np.ndarray, weights: np.ndarray, ends: Mapping[str, float] | None = None) -> None:
    """The density on axes, the width of its broadening, and a line at each of two ends of the spectrum, by name."""
    curvature, height, sigma = smooth_density(nodes, weights)
    exponent = exponent_of(curvature)
    power = 10.0**exponent
    axes.fill_between(curvature / power, height / height.max(), 10.0**-DECADES, color=BLUE, alpha=0.25, linewidth=0)
    axes.plot(curvature / power, height / height.max(), color=BLUE, linewidth=0.9)
    middle = 0.9 * curvature[0] + 0.1 * curvature[-1]
    axes.errorbar(middle / power, 10.0 ** ROOM[2], xerr=sigma / power, color=BLUE, capsize=2, linewidth=0.9)
    _say(axes, (middle + sigma) / power, ROOM[2], "left", f"2σ = {quantity(2 * sigma)}, width of the broadening")
    sides = zip(("left", "right"), ROOM, sorted((ends or {}).items(), key=lambda each: each[1]), strict=False)
    for side, room, (name, end) in sides:
        axes.axvline(end / power, color=VERMILION, linewidth=0.6)
        _say(axes, end / power, room, side, f"{name} = {quantity(end)}", color=VERMILION)
    axes.set_yscale("log")
    axes.set_yticks([10.0**-k for k in range(0, DECADES, 2)], [power_of_ten(-k) for k in range(0, DECADES, 2)])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(10.0**-DECADES, 10.0 ** (ROOM[0 if ends else 2] + 1))
    axes.set_xlabel(f"curvature{unit_suffix(exponent)},\nloss per squared unit of the parameters")
    axes.set_ylabel("broadened density\nover its highest")
    axes.grid(True)


def _say(axes: Axes, x: float, power: float, side: str, words: str, **look: Any) -> None:
    """Words to one side of a place."""
    axes.annotate(words, (x, 10.0**power), (4 if side == "left" else -4, 0), textcoords="offset points", ha=side,
                  va="center", fontsize=6.5, **look)  # fmt: skip


def smooth_density(
    nodes: Float[np.ndarray, "starts k"], weights: Float[np.ndarray, "starts k"]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Curvatures, density there (of integral 1), and sigma.

    >>> x, y, sigma = smooth_density(np.array([[0.0, 1.0]]), np.array([[0.75, 0.25]]))
    >>> round(float(np.sum(y) * (x[1] - x[0])), 6), round(sigma, 6)
    (1.0, 0.01)
    """
    low, high = float(nodes.min()), float(nodes.max())
    sigma = BROADENING * (high - low or abs(high) or 1.0)
    curvature = np.linspace(low - 5 * sigma, high + 5 * sigma, POINTS)
    apart = (curvature[:, None] - nodes.ravel()) / sigma
    shares = weights.ravel() / weights.sum()
    return curvature, np.exp(-0.5 * apart**2) @ shares / (sigma * np.sqrt(2 * np.pi)), sigma


def at_zero(nodes: Float[np.ndarray, "starts k"]) -> Float[np.ndarray, "starts k"]:
    """Nodes, with 0 in place of those that are not resolved from 0: nearer to it than range / k^2.

    That is about how far apart the nodes of k steps of Lanczos are at an end of the spectrum, near which 0 lies: those of
    Chebyshev begin 0.62 range / k^2 from the end.  Neither the sign nor the size of a nearer one is known.

    >>> at_zero(np.array([[0.5, -2.0, 16.0]])).tolist()
    [[0.0, -2.0, 16.0]]
    """
    return np.where(np.abs(nodes) < np.ptp(nodes) / nodes.shape[-1] ** 2, 0.0, nodes)


def unresolved_share(*spectra: Mapping[str, np.ndarray]) -> str:
    """Words on the share of directions at nodes that `at_zero` moves, over all starts; empty where it moves none."""
    moved = [each["weights"] * (at_zero(each["nodes"]) != each["nodes"]) for each in spectra if "nodes" in each]
    shares = [float(share) for each in moved for share in each.sum(axis=1)]
    return f"not resolved from 0: {extent(shares, percent)} of all" if any(shares) else ""
