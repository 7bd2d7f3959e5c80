"""Figure: the spectrum of the Hessian in up to three panels.

density        where one was recorded, as `figures.density` draws it
distribution   of the same quadrature, without broadening: the share of directions whose curvature is at most x, and the share
               of sum |lambda| that these have, a line for each start vector; the further apart the two, the less isotropic the
               loss.  A node that is not resolved from 0 is drawn there
eigenvalues    Ritz values of the search for both ends, against their rank, on a symmetric logarithmic axis (linear about 0).
               Bars are residual norms: within each lies a true eigenvalue.  Filled: the residual is under a tenth of the value
"""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator
from matplotlib.transforms import ScaledTranslation

from analysis.records.quantities import measured, percent, power_of_ten
from analysis.records.records import ProbeRecord, Record
from analysis.records.schema import Eigenvalue
from figures.density import at_zero, draw_on, unresolved_share
from figures.style import BLACK, NEGATIVE, POSITIVE, VERMILION, new_figure, style
from landscape.errors import InputError

DECADES = 5  # shown on either side of 0
FLAT = 0.01  # of the largest curvature
CONVERGED = 0.1  # residual over |value|
BELOW = 0.36  # inches, of a legend beneath its plot
DIRECTIONS: dict[str, Any] = {"color": BLACK, "linewidth": 0.7}
CURVATURE: dict[str, Any] = {"color": VERMILION, "linewidth": 0.7}


def draw(record: Record[ProbeRecord]) -> Figure:
    """The spectrum of one record.  Raises InputError where no spectrum was recorded."""
    if "spectrum" not in record.arrays:
        raise InputError(f"expected the arrays ritz_values and residuals in {record.folder / 'spectrum.npz'}, got none")
    arrays = record.arrays["spectrum"]
    order = np.argsort(arrays["ritz_values"])
    values, residuals = arrays["ritz_values"][order], arrays["residuals"][order]
    known = "nodes" in arrays
    with style():
        figure = new_figure(6.2 if known else 2.9)
        heights = [1.4, 1, 1.6] if known else [1]
        *above, last = figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
        _draw_values(last, values, residuals)
        found = _ends(record)
        lines = [f"{name}: {measured(end.value, end.residual)}" for name, end in found.items()]
        last.set_title("\n".join([last.get_title(loc="left"), *lines]), loc="left", linespacing=1.4)
        if known:
            reached = {name: end.value for name, end in found.items() if end.value is not None}
            ends = {name: value for name, value in reached.items() if math.isfinite(value)}
            draw_on(above[0], arrays["nodes"], arrays["weights"], ends)
            above[0].set_title(_finding(arrays["nodes"], arrays["weights"]), loc="left")
            _draw_distribution(above[1], arrays["nodes"], arrays["weights"])
    return figure


def _finding(nodes: np.ndarray, weights: np.ndarray) -> str:
    """How many directions are nearly flat, by the mean of the start vectors' quadratures.

    >>> _finding(np.array([[0.0, 10.0]]), np.array([[0.75, 0.25]]))
    '75% of the directions have less than 1%\\nof the largest curvature'
    """
    flat = float((weights * (np.abs(nodes) < FLAT * np.abs(nodes).max())).sum() / weights.sum())
    words = percent(flat) if flat < 0.9995 else "Over 99.9%"
    return f"{words} of the directions have less than {FLAT:.0%}\nof the largest curvature"


