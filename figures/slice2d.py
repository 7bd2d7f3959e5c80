"""Figure: the loss on a plane through the checkpoint, as contours, and its two cross-sections through the centre.

Dots: true renders, among them all of the cross-sections; between them the loss is interpolated.  Blue dots: crossed points,
where the order of the splats or the set of visible ones is not the centre's.  Dashed: the quadratic model, in the plane at the
contours' levels.  Grey: no finite loss.  Upright cross: the checkpoint; others: where the plane leads.  The cross-sections
share their vertical axis, so that a steep direction looks steep beside a flat one; their upper axes count steps in curvature
units, within one of which the curvature alone changes the loss by the amount named.  Where too few points are renders to know
the others, the cross-sections are drawn alone, and a sentence says what resolves the plane.
"""

import textwrap
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from analysis.console.failures import program
from analysis.records.quantities import quantity
from analysis.records.records import Record
from figures.plane import Direction, Plane, plane, same_scale
from figures.scripts import script
from figures.style import BLACK, FIELD_MAP, MISSING, SKY, VERMILION, new_figure, style

LEVELS = 12
WRAP = 76  # characters in a line of the sentence
ACROSS, INTERVALS = 5, 3  # between ticks of the plane and of a cross-section: labels such as -0.008 stay apart
RENDERED: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 2.6, "color": BLACK, "markeredgewidth": 0}
CROSSED: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 2.6, "color": SKY, "markeredgewidth": 0}


def draw(record: Record) -> Figure:
    """The slice of one record.  Raises ValueError where none was recorded."""
    field = plane(record)
    with style():
        if field.unresolved:
            figure = new_figure(2.9)
            below = figure
            figure.suptitle(textwrap.fill(field.unresolved, WRAP), fontsize=6)
        else:
            figure = new_figure(5.0)
            above, below = figure.subfigures(2, 1, height_ratios=[1.35, 1], squeeze=False)[:, 0]
            axes = above.subplots()
            if (contours := _draw_plane(axes, field)) is not None:
                above.colorbar(contours, cax=axes.inset_axes((1.03, 0.0, 0.045, 1.0)), label=field.label)
        first, second = below.subplots(1, 2, sharey=True)
        _draw_section(first, field.x, field, axis=0)
        _draw_section(second, field.y, field, axis=1)
        first.set_ylabel(field.label)
        below.legend(handles=_legend(field), loc="outside lower center", ncols=2, columnspacing=1, handlelength=1.6)
    return figure


def _draw_plane(axes: Axes, field: Plane) -> QuadContourSet | None:
    x, y = field.x.scaled, field.y.scaled
    axes.set_facecolor(MISSING)
    levels = _levels(field)
    filled = None
    if len(levels) > 1:
        filled = axes.contourf(x, y, field.change.T, levels=levels, cmap=FIELD_MAP)
        axes.contour(x, y, field.change.T, levels=levels, colors=BLACK, linewidths=0.4)
        if field.model is not None:
            axes.contour(x, y, field.model.T, levels=levels, colors=VERMILION, linewidths=0.8, linestyles="dashed")
    else:
        axes.text(0.5, 0.65, "the loss is the same\nat every point", transform=axes.transAxes, ha="center")
        axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    if not field.evaluated.all():
        rows, columns = np.nonzero(field.evaluated if field.crossed is None else field.evaluated & ~field.crossed)
        axes.plot(x[rows], y[columns], **RENDERED)
    if field.crossed is not None:
        rows, columns = np.nonzero(field.crossed)
        axes.plot(x[rows], y[columns], **CROSSED)
    axes.xaxis.set_major_locator(MaxNLocator(ACROSS))
    axes.plot([0], [0], "+", color=VERMILION, markersize=7, markeredgewidth=1.2)
    for place in field.others:
        ends = place[0] / 10.0**field.x.exponent, place[1] / 10.0**field.y.exponent
        axes.plot(*ends, "x", color=VERMILION, markersize=5, markeredgewidth=1.2)
    axes.set_xlabel(field.x.label)
    axes.set_ylabel(field.y.label)
    if same := same_scale(np.ptp(field.x.steps), np.ptp(field.y.steps)):
        axes.set_aspect(10.0 ** (field.y.exponent - field.x.exponent))
    axes.set_title(_finding(field) + ("" if same else "\n(axes differ in scale)"), loc="left")
    return filled


