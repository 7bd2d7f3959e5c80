"""Figures: what `landscape map` found, over the training views.

    view        photograph, render, error, and one field of the Gaussians
    fragility   the way to the next swap, the condition of the splats, the share of one view; the pairs that a way swaps
    steepest    the Gaussians that carry an end of the spectrum, outlined, and what a step along it does

A field's colour in a pixel is the mean over the splats there, by their weights, of how far each is along the scale beneath.
Grey: no splat with a value.  The arrow ends of a scale say that there are values beyond.
"""

import math
import textwrap
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import PercentFormatter

from analysis.records.quantities import BYTES, NOTHING, Shade, percent, quantity
from analysis.records.run_files import MapRecord, Panel, Steepest, Swaps, read_map
from figures.style import BLACK, MISSING, SKY, VERMILION, folder_script, literal, save, style

WIDTH, TALLEST = 7.0, 9.0  # inches
MARGIN, HEAD, LEGEND, BAR = 0.1, 0.22, 0.5, 0.09  # inches: between pictures, above one, beneath one; of a scale
DOTS = 160  # an inch: a picture of two in a row has about the pixels of a photograph of 500


class Sheet:
    """Pictures of one shape in rows, each with room for a title above it and a scale beneath it."""

    def __init__(
        self, rows: int, columns: int, shape: tuple[int, int], legends: tuple[bool, ...], above: float = 0.0
    ) -> None:
        aspect = shape[0] / shape[1]
        self.across = (WIDTH - MARGIN * (columns + 1)) / columns
        rest = above + rows * HEAD + sum(legends) * LEGEND + MARGIN
        self.across = min(self.across, (TALLEST - rest) / rows / aspect)
        self.tall, self.columns = self.across * aspect, columns
        self.size = (rest + rows * self.tall, columns * (self.across + MARGIN) + MARGIN)
        self.tops = [
            above + HEAD + sum(self.tall + HEAD + LEGEND * each for each in legends[:row]) for row in range(rows)
        ]
        self.figure = Figure(figsize=(self.size[1], self.size[0]), dpi=DOTS)

    def axes(self, row: int, column: int, title: str) -> Axes:
        found = self._at(row, column, 0.0, self.tall)
        found.set_title(title, loc="left", pad=3)
        return found

    def show(self, row: int, column: int, image: np.ndarray, title: str) -> Axes:
        """A picture with what it is above it."""
        axes = self.axes(row, column, title)
        axes.imshow(image)
        axes.set_axis_off()
        return axes

    def show_scaled(self, row: int, column: int, share: np.ndarray, shade: Shade, title: str) -> Axes:
        """A map in bytes, with its scale beneath."""
        axes = self.axes(row, column, title)
        axes.imshow(np.ma.masked_equal(share, NOTHING), cmap=shade.colours, vmin=0, vmax=BYTES)
        axes.set(xticks=[], yticks=[], facecolor=MISSING)
        axes.spines[:].set_visible(False)
        linear = shade.scale == "linear"
        ends = Normalize(shade.low, shade.high) if linear else Normalize(0, 1)
        bar = self.figure.colorbar(
            ScalarMappable(ends, shade.colours), cax=self._at(row, column, self.tall + 0.05, BAR),
            orientation="horizontal", extend="max" if shade.name == "error" else "both", extendfrac=0.02,
        )  # fmt: skip
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        if not linear:
            ticks = shade.ticks()
            bar.set_ticks([place for place, _ in ticks], labels=[text for _, text in ticks])
            bar.minorticks_off()
        bar.set_label(literal(shade.unit), labelpad=1)
        return axes

    def inner(self, row: int, column: int, title: str) -> Axes:
        """Axes of a plot, with room for its labels in a picture's place."""
        axes, wide = self._at(row, column, 0.0, self.tall), self.size[1]
        box = axes.get_position()
        axes.set_position((box.x0 + 0.35 / wide, box.y0, box.width - 0.4 / wide, box.height))
        axes.set_title(title, loc="left", pad=3)
        return axes

    def _at(self, row: int, column: int, down: float, height: float) -> Axes:
        """Axes in a picture's column, so many inches beneath its top."""
        tall, wide = self.size
        left, top = MARGIN + column * (self.across + MARGIN), self.tops[row] + down
        return self.figure.add_axes((left / wide, 1 - (top + height) / tall, self.across / wide, height / tall))


def draw(maps: dict[str, np.ndarray], panel: Panel, record: MapRecord) -> Figure:
    """One view's panel."""
    height, width = maps["error"].shape
    error, field = record.shades["error"], record.shades[record.field]
    with style():
        sheet = Sheet(2, 2, (height, width), (False, True))
        sheet.show(0, 0, maps["photograph"], f"Photograph, {literal(Path(panel.name).name)}")
        sheet.show(0, 1, maps["render"], "Render" if panel.psnr is None else f"Render: {panel.psnr:.1f} dB")
        mean = error.low + (error.high - error.low) * maps["error"].mean() / BYTES
        sheet.show_scaled(1, 0, maps["error"], error, f"Error: {mean:.3f} on average")
        sheet.show_scaled(1, 1, maps[record.field], field, f"{field.words[:1].upper()}{field.words[1:]}")
    return sheet.figure


