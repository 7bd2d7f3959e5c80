"""Figures: what `landscape map` found, over the training views.

    view        photograph, render, error, and one field of the Gaussians
    fragility   the distance to the next swap, the condition of the splats, the share of one view; the pairs that change order
    steepest    the Gaussians that carry an end of the spectrum, outlined, and what a step along it does

A field's colour in a pixel is the mean over the splats there, by their weights, of how far each is along the scale beneath.
Grey: no splat with a value.  The arrow ends of a scale say that there are values beyond.
"""

import math
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator, PercentFormatter
from matplotlib.transforms import Affine2D, Bbox, TransformedBbox

from analysis.console.failures import program
from analysis.records.quantities import BYTES, Shade, percent, quantity, rough
from analysis.records.run_files import (
    END_MAPS,
    VIEW_MAPS,
    Carrier,
    MapRecord,
    Panel,
    Steepest,
    Swaps,
    read_map,
    read_maps,
)
from figures.scripts import folder_script
from figures.style import BLACK, BLUE, GREEN, VERMILION, literal, save, style

BOUNDS = {"error": (0,), "one_view": (0, BYTES)}  # ends of a scale, in bytes, beyond which nothing is
SAME = 0.02  # greatest difference of curves that look alike, of their axis
NEAR = 0.03  # of a scale's length, from its end
WIDTH, TALLEST = 7.0, 9.0  # inches
MARGIN, HEAD, LEGEND = 0.12, 0.22, 0.5  # inches: between pictures, above one, beneath one
BAR, ARROW, TICK = 0.09, 0.07, 0.03  # inches: of a scale, how high it is, and of its ends and its ticks
FEWEST, DOTS = 110, 160  # an inch: as many as the photograph has pixels there, where these are between both, or DOTS


class Sheet:
    """Pictures of one shape in rows, each with room for a title above it and a scale beneath it.

    Places are in inches from the top left.  Only plots have axes, which take longer to draw than pictures.
    """

    def __init__(
        self, rows: int, columns: int, shape: tuple[int, int], legends: tuple[bool, ...], heading: str = ""
    ) -> None:
        aspect = shape[0] / shape[1]
        self.across = (WIDTH - MARGIN * (columns + 1)) / columns
        first = HEAD * (1 + bool(heading))
        rest = first + (rows - 1) * HEAD + sum(legends) * LEGEND + MARGIN
        self.across = min(self.across, (TALLEST - rest) / rows / aspect)
        self.tall = self.across * aspect
        self.size = (columns * (self.across + MARGIN) + MARGIN, rest + rows * self.tall)
        self.tops = [first + sum(self.tall + HEAD + LEGEND * each for each in legends[:row]) for row in range(rows)]
        dots = shape[1] / self.across
        self.figure = Figure(figsize=self.size, dpi=dots if FEWEST <= dots <= DOTS else DOTS)
        self.inches = Affine2D().scale(1 / self.size[0], -1 / self.size[1]).translate(0, 1) + self.figure.transFigure
        self.text(MARGIN, 0.06, heading, fontsize=8.5)

    def text(self, x: float, y: float, words: str, **how: Any) -> None:
        """Words from the record, below (x, y) where `how` does not say otherwise."""
        self.figure.text(x, y, literal(words), transform=self.inches, **{"va": "top", **how})

    def show(self, row: int, column: int, image: UInt8[np.ndarray, "h w 3"], title: str) -> Affine2D:
        """A picture with what it is above it; returns the way from its pixels to inches."""
        left, top = self.corner(row, column, title)
        self._image(image, left, top, self.across, self.tall)
        return self.way(row, column, image)

    def way(self, row: int, column: int, image: UInt8[np.ndarray, "h w ..."]) -> Affine2D:
        """From the pixels of a picture that is shown there to inches."""
        left, top = self.corner(row, column)
        return Affine2D().scale(self.across / image.shape[1], self.tall / image.shape[0]).translate(left, top)

    def show_scaled(
        self, row: int, column: int, share: UInt8[np.ndarray, "h w"], shade: Shade, title: str, label: str
    ) -> None:
        """A map in bytes, with its scale beneath, and what that is of."""
        self.show(row, column, shade.palette[share], title)
        left, top = self.corner(row, column)
        left, top, across = left + ARROW, top + self.tall + 0.05, self.across - 2 * ARROW
        way = -1 if shade.falls else 1
        self._image(shade.palette[None, : BYTES + 1][:, ::way], left, top, across, BAR)
        for end, x, out in zip((0, BYTES)[::way], (left, left + across), (-1, 1), strict=True):
            if end not in BOUNDS.get(shade.name, ()):
                corners = [(x, top), (x + out * ARROW, top + BAR / 2), (x, top + BAR)]
                colour = shade.palette[end] / 255
                self.figure.add_artist(Polygon(corners, color=colour, linewidth=0, transform=self.inches))
        for along, words in ticks_of(shade):
            place = 1 - along if shade.falls else along
            x, y = left + place * across, top + BAR
            self.line([x, x], [y, y + TICK])
            side = "left" if place < NEAR else "right" if place > 1 - NEAR else "center"
            self.text(x, y + TICK + 0.02, words, ha=side, fontsize=6.5)
        self.text(left + across / 2, top + BAR + 0.17, label, ha="center")

    def line(self, x: list[float], y: list[float]) -> None:
        self.figure.add_artist(Line2D(x, y, color=BLACK, linewidth=0.6, transform=self.inches))

    def plot(self, row: int, column: int, title: str) -> Axes:
        """Axes in a picture's place, with room for the numbers beside them."""
        left, top = self.corner(row, column, title)
        return self.figure.add_axes(self._box(left + 0.35, top, self.across - 0.4, self.tall).bounds)

    def corner(self, row: int, column: int, title: str = "") -> tuple[float, float]:
        """Left and top of a picture's place, below its title."""
        left, top = MARGIN + column * (self.across + MARGIN), self.tops[row]
        if title:
            self.text(left, top - 0.05, title, va="bottom", fontsize=7.5)
        return left, top

    def _image(self, image: UInt8[np.ndarray, "h w 3"], left: float, top: float, wide: float, tall: float) -> None:
        found = BboxImage(TransformedBbox(self._box(left, top, wide, tall), self.figure.transFigure))
        found.set_data(image)
        self.figure.add_artist(found)

    def _box(self, left: float, top: float, wide: float, tall: float) -> Bbox:
        across, down = self.size
        return Bbox.from_bounds(left / across, 1 - (top + tall) / down, wide / across, tall / down)


