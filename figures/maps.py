"""Figures: what `landscape map` found, over the training views.

    view        photograph, render, error, and one field of the Gaussians
    fragility   the distance to the next swap, the condition of the splats, the share of one view; the pairs that change order
    steepest    the Gaussians that carry an end of the spectrum, outlined, and what a step along it does

A field's colour in a pixel is the mean over the splats there, by their weights, of how far each is along the scale beneath.
Grey: no splat with a value.  The arrow ends of a scale say that there are values beyond.
"""

import math
import textwrap
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import AsinhNorm, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import AsinhLocator, FuncFormatter, MaxNLocator, PercentFormatter

from analysis.console.failures import program
from analysis.records.quantities import BEYOND, BYTES, Shade, percent, quantity, rough
from analysis.records.run_files import Carrier, MapRecord, Panel, Steepest, Swaps, read_map, read_maps
from figures.scripts import drawn_by, folder_script
from figures.style import BLACK, RUNS, VERMILION, few_decades, literal, new_figure, round_number, save, style

VIEW_MAPS = ("photograph", "render")  # pictures of a `Panel`, beside the shades of the record
END_MAPS = ("view", "photograph", "minus", "zero", "plus", "difference")  # those of a `Steepest`
SAME = 0.02  # greatest difference of curves that look alike, of their axis
WIDTH, TALLEST = 7.0, 9.0  # inches
HEAD, LEGEND = 0.35, 0.5  # inches: above a picture, beneath one with a scale
DOTS, WRAP = 160, 58  # an inch; characters above one of two pictures


def _sheet(rows: int, columns: int, shape: tuple[int, int], legends: int) -> tuple[Figure, np.ndarray]:
    """A figure with places for pictures of one shape, in rows, so many of them with scales."""
    rest = rows * HEAD + legends * LEGEND
    figure = new_figure(min(rest + rows * WIDTH / columns * shape[0] / shape[1], TALLEST), WIDTH)
    figure.set_dpi(DOTS)
    return figure, figure.subplots(rows, columns)


def _show(axes: Axes, image: UInt8[np.ndarray, "h w 3"], title: str) -> None:
    """A picture with what it is above it."""
    axes.imshow(image)
    axes.set_axis_off()
    axes.set_anchor("N")
    axes.set_title(literal(title), loc="left")


def show_scaled(axes: Axes, share: UInt8[np.ndarray, "h w"], shade: Shade, title: str, label: str) -> Colorbar:
    """A map in bytes, with its scale beneath, and what that is of."""
    _show(axes, shade.palette[share], title)
    norms = {"log": LogNorm, "signed": partial(AsinhNorm, linear_width=shade.soft), "linear": Normalize}
    low, high = shade.value(shade.low), shade.value(shade.high)
    colours = ScalarMappable(norms[shade.scale](vmin=low, vmax=high), shade.colours)
    figure: Any = axes.figure
    bar = figure.colorbar(
        colours,
        ax=axes,
        location="bottom",
        label=literal(label),
        extend=BEYOND.get(shade.name, "both"),
        panchor=(0.5, 1.0),
        aspect=30,
        pad=0.03,
    )
    if shade.scale == "log":
        few_decades(bar.ax.xaxis)
    else:
        bar.set_ticks(AsinhLocator(shade.soft, numticks=5) if shade.scale == "signed" else MaxNLocator(5), minor=False)
        bar.ax.xaxis.set_major_formatter(FuncFormatter(round_number))
    bar.minorticks_off()
    if shade.falls:
        bar.ax.invert_xaxis()
    return bar


def draw(maps: dict[str, np.ndarray], panel: Panel, record: MapRecord) -> Figure:
    """One view's panel."""
    error, field = record.shades["error"], record.shades[record.field]
    with style():
        figure, ((first, second), (third, fourth)) = _sheet(2, 2, maps["error"].shape, 1)
        _show(first, maps["photograph"], f"Photograph, {Path(panel.name).name}")
        _show(second, maps["render"], "Render" if panel.psnr is None else f"Render: {panel.psnr:.1f} dB")
        mean = error.low + (error.high - error.low) * maps["error"].mean() / BYTES
        show_scaled(third, maps["error"], error, f"Error: {mean:.3f} on average", error.unit)
        show_scaled(
            fourth, maps[record.field], field, f"Gaussians: {field.words}", f"{field.unit}; arrows: values beyond"
        )
    return figure