def draw_fragility(maps: dict[str, np.ndarray], index: int, record: MapRecord) -> Figure:
    """The three axes in a view, by its place among those of the record."""
    fragile, shades = record.fragility, record.shades
    titles = {
        "order_gap": "Position: way along the ray to the next swap",
        "condition": f"Conditioning: {percent(fragile.needles)} of the Gaussians are needles (above 100)",
        "one_view": f"Opacity: one view alone sees {percent(fragile.one_view)} of the Gaussians",
    }
    with style():
        sheet = Sheet(2, 2, maps["error"].shape, (True, True))
        for place, (name, title) in enumerate(titles.items()):
            sheet.show_scaled(place // 2, place % 2, maps[name], shades[name], title)
        _draw_swaps(sheet.inner(1, 1, "Pairs of neighbours that a way along the ray swaps"), fragile.swaps, index)
    return sheet.figure


def _draw_swaps(axes: Axes, swaps: Swaps, index: int) -> None:
    for view, shares in enumerate(swaps.share):
        own = view == index
        axes.semilogx(
            swaps.lengths, shares, color=VERMILION if own else "0.75", linewidth=1.4 if own else 0.7, zorder=2 + own
        )
    words = [("this view", VERMILION)] + [("other views", "0.5")] * (len(swaps.share) > 1)
    for line, (text, colour) in enumerate(words):
        axes.text(0.97, 0.13 - 0.08 * line, text, color=colour, ha="right", transform=axes.transAxes)
    axes.set(xlabel="way along the ray, px", ylim=(0, 1))
    axes.set_xticks(ticks := [0.01, 0.1, 1, 10], labels=[f"{tick:g}" for tick in ticks])
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.minorticks_off()
    axes.grid(True)


def draw_steepest(maps: dict[str, np.ndarray], end: Steepest) -> Figure:
    """An end of the spectrum: the view with the carriers, and its part at -step, 0 and +step."""
    left, top, right, bottom = end.crop
    changes = [loss / end.losses[1] - 1 for loss in end.losses]
    alone = end.curvature * end.step**2 / 2 / end.losses[1]
    words = f"A step of {quantity(end.step)} along it changes the loss, by its curvature alone, by {_signed(alone)}."
    with style():
        sheet = Sheet(2, 3, maps["view"].shape[:2], (False, True), above=0.5)
        text = "\n".join(textwrap.fill(literal(line), 115) for line in (end.sentence, words))
        sheet.figure.text(
            MARGIN / sheet.size[1], 1 - 0.08 / sheet.size[0], text, va="top", fontsize=7.5, linespacing=1.4
        )
        whole = sheet.show(0, 0, maps["view"], f"Photograph, {literal(end.view.rpartition('/')[2])}")
        whole.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=BLACK, linewidth=1.0))
        part = sheet.show(
            0, 1, maps["photograph"], f"Share of it: {', '.join(percent(each.share) for each in end.carriers)}"
        )
        for axes, shift in ((whole, (0, 0)), (part, (left, top))):
            for carrier in reversed(end.carriers):  # the first above the others
                _outline(axes, carrier.outline, shift, carrier is end.carriers[0])
        sheet.show(0, 2, maps["zero"], f"Render: loss {quantity(end.losses[1])}")
        sheet.show(1, 0, maps["minus"], f"One step back: loss {_signed(changes[0])}")
        sheet.show(1, 1, maps["plus"], f"One step forth: loss {_signed(changes[2])}")
        sheet.show_scaled(1, 2, maps["difference"], end.difference, "Forth less back")
    return sheet.figure


def _signed(share: float) -> str:
    return f"{share:+.2%}".replace("-", "−")


def _outline(axes: Axes, outline: list[float], shift: tuple[int, int], first: bool) -> None:
    x, y, long, short, angle = outline
    axes.add_patch(
        Ellipse(
            (x - shift[0] - 0.5, y - shift[1] - 0.5), 2 * long, 2 * short, angle=math.degrees(angle), fill=False,
            edgecolor=VERMILION if first else SKY, linewidth=1.0, clip_on=True,
        )
    )  # fmt: skip


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
    with np.load(folder / f"{file}.npz", allow_pickle=False) as arrays:
        maps = dict(arrays)
    if kind == "steepest":
        figure = draw_steepest(maps, next(end for end in record.steepest if end.file == file))
    else:
        panel = next(panel for panel in record.panels if panel.file == file)
        figure = draw(maps, panel, record) if kind == "view" else draw_fragility(maps, panel.place, record)
    return save(figure, folder / f"{file.replace('view', kind)}.{suffix}", compression=2)


def main() -> None:
    """`python -m figures.maps RUN/map`"""
    folder_script(draw_maps, "the maps of the training views", "map")


if __name__ == "__main__":
    main()