def ticks_of(shade: Shade) -> list[tuple[float, str]]:
    """Places within [0, 1], and their numbers."""
    if shade.scale != "linear":
        return shade.ticks()
    values = MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(shade.low, shade.high)
    inside = [float(value) for value in values if shade.low <= value <= shade.high]
    return [(float(shade.share(np.array(value))), f"{value:.3g}".replace("-", "−")) for value in inside]


def draw(maps: dict[str, np.ndarray], panel: Panel, record: MapRecord) -> Figure:
    """One view's panel."""
    height, width = maps["error"].shape
    error, field = record.shades["error"], record.shades[record.field]
    with style():
        sheet = Sheet(2, 2, (height, width), (False, True))
        sheet.show(0, 0, maps["photograph"], f"Photograph, {Path(panel.name).name}")
        sheet.show(0, 1, maps["render"], "Render" if panel.psnr is None else f"Render: {panel.psnr:.1f} dB")
        mean = error.low + (error.high - error.low) * maps["error"].mean() / BYTES
        sheet.show_scaled(1, 0, maps["error"], error, f"Error: {mean:.3f} on average", error.unit)
        sheet.show_scaled(1, 1, maps[record.field], field, f"Gaussians: {field.words}", field.unit)
    return sheet.figure


def draw_fragility(maps: dict[str, np.ndarray], index: int, record: MapRecord) -> Figure:
    """The three axes in a view, by its place among those of the record."""
    fragile, shades = record.fragility, record.shades
    view = next((Path(panel.name).name for panel in record.panels if panel.place == index), "")
    titles = {
        "order_gap": "Position: how far to the next change of order",
        "condition": f"Conditioning: {percent(fragile.needles)} are needles, longer than 10 : 1",
        "one_view": f"Opacity: {percent(fragile.one_view)} have over 90% of their weight in one view",
    }
    with style():
        sheet = Sheet(2, 2, maps["error"].shape, (True, True), f"{view}: where it is fragile")
        for place, (name, title) in enumerate(titles.items()):
            label = shades[name].title + ("" if name == "one_view" else "; bright: fragile")
            sheet.show_scaled(place // 2, place % 2, maps[name], shades[name], title, label)
        _draw_swaps(sheet.plot(1, 1, "Position: neighbours that change order when one moves"), fragile.swaps, index)
    return sheet.figure


def _draw_swaps(axes: Axes, swaps: Swaps, index: int) -> None:
    for view, shares in enumerate(swaps.share):
        own = view == index
        axes.semilogx(
            swaps.lengths, shares, color=VERMILION if own else "0.75", linewidth=1.4 if own else 0.7, zorder=2 + own
        )
    words = [("this view", VERMILION)] + [("other views", "0.5")] * (len(swaps.share) > 1)
    if len(swaps.share) > 1 and np.ptp(swaps.share, axis=0).max() < SAME:
        words = [(f"all {len(swaps.share)} views coincide", VERMILION)]
    for line, (text, colour) in enumerate(words):
        axes.text(0.97, 0.13 - 0.08 * line, text, color=colour, ha="right", transform=axes.transAxes)
    axes.set(xlabel="distance along the ray, px", ylim=(0, 1))
    axes.set_xticks(ticks := [0.01, 0.1, 1, 10], labels=[f"{tick:g}" for tick in ticks])
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.minorticks_off()
    axes.grid(True)


def draw_steepest(maps: dict[str, np.ndarray], end: Steepest) -> Figure:
    """An end of the spectrum: the view with the carriers, and its part at -step, 0 and +step (units of the parameters)."""
    left, top, right, bottom = end.crop
    changes, share = (
        [loss / end.losses[1] - 1 for loss in end.losses],
        percent(sum(each.share for each in end.carriers)),
    )
    step, (back, _, forth) = quantity(end.step), map(_signed, changes)
    with style():
        sheet = Sheet(2, 3, maps["view"].shape[:2], (False, True))
        whole = sheet.show(0, 0, maps["view"], f"Photograph, {end.view.rpartition('/')[2]}")
        frame = Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=BLACK, linewidth=1.0)
        _inside(sheet, frame, whole, maps["view"])
        parts = {
            "photograph": (0, 1, f"Gaussians with {share} of {end.name}"),
            "zero": (0, 2, f"Render: loss {quantity(end.losses[1])}"),
            "minus": (1, 0, f"A step of {step} back: loss {back}"),
            "plus": (1, 1, f"A step of {step} forth: loss {forth}"),
        }
        ways = {name: sheet.show(row, column, maps[name], title) for name, (row, column, title) in parts.items()} | {
            "view": whole
        }
        sheet.show_scaled(1, 2, maps["difference"], end.difference, "Forth less back", end.difference.unit)
        for name, shift in (("view", (0, 0)), ("photograph", (left, top))):
            for carrier in reversed(end.carriers):  # the first above the others
                _inside(sheet, _outline(carrier, shift, _colour(carrier, end)), ways[name], maps[name])
        x, y = sheet.corner(0, 1)
        for line, carrier in enumerate(end.carriers):
            sheet.text(
                x + 0.08, y + sheet.tall - 0.08 - 0.16 * (len(end.carriers) - 1 - line),
                f"{carrier.gaussian:,}: {percent(carrier.share)}", color=_colour(carrier, end), va="bottom",
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.2},
            )  # fmt: skip
    return sheet.figure