def _draw_values(axes: Axes, values: np.ndarray, residuals: np.ndarray) -> None:
    ranks = np.arange(1, len(values) + 1)
    converged = residuals < CONVERGED * np.abs(values)
    for sign, colour in ((values >= 0, POSITIVE), (values < 0, NEGATIVE)):
        axes.errorbar(ranks[sign], values[sign], residuals[sign], fmt="none", ecolor=colour, elinewidth=0.7, alpha=0.6)
        for chosen, face in ((converged, colour), (~converged, "white")):
            axes.plot(
                ranks[sign & chosen], values[sign & chosen], "o", color=colour, markerfacecolor=face, markersize=3
            )
    axes.axhline(0, color=BLACK, linewidth=0.6)
    _symmetric_log(axes, "y", values)
    axes.set_xlim(0, len(values) + 1)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.set_xlabel("rank")
    axes.set_ylabel("curvature (loss per\nsquared unit of the parameters)")
    axes.set_title(f"{len(values)} eigenvalues met, {converged.sum()} known to {CONVERGED:.0%}", loc="left")
    axes.grid(True)
    looks = [(f"known to {CONVERGED:.0%}", "0.3", "0.3"), ("less well", "0.3", "white")]
    looks += [("positive", POSITIVE, POSITIVE), ("negative", NEGATIVE, NEGATIVE)]
    handles = [_handle(label, color=colour, markerfacecolor=face, marker="o") for label, colour, face in looks]
    handles.insert(2, _handle("a true one lies there", color="0.3", marker="|", markersize=8))
    _legend_below(axes, handles)


def _ends(record: Record[ProbeRecord]) -> dict[str, Eigenvalue]:
    """Both ends by what they are, and whether renders doubt them."""
    ends = {"λ max": record.data.eigenvalues.max, "λ min": record.data.eigenvalues.min}
    return {f"{name}{', not confirmed' * end.doubted}": end for name, end in ends.items()}


def _draw_distribution(axes: Axes, nodes: np.ndarray, weights: np.ndarray) -> None:
    _symmetric_log(axes, "x", nodes)
    left, right = axes.get_xlim()
    for row, shown, masses in zip(nodes, at_zero(nodes), weights, strict=True):
        order = np.argsort(row)
        x = np.concatenate([[left], shown[order], [right]])
        for mass, look in ((masses, DIRECTIONS), (masses * np.abs(row), CURVATURE)):
            sums = np.concatenate([[0.0], np.cumsum(mass[order])])
            axes.step(x, np.append(sums, sums[-1]) / (sums[-1] or 1.0), where="post", **look)
    axes.axvline(0, color=BLACK, linewidth=0.6)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("curvature x, loss per squared unit of the parameters")
    axes.set_ylabel("share ≤ x")
    at_0 = unresolved_share({"nodes": nodes, "weights": weights})
    axes.set_title(f"Share below x; a staircase for each of {len(nodes)} starts" + f"\n{at_0}" * bool(at_0), loc="left")
    axes.grid(True)
    lines = (("of all directions", DIRECTIONS), ("of all curvature, Σ|λ|", CURVATURE))
    _legend_below(axes, [Line2D([], [], label=label, **look) for label, look in lines])


def _symmetric_log(axes: Axes, axis: str, values: np.ndarray) -> None:
    """A symmetric logarithmic axis: `DECADES` decades to each side that has values, linear between, few labels."""
    largest = float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0))
    top = math.ceil(math.log10(largest)) if largest > 0 else 0
    threshold = 10.0 ** (top - DECADES)
    getattr(axes, f"set_{axis}scale")("symlog", linthresh=threshold, linscale=0.6)
    negative, positive = np.any(values < 0), np.any(values >= 0)
    low, high = (1.6 * 10.0**top if there else threshold for there in (negative, positive))
    getattr(axes, f"set_{axis}lim")(-low, high)
    exponents = range(top, top - DECADES, -2)
    ticks = [(0.0, "0")]
    ticks += [(10.0**k, power_of_ten(k)) for k in exponents if positive]
    ticks += [(-(10.0**k), f"−{power_of_ten(k)}") for k in exponents if negative]
    getattr(axes, f"set_{axis}ticks")([tick for tick, _ in ticks], [label for _, label in ticks])
    getattr(axes, f"{axis}axis").set_minor_locator(NullLocator())


def _handle(label: str, **look: Any) -> Line2D:
    return Line2D([], [], linestyle="none", label=label, **{"markersize": 3, **look})


def _legend_below(axes: Axes, handles: list[Line2D]) -> None:
    """What is in this plot, beneath the name of its axis."""
    below = axes.transAxes + ScaledTranslation(0, -BELOW, axes.figure.dpi_scale_trans)
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=below, ncols=2, handlelength=1.2,
        borderpad=0, columnspacing=1,
    )  # fmt: skip