def _finding(field: Plane) -> str:
    """Sentence: how far the loss rises and falls in this plane, and where it is lowest, on the axes' numbers."""
    low, high, power = float(field.change.min()), float(field.change.max()), 10.0**field.exponent
    if not high > low:
        return "The loss is the same everywhere"
    text = f"In this plane: up by at most {quantity(power * high)},\n"
    row, column = np.unravel_index(int(field.change.argmin()), field.change.shape)
    if (row, column) == (field.x.centre, field.y.centre):
        return f"{text}lowest at the checkpoint, the cross"
    place = ", ".join(quantity(float(each)) for each in (field.x.steps[row], field.y.steps[column]))
    return f"{text}down by at most {quantity(-power * low)},\nat ({place})"


def _levels(field: Plane) -> np.ndarray:
    low, high = float(field.change.min()), float(field.change.max())
    if not high > low:
        return np.array([low])
    return np.asarray(MaxNLocator(LEVELS).tick_values(low, high))


def _draw_section(axes: Axes, direction: Direction, field: Plane, axis: int) -> None:
    """The grid's line through the centre along one direction."""
    line = field.through_centre(field.change, axis)
    axes.plot(direction.scaled, line, color=BLACK)
    if not field.evaluated.all():
        known = field.through_centre(field.evaluated, axis)
        crossed = known & (False if field.crossed is None else field.through_centre(field.crossed, axis))
        axes.plot(direction.scaled[known & ~crossed], line[known & ~crossed], **RENDERED)
        axes.plot(direction.scaled[crossed], line[crossed], **CROSSED)
    if field.model is not None:
        axes.plot(direction.scaled, field.through_centre(field.model, axis), "--", color=VERMILION, linewidth=0.9)
    axes.axvline(0, color="0.7", linewidth=0.5, zorder=0)
    axes.set_xlabel(direction.short_label)
    axes.xaxis.set_major_locator(MaxNLocator(INTERVALS))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(True)
    label = f"{direction.name}: curvature {quantity(direction.curvature)}\nsteps in curvature units"
    direction.count_units(axes, INTERVALS, label, linespacing=1.4)


def _legend(field: Plane) -> list[Line2D]:
    label, marker = "loss, true renders", ""
    if not field.evaluated.all():
        size = "unbounded" if field.error is None else f"<{100 * field.error:.2g}%"
        label = f"loss; dots: rendered ({field.evaluated.mean():.0%}),\nline: interpolated (error {size})"
        label, marker = "loss, renders" if field.unresolved else label, "."
    handles = [Line2D([], [], color=BLACK, marker=marker, markersize=4, label=label)]
    if field.crossed is not None and field.crossed.any():
        words = f"rendered, order changed:\n{field.crossed.sum():,} of {field.evaluated.sum():,}"
        handles.append(Line2D([], [], label=words, **{**CROSSED, "markersize": 6}))
    if field.model is not None:
        handles.append(Line2D([], [], color=VERMILION, linestyle="--", label="quadratic model"))
    if not field.unresolved:
        handles.append(Line2D([], [], color=VERMILION, linestyle="none", marker="+", label="the checkpoint"))
    words = f"1 curvature unit:\nΔL = {quantity(field.loss_scale)}"
    handles.append(Line2D([], [], linestyle="none", label=words))
    return handles


if __name__ == "__main__":
    program(partial(script, draw, "slice2d"))
