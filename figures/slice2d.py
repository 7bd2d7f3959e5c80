"""Figure: the two cross-sections of a slice, each under what it found, and the plane between them.

Sections: the loss, from true renders; dots where the plane is not rendered whole, blue where the order of the splats or the set
of visible ones is not the centre's; dashed: the quadratic model.  Their titles compare the mean of both ends with the model
there.  They share their vertical axis, so that a steep direction looks steep beside a flat one; their upper axes count steps in
curvature units: steps within which the curvature alone changes the loss by the amount named.

Plane: three contours of the loss and, dashed, of the model at the same levels; grey dots: renders; grey: no finite loss;
crosses: the checkpoint (upright), and where the plane leads.  Where too few points are renders to know the others, the sections
are drawn alone, and a sentence says what resolves the plane.
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
from analysis.records.quantities import quantity, rough
from analysis.records.records import Record
from figures.plane import Direction, Plane, plane, same_scale
from figures.scripts import script
from figures.style import BLACK, FIELD_MAP, MISSING, SKY, VERMILION, new_figure, style

CONTOURS = 3  # of the loss, and of the model
AGREES = 1.25  # factor within which the loss rises as its curvature says
MARGIN = 0.06  # of the sections' range, beyond it
WRAP = 76  # characters in a line of the sentence
ACROSS, INTERVALS = 5, 3  # between ticks of the plane and of a cross-section: labels such as -0.008 stay apart
RENDERED: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 2.6, "color": BLACK, "markeredgewidth": 0}
CROSSED: dict[str, Any] = RENDERED | {"color": SKY}
FAINT: dict[str, Any] = RENDERED | {"color": "0.55", "markersize": 1.2}


def draw(record: Record) -> Figure:
    """The slice of one record.  Raises ValueError where none was recorded."""
    field = plane(record)
    with style():
        if field.unresolved:
            figure = new_figure(2.9)
            above = figure
            figure.suptitle(textwrap.fill(field.unresolved, WRAP), fontsize=6)
        else:
            figure = new_figure(5.0)
            above, below = figure.subfigures(2, 1, height_ratios=[1.25, 1], squeeze=False)[:, 0]
            axes = below.subplots()
            if (filled := _draw_plane(axes, field)) is not None:
                place = axes.inset_axes((1.03, 0.0, 0.045, 1.0))
                below.colorbar(filled, cax=place, label=field.label, ticks=MaxNLocator(ACROSS))
        first, second = above.subplots(1, 2, sharey=True)
        _draw_section(first, field.x, field, axis=0)
        _draw_section(second, field.y, field, axis=1)
        lines = [field.through_centre(field.change, axis) for axis in (0, 1)]
        low, high = (float(end(map(end, lines))) for end in (min, max))
        room = MARGIN * (high - low) or 1.0
        first.set(ylabel=field.label, ylim=(low - room, high + room))
        above.legend(handles=_legend(field), loc="outside lower center", ncols=2, columnspacing=1, handlelength=1.6)
    return figure


def finding(direction: Direction, change: np.ndarray, model: np.ndarray | None) -> str:
    """Sentence: how much the loss changes to the ends of a section, the mean of both, beside what the curvature says."""
    found = float(change[0] + change[-1]) / 2
    said = 0.0 if model is None else float(model[0] + model[-1]) / 2
    along = f"Along {direction.name} the loss"
    if direction.kind == "line" or not said or not np.isfinite(found):
        return along
    ratio = found / said
    if 1 / AGREES <= ratio <= AGREES:
        return f"{along} changes\nas its curvature says"
    words = f"{rough(ratio)} times what\nits curvature says" if ratio > 0 else "against its curvature"
    return f"{along} {'rises' if found > 0 else 'falls'},\n{words}"


def _draw_plane(axes: Axes, field: Plane) -> QuadContourSet | None:
    x, y = field.x.scaled, field.y.scaled
    axes.set_facecolor(MISSING)
    low, high = float(field.change.min()), float(field.change.max())
    filled = None
    if high > low:
        filled = axes.contourf(x, y, field.change.T, levels=np.linspace(low, high, 65), cmap=FIELD_MAP)
        levels = [level for level in MaxNLocator(CONTOURS + 1).tick_values(low, high) if low < level < high][:CONTOURS]
        axes.contour(x, y, field.change.T, levels=levels, colors=BLACK, linewidths=0.6)
        if field.model is not None:
            axes.contour(x, y, field.model.T, levels=levels, colors=VERMILION, linewidths=0.8, linestyles="dashed")
    else:
        axes.text(0.5, 0.65, "the loss is the same\nat every point", transform=axes.transAxes, ha="center")
        axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    if not field.evaluated.all():
        rows, columns = np.nonzero(field.evaluated)
        axes.plot(x[rows], y[columns], **FAINT)
    axes.xaxis.set_major_locator(MaxNLocator(ACROSS))
    axes.plot([0], [0], "+", color=VERMILION, markersize=7, markeredgewidth=1.2)
    for place in field.others:
        ends = place[0] / 10.0**field.x.exponent, place[1] / 10.0**field.y.exponent
        axes.plot(*ends, "x", color=VERMILION, markersize=5, markeredgewidth=1.2)
    axes.set_xlabel(field.x.label)
    axes.set_ylabel(field.y.label if field.y.scale != field.x.scale else field.y.short_label)
    if same := same_scale(np.ptp(field.x.steps), np.ptp(field.y.steps)):
        axes.set_aspect(10.0 ** (field.y.exponent - field.x.exponent))
    axes.set_title("The plane of both" + ("" if same else " (axes differ in scale)"), loc="left")
    return filled


def _draw_section(axes: Axes, direction: Direction, field: Plane, axis: int) -> None:
    """The grid's line through the centre along one direction."""
    line = field.through_centre(field.change, axis)
    axes.plot(direction.scaled, line, color=BLACK)
    if not field.evaluated.all():
        known = field.through_centre(field.evaluated, axis)
        crossed = known & (False if field.crossed is None else field.through_centre(field.crossed, axis))
        axes.plot(direction.scaled[known & ~crossed], line[known & ~crossed], **RENDERED)
        axes.plot(direction.scaled[crossed], line[crossed], **CROSSED)
    model = None if field.model is None else field.through_centre(field.model, axis)
    if model is not None:
        axes.plot(direction.scaled, model, "--", color=VERMILION, linewidth=0.9)
    axes.axvline(0, color="0.7", linewidth=0.5, zorder=0)
    axes.set_xlabel(direction.short_label)
    axes.xaxis.set_major_locator(MaxNLocator(INTERVALS))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(True)
    axes.set_title(finding(direction, line, model), loc="left")
    direction.count_units(axes, INTERVALS, "steps in curvature units")


def _legend(field: Plane) -> list[Line2D]:
    label, marker = "loss, true renders", ""
    if not field.evaluated.all():
        size = "unbounded" if field.error is None else f"<{rough(100 * field.error)}%"
        label = f"loss; plane: {field.evaluated.mean():.0%} rendered,\nelse interpolated (error {size})"
        label, marker = "loss, renders" if field.unresolved else label, "."
    handles = [Line2D([], [], color=BLACK, marker=marker, markersize=4, label=label)]
    if field.crossed is not None and field.crossed.any():
        words = f"rendered, order changed:\n{field.crossed.sum():,} of {field.evaluated.sum():,}"
        handles.append(Line2D([], [], label=words, **{**CROSSED, "markersize": 6}))
    if field.model is not None:
        handles.append(Line2D([], [], color=VERMILION, linestyle="--", label="quadratic model"))
    handles.append(Line2D([], [], linestyle="none", label=f"1 curvature unit:\nΔL = {quantity(field.loss_scale)}"))
    return handles


if __name__ == "__main__":
    program(partial(script, draw, "slice2d"))
