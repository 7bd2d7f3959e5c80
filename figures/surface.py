"""Figure: the recorded slice as a surface over its two directions, rendered off-screen by PyVista.  Dots: renders.

The picture is rendered by a process of its own (`figures.render_surface`) and put behind axes drawn here, so that
labels look like those of every other figure.  Where the renderer does not work, a warning says so, and so does the
picture, which is then matplotlib's.
"""

import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.ticker import MaxNLocator

from analysis.console.failures import program
from analysis.records.quantities import quantity
from analysis.records.records import Record
from figures import render_surface
from figures.plane import Direction, Plane, plane
from figures.render_surface import Box
from figures.style import BLACK, FIELD_MAP, VERMILION, new_figure, script, style
from landscape.errors import InputError

RENDERER = [sys.executable, str(Path(render_surface.__file__))]
TIME_LIMIT = 120  # seconds for one picture
LEVELS = 10
SAME = 0.005  # relative difference of two scales that look alike
CORNER = 0.06  # of half an axis, from its start on, without a tick: another axis has one there


class RendererMissing(UserWarning):
    """The off-screen renderer does not work on this machine, and matplotlib drew the surface."""


def draw(record: Record) -> Figure:
    """The slice of one record as a surface.  Raises InputError where none was recorded, or too few points are renders."""
    field = plane(record)
    if field.unresolved:
        raise InputError(f"expected a plane that is known between its axes; {field.unresolved}")
    low, high = float(field.change.min()), float(field.change.max())
    span = high - low if high > low else 1.0
    ticks = np.asarray(MaxNLocator(5).tick_values(low, low + span))
    ticks = ticks[(ticks >= low) & (ticks <= low + span)]
    with style():
        figure = new_figure(2.6)
        try:
            image = _rendered(*_heights(field), field.dots)
        except RuntimeError as error:
            warnings.warn(
                f"matplotlib drew the surface, because the off-screen renderer failed: {error}", RendererMissing, 2
            )
            image = _drawn_by_matplotlib(_heights(field)[0], field.dots)
            figure.supxlabel("drawn without the off-screen renderer (not available)", fontsize=6, color=VERMILION)
        axes = figure.subplots()
        axes.imshow(image, extent=(0, 1, 0, 1), interpolation="antialiased")
        axes.set(xlim=(0.0, 1.0), ylim=(0.11, 0.92), aspect="equal")
        axes.axis("off")
        _draw_box(axes, field, ticks, (ticks - low) / span * Box.TOP)
        colours = ScalarMappable(Normalize(low, low + span), FIELD_MAP)
        figure.colorbar(colours, ax=axes, label=field.label, shrink=0.75, pad=0.0, aspect=20)
        curvatures = ", ".join(f"{d.name} {quantity(d.curvature)}" for d in (field.x, field.y))
        flat = "" if high > low else "\nthe loss is the same at every point"
        figure.suptitle(f"Curvature along {curvatures}{flat}\n{_true_scale(field)}", fontsize=7)
    return figure


def _true_scale(field: Plane) -> str:
    """How the drawn lengths of the two steps compare; the box is as wide as it is deep."""
    across, along = (float(np.ptp(d.steps)) for d in (field.x, field.y))
    ratio = across / along if along > 0 else 1.0
    if abs(ratio - 1) < SAME:
        return f"steps along {field.x.name} and {field.y.name} are drawn to one scale"
    return f"a step along {field.y.name} is drawn {ratio:.2g} times as long as one along {field.x.name}"


def _heights(field: Plane) -> tuple[np.ndarray, np.ndarray]:
    """The change of the loss from 0 to 1, nan where there is none, and the levels of the contour lines."""
    low, high = float(field.change.min()), float(field.change.max())
    span = high - low if high > low else 1.0
    levels = (np.asarray(MaxNLocator(LEVELS).tick_values(low, low + span)) - low) / span
    return ((field.change - low) / span).filled(np.nan), levels