def _signed(share: float) -> str:
    return f"{'+' * (share > 0)}{rough(100 * share)}%"


def _colour(carrier: Carrier, end: Steepest) -> str:
    """Not of the colours of a difference."""
    return BLUE if carrier is end.carriers[0] else GREEN


def _outline(carrier: Carrier, shift: tuple[int, int], colour: str) -> Ellipse:
    x, y, long, short, angle = carrier.outline
    centre = (x - shift[0], y - shift[1])
    return Ellipse(centre, 2 * long, 2 * short, angle=math.degrees(angle), fill=False, edgecolor=colour, linewidth=0.8)


def _inside(sheet: Sheet, patch: Patch, way: Affine2D, image: np.ndarray) -> None:
    """A patch over a picture, in its pixels, without what is outside of it."""
    patch.set_transform(way + sheet.inches)
    sheet.figure.add_artist(patch)
    patch.set_clip_path(Rectangle((0, 0), image.shape[1], image.shape[0], transform=way + sheet.inches))


def draw_maps(folder: Path, suffix: str = "png", processes: int = 2) -> list[Path]:
    """Every picture of the map in `folder`."""
    record = read_map(folder)
    jobs = [("view", panel.file) for panel in record.panels] + [("fragility", panel.file) for panel in record.panels]
    jobs += [("steepest", end.file) for end in record.steepest]
    one = partial(_draw, folder, suffix, record)
    if min(processes, len(jobs)) <= 1:
        return [one(job) for job in jobs]
    with ProcessPoolExecutor(processes) as pool:
        return list(pool.map(one, jobs))


def _draw(folder: Path, suffix: str, record: MapRecord, job: tuple[str, str]) -> Path:
    kind, file = job
    maps = read_maps(folder, file, END_MAPS if kind == "steepest" else (*VIEW_MAPS, *record.shades))
    if kind == "steepest":
        figure = draw_steepest(maps, next(end for end in record.steepest if end.file == file))
    else:
        panel = next(panel for panel in record.panels if panel.file == file)
        figure = draw(maps, panel, record) if kind == "view" else draw_fragility(maps, panel.place, record)
    return save(figure, folder / f"{file.replace('view', kind)}.{suffix}", compression=2)


if __name__ == "__main__":
    program(partial(folder_script, draw_maps, "the maps of the training views", "map"))
