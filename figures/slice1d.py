"""Figure: the loss along a line through the checkpoint, and the curvature there that steps of finite length see.

Above: dots are true renders, blue where the order of the splats or the set of visible ones is not the checkpoint's; between
them the loss is interpolated.  Dashed: the quadratic model.

Below: second differences of renders at steps to both sides, over the squared step, with the bounds of their round-off.
Grey: round-off hides the value; a triangle: it lies beyond the axis; hollow: an end has another order of splats than the
checkpoint, so that the difference holds kinks and jumps of the loss too.  The line is the infinitesimal curvature.
"""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis.records.findings import resolved
from analysis.records.quantities import exponent_of, extent, quantity, unit_suffix
from analysis.records.records import Record
from analysis.records.schema import FiniteProbe, Slice
from figures.plane import Direction, direction
from figures.slice2d import CROSSED, RENDERED, finding
from figures.style import BLACK, BLUE, VERMILION, new_figure, style
from landscape.errors import InputError

DOT = {"markersize": 5}
SHORT = 0.25  # of a value: a bar within which it sets the limits


def draw(record: Record) -> Figure:
    """The slice along a line.  Raises InputError where none was recorded, or none of its points is finite."""
    about = record.data.slice
    if about is None or len(about.directions) != 1 or "slice" not in record.arrays:
        raise InputError(f"expected a slice along a line in {record.folder}, got none; slice with --dimension 1")
    arrays, probe = record.arrays["slice"], record.data.finite_probe
    if not np.isfinite(arrays["loss"]).any():
        raise InputError(f"expected finite losses in {record.folder / 'slice.npz'}, got none")
    along = direction(about.directions[0], arrays["x"], exponent_of(arrays["x"]))
    with style():
        figure = new_figure(2.6 if probe is None else 5.0)
        parts = figure.subfigures(1 if probe is None else 2, 1, squeeze=False)[:, 0]
        axes = [part.subplots() for part in parts]
        _draw_loss(axes[0], along, about, arrays)
        if probe is not None:
            _draw_curvatures(axes[1], along, probe)
        for part, each in zip(parts, axes, strict=True):
            part.legend(*each.get_legend_handles_labels(), loc="outside lower center", ncols=2, columnspacing=1)
    return figure


def _draw_loss(axes: Axes, along: Direction, about: Slice, arrays: dict[str, np.ndarray]) -> None:
    change = np.ma.masked_invalid(arrays["loss"] - about.center_loss)
    exponent = exponent_of(change.compressed())
    change /= 10.0**exponent
    known = arrays.get("evaluated", np.ones(change.shape, bool))
    crossed = known & arrays.get("crossed", np.zeros(change.shape, bool))
    axes.plot(along.scaled, change, color=BLACK, linewidth=0.8)
    axes.plot(along.scaled[known & ~crossed], change[known & ~crossed], **{**RENDERED, **DOT}, label="render")
    if crossed.any():
        axes.plot(along.scaled[crossed], change[crossed], **{**CROSSED, **DOT}, label="render, order changed")
    model = (arrays["model"] - about.center_loss) / 10.0**exponent if "model" in arrays else None
    if model is not None:
        low, high = axes.get_ylim()
        axes.plot(along.scaled, model, "--", color=VERMILION, linewidth=0.9, label="quadratic model")
        axes.set_ylim(low, high)
    axes.axvline(0, color="0.7", linewidth=0.5, zorder=0)
    axes.set_xlabel(along.label)
    axes.xaxis.set_major_locator(MaxNLocator(7))
    axes.set_ylabel(f"change of loss{unit_suffix(exponent)}")
    axes.grid(True)
    axes.set_title(textwrap.fill(finding(along, change, model), 52), loc="left")
    if about.directions[0].kind == "line":
        axes.axvline(1, color="0.7", linewidth=0.5, zorder=0)
        axes.secondary_xaxis("top").set_xticks([0, 1], ["this checkpoint", "the other"])
    else:
        along.count_units(axes, 7, "steps in curvature units")


def _draw_curvatures(axes: Axes, along: Direction, probe: FiniteProbe) -> None:
    steps, values, bounds = (np.array(each, float) for each in (probe.steps, probe.curvatures, probe.round_off))
    crossed = np.array(probe.crossed or [False] * len(steps))
    exact = np.nan if probe.infinitesimal is None else probe.infinitesimal
    axes.axhline(exact, color=VERMILION, linewidth=0.9, label=f"infinitesimal: {quantity(exact)}")
    sure = np.array(resolved(probe))
    if not sure.all():
        hidden: dict[str, Any] = {"fmt": "none", "ecolor": "0.8", "elinewidth": 1.2, "label": "hidden by round-off"}
        axes.errorbar(steps[~sure], values[~sure], bounds[~sure], **hidden)
    for where, face, label in ((~crossed, BLUE, "finite steps"), (crossed, "white", "finite steps, order changed")):
        if (where & sure).any():
            drawn: dict[str, Any] = {"color": BLUE, "markerfacecolor": face, "markersize": 3.5, "elinewidth": 0.8}
            axes.errorbar(*(each[where & sure] for each in (steps, values, bounds)), fmt="o", label=label, **drawn)
    axes.set_xscale("log")
    low, high = _limits(exact, values[sure], bounds[sure])
    axes.set_ylim(low, high)
    label = "beyond the axis"
    for beyond, edge, marker in ((values < low, low, "v"), (values > high, high, "^")):
        if (beyond & sure).any():
            there = steps[beyond & sure]
            axes.plot(there, [edge] * len(there), marker, color=BLUE, clip_on=False, label=label)
            label = None
    axes.set_xlabel(f"step along {along.name}, {along.scale}")
    axes.set_ylabel("curvature (loss per squared step)")
    axes.grid(True)
    seen = "hidden by round-off\n("
    if sure.any() and exact:
        seen = f"{extent(values[sure] / exact)} times the curvature\n(steps of {extent(steps[sure])}; "
    axes.set_title(f"At finite steps {seen}bars: round-off)", loc="left")


def _limits(exact: float, values: np.ndarray, bounds: np.ndarray) -> tuple[float, float]:
    """Limits of the values with the shorter bars, with a margin: a value that is hardly known does not flatten the others."""
    short = bounds <= SHORT * np.maximum(np.abs(values), abs(exact))
    if short.any():
        values, bounds = values[short], bounds[short]
    ends = np.concatenate([[exact], values - bounds, values + bounds])
    low, high = float(ends.min()), float(ends.max())
    margin = 0.2 * (high - low) or abs(exact) or 1.0
    return low - margin, high + margin