def _rendered(heights: np.ndarray, levels: np.ndarray, dots: np.ndarray) -> np.ndarray:
    """The renderer's picture.  RuntimeError says what it said when it failed."""
    colour = (mpl.colormaps[FIELD_MAP](np.arange(256))[:, :3] * 255).astype(np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        field, out = Path(folder, "field.npz"), Path(folder, "surface.png")
        np.savez(field, height=heights, colour=colour, levels=levels[(levels > 0) & (levels < 1)], dots=dots)
        try:
            done = subprocess.run(
                [*RENDERER, str(field), str(out)], capture_output=True, text=True, timeout=TIME_LIMIT, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise RuntimeError(str(error)) from None
        if done.returncode != 0 or not out.is_file():
            said = done.stderr.strip().splitlines()[-1:] or ["no message"]
            raise RuntimeError(f"exit status {done.returncode}: {said[0]}")
        return imread(out)


def _drawn_by_matplotlib(heights: np.ndarray, dots: np.ndarray) -> np.ndarray:
    """Surface in the renderer's box and view, painted back to front."""
    figure = Figure(figsize=(3, 3), dpi=300)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.axis("off")
    x, y = np.meshgrid(*(np.linspace(-1, 1, n) for n in heights.shape), indexing="ij")
    corners = Box.project(np.stack([x, y, heights * Box.TOP], axis=-1))
    middles = (heights[1:, 1:] + heights[:-1, 1:] + heights[1:, :-1] + heights[:-1, :-1]) / 4
    colours = mpl.colormaps[FIELD_MAP](middles)
    cells = [(i, j) for i, j in np.ndindex(*middles.shape) if np.isfinite(middles[i, j])]
    for i, j in sorted(cells, key=lambda cell: float(x[cell] * Box.EYE[0] + y[cell] * Box.EYE[1])):
        ring = corners[[i, i + 1, i + 1, i], [j, j, j + 1, j + 1]]
        axes.fill(ring[:, 0], ring[:, 1], color=colours[i, j], linewidth=0.1)
    axes.plot(*corners[dots & np.isfinite(heights)].T, ".", color=BLACK, markersize=1.2)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def _draw_box(axes: Axes, field: Plane, heights: np.ndarray, levels: np.ndarray) -> None:
    """The edges that carry the axes, their ticks and names: x in front, y at the right, z at the left."""
    _edge(axes, (-1, -1, 0), (1, -1, 0))
    _edge(axes, (1, -1, 0), (1, 1, 0))
    _edge(axes, (-1, -1, 0), (-1, -1, Box.TOP))
    _floor_axis(axes, field.x, lambda t: (t, -1.0, 0.0), np.array([0.0, -1.0, 0.0]))
    _floor_axis(axes, field.y, lambda t: (1.0, t, 0.0), np.array([1.0, 0.0, 0.0]))
    for value, level in zip(heights, levels, strict=True):
        _tick(axes, np.array([-1.0, -1.0, level]), np.array([-0.7, -0.7, 0.0]), f"{value:g}".replace("-", "−"), "right")


def _floor_axis(
    axes: Axes, direction: Direction, place: Callable[[float], Sequence[float]], outwards: np.ndarray
) -> None:
    steps = direction.scaled
    middle, half = (steps[-1] + steps[0]) / 2, (steps[-1] - steps[0]) / 2
    align = "right" if outwards[0] == 0 else "left"
    for value in MaxNLocator(4).tick_values(steps[0], steps[-1]):
        if steps[0] + CORNER * half < value <= steps[-1]:
            text = f"{value:g}".replace("-", "−")
            _tick(axes, np.array(place((value - middle) / half)), outwards, text, align)
    ends = Box.project(np.array([place(-1.0), place(1.0)]))
    angle = np.degrees(np.arctan2(*(ends[1] - ends[0])[::-1]))
    at = Box.project(np.array(place(0.0)) + 0.55 * outwards)
    axes.text(at[0], at[1], direction.short_label, rotation=angle, rotation_mode="anchor", ha="center", va="center")


def _tick(axes: Axes, foot: np.ndarray, outwards: np.ndarray, text: str, align: str) -> None:
    ends = Box.project(np.stack([foot, foot + 0.06 * outwards]))
    axes.plot(ends[:, 0], ends[:, 1], color=BLACK, linewidth=0.5)
    at = Box.project(foot + 0.1 * outwards)
    axes.text(at[0], at[1], text, ha=align, va="center_baseline", fontsize=6)


def _edge(axes: Axes, start: tuple[float, float, float], end: tuple[float, float, float]) -> None:
    points = Box.project(np.array([start, end]))
    axes.plot(points[:, 0], points[:, 1], color=BLACK, linewidth=0.6)


def main() -> None:
    """`python -m figures.surface RUN/probe`"""
    script(draw, "surface")


if __name__ == "__main__":
    program(main)
