"""Figure: the recorded slice as a surface over its two directions, rendered off-screen by PyVista.  Dots: renders.

The picture is rendered by a process of its own (`figures.render_surface`) and put behind axes drawn here, so that
labels look like those of every other figure.  Where the renderer does not work, a warning says so, and so does the
picture, which is then matplotlib's.
"""

import subprocess
import tempfile
import warnings
from collections.abc import Callable, Sequence
from functools import partial
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

from analysis.console.drawing import own_python
from analysis.console.failures import program
from analysis.records.quantities import quantity, rough
from analysis.records.records import Record
from figures.eye import eye_over
from figures.plane import Direction, Plane, plane
from figures.render_surface import Box
from figures.scripts import script
from figures.style import BLACK, FIELD_MAP, VERMILION, new_figure, style
from landscape.errors import InputError

RENDERER = "figures.render_surface"
TIME_LIMIT = 120  # seconds for one picture
LEVELS = 10
SAME = 0.005  # relative difference of two scales that look alike
CORNER = 0.06  # of half an axis, to its far end, without a tick: another axis has one there
NAMES = 0.13  # of the picture's width, for labels under the floor


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
    box = Box(np.array(eye_over(_heights(field)[0], Box.TOP)))
    with style():
        figure = new_figure(2.6)
        try:
            image = _rendered(box, *_heights(field), field.dots)
        except RuntimeError as error:
            warnings.warn(
                f"matplotlib drew the surface, because the off-screen renderer failed: {error}", RendererMissing, 2
            )
            image = _drawn_by_matplotlib(box, _heights(field)[0], field.dots)
            figure.supxlabel("drawn without the off-screen renderer (not available)", fontsize=6, color=VERMILION)
        axes = figure.subplots()
        axes.imshow(image, extent=(0, 1, 0, 1), interpolation="antialiased")
        axes.set(xlim=(0.0, 1.0), ylim=_extent(box, _heights(field)[0]), aspect="equal")
        axes.axis("off")
        _draw_box(axes, box, field, ticks, (ticks - low) / span * Box.TOP)
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
    return f"a step along {field.y.name} is drawn {rough(ratio)} times as long as one along {field.x.name}"


def _heights(field: Plane) -> tuple[np.ndarray, np.ndarray]:
    """The change of the loss from 0 to 1, nan where there is none, and the levels of the contour lines."""
    low, high = float(field.change.min()), float(field.change.max())
    span = high - low if high > low else 1.0
    levels = (np.asarray(MaxNLocator(LEVELS).tick_values(low, low + span)) - low) / span
    return ((field.change - low) / span).filled(np.nan), levels