def draw_fragility(maps: dict[str, np.ndarray], index: int, record: MapRecord) -> Figure:
    """The three axes in a view, by its place among those of the record."""
    fragile, shades = record.fragility, record.shades
    view = next((Path(panel.name).name for panel in record.panels if panel.place == index), "")
    titles = {
        "order_gap": "Position: how far to the next change of order",
        "condition": f"Conditioning: {percent(fragile.needles)} of all are needles, longer than 10 : 1",
        "one_view": f"Opacity: {percent(fragile.one_view)} of all have over 90% of their weight in one view",
    }
    with style():
        figure, places = _sheet(2, 2, maps["error"].shape, 2)
        figure.suptitle(literal(f"{view}: where it is fragile; shares are of all Gaussians in sight"))
        for axes, (name, title) in zip(places.flat, titles.items(), strict=False):
            words = textwrap.fill(title, WRAP)
            show_scaled(axes, maps[name], shades[name], words, f"{shades[name].title}; bright: fragile")
        _draw_swaps(places[1, 1], fragile.swaps, index)
    return figure


def _draw_swaps(axes: Axes, swaps: Swaps, index: int) -> None:
    for view, shares in enumerate(swaps.share):
        own = view == index
        colour, width = (VERMILION, 1.4) if own else ("0.75", 0.7)
        axes.semilogx(swaps.lengths, shares, color=colour, linewidth=width, zorder=2 + own)
    words = [("this view", VERMILION)] + [("other views", "0.5")] * (len(swaps.share) > 1)
    if len(swaps.share) > 1 and np.ptp(swaps.share, axis=0).max() < SAME:
        words = [(f"all {len(swaps.share)} views coincide", VERMILION)]
    for line, (text, colour) in enumerate(words):
        axes.text(0.97, 0.13 - 0.08 * line, text, color=colour, ha="right", transform=axes.transAxes)
    axes.set(xlabel="distance along the ray, px", ylim=(0, 1))
    axes.set_title("Position: neighbours that change order when one moves", loc="left")
    axes.set_xticks(ticks := [0.01, 0.1, 1, 10], labels=[f"{tick:g}" for tick in ticks])
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.minorticks_off()
    axes.grid(True)


def draw_steepest(maps: dict[str, np.ndarray], end: Steepest) -> Figure:
    """An end of the spectrum: the view with the carriers, and its part at -step, 0 and +step."""
    left, top, right, bottom = end.crop
    length = f"\n({end.length})" if end.length else ""
    share = percent(sum(each.share for each in end.carriers))
    back, _, forth = (_signed(loss / end.losses[1] - 1) for loss in end.losses)
    with style():
        figure, places = _sheet(2, 3, maps["view"].shape[:2], 1)
        axes = dict(zip(("view", "photograph", "zero", "minus", "plus", "difference"), places.flat, strict=True))
        _show(axes["view"], maps["view"], f"Photograph, {end.view.rpartition('/')[2]}")
        frame = Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=BLACK, linewidth=1)
        axes["view"].add_patch(frame)
        _show(axes["photograph"], maps["photograph"], f"Gaussians with {share} of {end.name}")
        _show(axes["zero"], maps["zero"], f"Render: loss {quantity(end.losses[1])}")
        _show(axes["minus"], maps["minus"], f"A step back: loss {back}{length}")
        _show(axes["plus"], maps["plus"], f"A step forth: loss {forth}{length}")
        show_scaled(
            axes["difference"], maps["difference"], end.difference, "Render forth minus back", end.difference.unit
        )
        for picture, shift in ((axes["view"], (0, 0)), (axes["photograph"], (left, top))):
            for carrier, colour in [*zip(end.carriers, RUNS)][::-1]:  # the first above the others
                picture.add_patch(_outline(carrier, shift, colour))
        for line, (carrier, colour) in enumerate(zip(end.carriers, RUNS)):  # beneath, where they cover nothing
            words, place = f"{carrier.gaussian:,}: {percent(carrier.share)}", (line % 3 / 3, -0.03 - 0.08 * (line // 3))
            axes["photograph"].text(*place, words, color=colour, va="top", transform=axes["photograph"].transAxes)
    return figure


def _signed(share: float) -> str:
    return f"{'+' * (share > 0)}{rough(100 * share)}%"


def _outline(carrier: Carrier, shift: tuple[int, int], colour: str) -> Ellipse:
    x, y, long, short, angle = carrier.outline
    centre = (x - shift[0], y - shift[1])
    return Ellipse(centre, 2 * long, 2 * short, angle=math.degrees(angle), fill=False, edgecolor=colour, linewidth=0.8)


def draw_maps(folder: Path, suffix: str = "png", processes: int = 2) -> list[Path]:
    """Every picture of the map in `folder`."""
    record = read_map(folder)
    jobs = [("view", panel.file) for panel in record.panels] + [("fragility", panel.file) for panel in record.panels]
    jobs += [("steepest", end.file) for end in record.steepest]
    return drawn_by(processes, partial(_draw, folder, suffix, record), jobs)


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
