"""Figure: the two cross-sections of a slice, each under what it found, and the plane between them.

Sections: the loss, from true renders; blue dots where the order of the splats or the set of visible ones is not the centre's,
if it is so at some only; dashed: the quadratic model.  Their titles compare second differences of the loss with the model's.
They share their vertical axis, so that a steep direction looks steep beside a flat one; their upper axes count steps in
curvature units, as the titles do: steps within which the curvature alone changes the loss by the amount named, ΔL.

Plane: three contours of the loss and, dashed, of the model at the same levels, those of the colour bar's ticks; grey dots:
renders; grey: no finite loss; crosses: the checkpoint (upright), and where the plane leads.  Where too few points are renders
to know the others, the sections are drawn alone, and a sentence says what resolves the plane.
"""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, Locator, MaxNLocator

from analysis.records.quantities import AGREES, extent, quantity, rough
from analysis.records.records import Record
from figures.plane import Direction, Plane, plane, same_scale
from figures.style import BLACK, FIELD_MAP, MISSING, SKY, VERMILION, new_figure, style

CONTOURS = 3  # of the loss, and of the model
ALIKE = 1.25  # ratio of two ranges that have the same ticks
MOST = 0.95  # of the renders: where the order changed at so many, dots tell nothing
MARGIN = 0.06  # of the sections' range, beyond it
WRAP, HALF = 76, 24  # characters in a line of the figure, and above a section
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
                below.colorbar(filled, cax=place, label=field.label, ticks=axes.collections[1].levels)  # pyright: ignore[reportAttributeAccessIssue]
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
    """Sentence: how the loss curves from the centre to each step of the section, beside what the curvature says.

    Of the second differences: a slope cancels in them.
    """
    along = f"Along {direction.name} the loss"
    centre = direction.centre
    steps = np.arange(1, min(centre, len(change) - 1 - centre) + 1)
    lines = [np.ma.filled(line, np.nan) for line in (change, change if model is None else model)]
    found, said = (line[centre + steps] + line[centre - steps] - 2 * line[centre] for line in lines)
    known = np.isfinite(found) & (said != 0)
    if direction.kind == "line" or model is None or not known.any():
        return f"The loss along {direction.name}"
    steps, ratios, up = steps[known], found[known] / said[known], said[known][-1] > 0
    held = int(np.argmin(np.append(abs(ratios - 1) <= AGREES, False)))  # steps before the first that does not agree
    if held == len(ratios):
        return f"{along} curves as its curvature says"
    turned = np.sign(lines[0][centre + steps[-1] * np.array([-1, 1])]) == (-1 if up else 1)
    away = f"{'falls' if up else 'rises'} on {'both sides' if turned.all() else 'one side'}"
    units = direction.steps[centre + steps] / direction.unit
    if held:
        rest = away if ratios[-1] < 0 else f"{extent(ratios[held:])} times as much"
        return f"{along} curves as its curvature says to {rough(float(units[held - 1]))} curvature units, then {rest}"
    if ratios.max() < 0:
        return f"{along} {away}, against its curvature"
    way = "" if ratios.min() < 0 else " up" if up else " down"
    return f"{along} curves{way} {extent(ratios)} times what its curvature says, at {extent(units)} curvature units"


def _draw_plane(axes: Axes, field: Plane) -> QuadContourSet | None:
    x, y = field.x.scaled, field.y.scaled
    axes.set_facecolor(MISSING)
    low, high = float(field.change.min()), float(field.change.max())
    filled = None
    if high > low:
        filled = axes.contourf(x, y, field.change.T, levels=np.linspace(low, high, 65), cmap=FIELD_MAP)
        levels = [level for level in MaxNLocator(CONTOURS + 1).tick_values(low, high) if low < level < high][:CONTOURS]
        axes.contour(x, y, field.change.T, levels=levels, colors=BLACK, linewidths=0.6, linestyles="solid")
        if field.model is not None:
            axes.contour(x, y, field.model.T, levels=levels, colors=VERMILION, linewidths=0.8, linestyles="dashed")
    else:
        axes.text(0.5, 0.65, "the loss is the same\nat every point", transform=axes.transAxes, ha="center")
        axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    if not field.evaluated.all():
        rows, columns = np.nonzero(field.evaluated)
        axes.plot(x[rows], y[columns], **FAINT)
    for axis, along in ((axes.xaxis, field.x), (axes.yaxis, field.y)):
        axis.set_major_locator(_ticks(along, field, ACROSS))
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
    crossed = _crossed(field, axis)
    axes.plot(direction.scaled[crossed], line[crossed], **CROSSED)
    model = None if field.model is None else field.through_centre(field.model, axis)
    if model is not None:
        axes.plot(direction.scaled, model, "--", color=VERMILION, linewidth=0.9)
    axes.axvline(0, color="0.7", linewidth=0.5, zorder=0)
    axes.set_xlabel(direction.short_label)
    axes.xaxis.set_major_locator(_ticks(direction, field, INTERVALS))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(True)
    axes.set_title(textwrap.fill(finding(direction, line, model), HALF), loc="left")
    direction.count_units(axes, INTERVALS, f"steps in curvature units,\n1: ΔL = {quantity(field.loss_scale)}")


def _crossed(field: Plane, axis: int) -> np.ndarray:
    """The points of a section that have a blue dot."""
    crossed = field.evaluated & (False if field.crossed is None else field.crossed)
    return field.through_centre(crossed & (crossed.sum() < MOST * field.evaluated.sum()), axis)


def _ticks(direction: Direction, field: Plane, most: int) -> Locator:
    """Ticks along a direction, the same for both where their ranges are alike."""
    reach = sorted(float(abs(each.scaled).max()) for each in (field.x, field.y))
    if field.x.exponent == field.y.exponent and reach[1] < ALIKE * reach[0]:
        return FixedLocator(MaxNLocator(most).tick_values(-reach[0], reach[0]))
    return MaxNLocator(most)


def _legend(field: Plane) -> list[Line2D]:
    handles = [Line2D([], [], color=BLACK, label="loss")]
    if not (field.evaluated.all() or field.unresolved):
        size = "unbounded" if field.error is None else f"<{rough(100 * field.error)}%"
        words = f"plane: {field.evaluated.mean():.0%} rendered,\nelse interpolated (error {size})"
        handles.append(Line2D([], [], label=words, **{**FAINT, "markersize": 4}))
    if field.model is not None:
        handles.append(Line2D([], [], color=VERMILION, linestyle="--", label="quadratic model"))
    if field.crossed is not None and field.crossed.any():
        words = f"order changed: {field.crossed.sum():,}\nof {field.evaluated.sum():,} renders"
        marked = any(_crossed(field, axis).any() for axis in (0, 1))
        look: dict[str, Any] = {**CROSSED, "markersize": 6} if marked else {"linestyle": "none"}
        handles.append(Line2D([], [], label=words, **look))
    return handles