def _rendered(box: Box, heights: np.ndarray, levels: np.ndarray, dots: np.ndarray) -> np.ndarray:
    """The renderer's picture.  RuntimeError says what it said when it failed."""
    colour = (mpl.colormaps[FIELD_MAP](np.arange(256))[:, :3] * 255).astype(np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        field, out = Path(folder, "field.npz"), Path(folder, "surface.png")
        levels = levels[(levels > 0) & (levels < 1)]
        np.savez(field, height=heights, colour=colour, levels=levels, dots=dots, eye=box.eye)
        try:
            done = subprocess.run(
                **own_python(RENDERER, field, out), capture_output=True, text=True, timeout=TIME_LIMIT, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise RuntimeError(str(error)) from None
        if done.returncode != 0 or not out.is_file():
            said = done.stderr.strip().splitlines()[-1:] or ["no message"]
            raise RuntimeError(f"exit status {done.returncode}: {said[0]}")
        return imread(out)


def _drawn_by_matplotlib(box: Box, heights: np.ndarray, dots: np.ndarray) -> np.ndarray:
    """Surface in the renderer's box and view, painted back to front."""
    figure = Figure(figsize=(3, 3), dpi=300)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.axis("off")
    x, y = np.meshgrid(*(np.linspace(-1, 1, n) for n in heights.shape), indexing="ij")
    corners = box.project(np.stack([x, y, heights * Box.TOP], axis=-1))
    middles = (heights[1:, 1:] + heights[:-1, 1:] + heights[1:, :-1] + heights[:-1, :-1]) / 4
    colours = mpl.colormaps[FIELD_MAP](middles)
    cells = [(i, j) for i, j in np.ndindex(*middles.shape) if np.isfinite(middles[i, j])]
    for i, j in sorted(cells, key=lambda cell: float(x[cell] * box.eye[0] + y[cell] * box.eye[1])):
        ring = corners[[i, i + 1, i + 1, i], [j, j, j + 1, j + 1]]
        axes.fill(ring[:, 0], ring[:, 1], color=colours[i, j], linewidth=0.1)
    axes.plot(*corners[dots & np.isfinite(heights)].T, ".", color=BLACK, markersize=1.2)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def _extent(box: Box, heights: np.ndarray) -> tuple[float, float]:
    """The lower and the upper end of the picture: room for the labels under the floor, and for the highest point."""
    x, y = np.meshgrid(*(np.linspace(-1, 1, n) for n in heights.shape), indexing="ij")
    floor, top = (box.project(np.stack([x, y, z], axis=-1))[..., 1] for z in (0 * x, np.nan_to_num(heights) * Box.TOP))
    return float(floor.min()) - NAMES, float(top.max()) + 0.02


def _draw_box(axes: Axes, box: Box, field: Plane, heights: np.ndarray, levels: np.ndarray) -> None:
    """The edges that carry the axes, their ticks and names: x and y in front, z at the left, where one of them ends."""
    x, y = np.sign(box.eye[:2])
    ends = np.array([[-x, y, 0.0], [x, -y, 0.0]])
    left = ends[box.project(ends)[:, 0].argmin()]
    for end in (*ends, left + [0, 0, Box.TOP]):
        _edge(axes, box, left if end[2] else (x, y, 0.0), end)
    far = [each if (left[:2] == corner[:2]).all() else 0.0 for each, corner in zip((-x, -y), ends, strict=True)]
    _floor_axis(axes, box, field.x, lambda t: (t, y, 0.0), np.array([0.0, y, 0.0]), far[0])
    _floor_axis(axes, box, field.y, lambda t: (x, t, 0.0), np.array([x, 0.0, 0.0]), far[1])
    for value, level in zip(heights, levels, strict=True):
        _tick(axes, box, left + [0.0, 0.0, level], 0.7 * left, f"{value:g}".replace("-", "−"))


def _floor_axis(
    axes: Axes,
    box: Box,
    direction: Direction,
    place: Callable[[float], Sequence[float]],
    outwards: np.ndarray,
    far: float,
) -> None:
    """Ticks and name of an axis along an edge; far: its end where z has ticks, -1 or 1; else 0."""
    steps = direction.scaled
    middle, half = (steps[-1] + steps[0]) / 2, (steps[-1] - steps[0]) / 2
    for value in MaxNLocator(4).tick_values(steps[0], steps[-1]):
        along = (value - middle) / half
        if abs(along) <= 1 and far * along < 1 - CORNER:
            _tick(axes, box, np.array(place(along)), outwards, f"{value:g}".replace("-", "−"))
    ends = box.project(
        np.array(sorted((place(-1.0), place(1.0)), key=lambda end: float(box.project(np.array(end))[0])))
    )
    angle = np.degrees(np.arctan2(*(ends[1] - ends[0])[::-1]))
    at = box.project(np.array(place(0.0)) + 0.55 * outwards)
    axes.text(at[0], at[1], direction.short_label, rotation=angle, rotation_mode="anchor", ha="center", va="center")


def _tick(axes: Axes, box: Box, foot: np.ndarray, outwards: np.ndarray, text: str) -> None:
    ends = box.project(np.stack([foot, foot + 0.06 * outwards]))
    axes.plot(ends[:, 0], ends[:, 1], color=BLACK, linewidth=0.5)
    at, align = box.project(foot + 0.1 * outwards), "left" if ends[1, 0] > ends[0, 0] else "right"
    axes.text(at[0], at[1], text, ha=align, va="center_baseline", fontsize=6)


def _edge(axes: Axes, box: Box, start: Sequence[float], end: Sequence[float]) -> None:
    points = box.project(np.array([start, end]))
    axes.plot(points[:, 0], points[:, 1], color=BLACK, linewidth=0.6)


if __name__ == "__main__":
    program(partial(script, draw, "surface"))
