"""Figure: a training view as `landscape map` found it: photograph, render, error, and one field of the Gaussians over it.

The field's colour in a pixel is the mean over the splats there, by their weights, of how far each is along the scale beneath.
Grey: no splat with a value.  The arrow ends of a scale say that there are values beyond.
"""

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from analysis.records.quantities import Shade
from analysis.records.run_files import MapRecord, Panel, read_map
from figures.style import FIELD_MAP, MISSING, folder_script, literal, save, style

WIDTH, TALLEST = 7.0, 9.0  # inches
MARGIN, HEAD, LEGEND, BAR = 0.1, 0.22, 0.5, 0.09  # inches: between pictures, above one, beneath one; of a scale
DIVERGING, ERRORS = "PuOr_r", "magma"
STEPS, NOTHING = 254, 255  # of the bytes
DOTS = 160  # an inch: a picture of two in a row has about the pixels of a photograph of 500


class Sheet:
    """Pictures of one shape in rows, each with room for a title above it and a scale beneath it."""

    def __init__(self, rows: int, columns: int, shape: tuple[int, int], legends: tuple[bool, ...]) -> None:
        aspect = shape[0] / shape[1]
        self.across = (WIDTH - MARGIN * (columns + 1)) / columns
        rest = rows * HEAD + sum(legends) * LEGEND + MARGIN
        self.across = min(self.across, (TALLEST - rest) / rows / aspect)
        self.tall, self.columns = self.across * aspect, columns
        self.size = (rest + rows * self.tall, columns * (self.across + MARGIN) + MARGIN)
        self.tops = [sum(self.tall + HEAD + LEGEND * each for each in legends[:row]) + HEAD for row in range(rows)]
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
        axes.imshow(np.ma.masked_equal(share, NOTHING), cmap=_colours(shade), vmin=0, vmax=STEPS)
        axes.set(xticks=[], yticks=[], facecolor=MISSING)
        axes.spines[:].set_visible(False)
        linear = shade.scale == "linear"
        ends = Normalize(shade.low, shade.high) if linear else Normalize(0, 1)
        bar = self.figure.colorbar(
            ScalarMappable(ends, _colours(shade)), cax=self._at(row, column, self.tall + 0.05, BAR),
            orientation="horizontal", extend="max" if shade.name == "error" else "both", extendfrac=0.02,
        )  # fmt: skip
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        if not linear:
            ticks = shade.ticks()
            bar.set_ticks([place for place, _ in ticks], labels=[text for _, text in ticks])
            bar.minorticks_off()
        bar.set_label(literal(shade.unit), labelpad=1)
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
        mean = error.low + (error.high - error.low) * maps["error"].mean() / STEPS
        sheet.show_scaled(1, 0, maps["error"], error, f"Error: {mean:.3f} on average")
        sheet.show_scaled(1, 1, maps[record.field], field, f"{field.words[:1].upper()}{field.words[1:]}")
    return sheet.figure


def _colours(shade: Shade) -> str:
    return ERRORS if shade.name == "error" else DIVERGING if shade.diverges else FIELD_MAP


def draw_maps(folder: Path, suffix: str = "png", processes: int = 2) -> list[Path]:
    """The pictures of every view that was mapped into `folder`."""
    record = read_map(folder)
    one = partial(_draw, folder, suffix, record)
    if min(processes, len(record.panels)) <= 1:
        return [one(panel) for panel in record.panels]
    with ProcessPoolExecutor(processes) as pool:
        return list(pool.map(one, record.panels))


def _draw(folder: Path, suffix: str, record: MapRecord, panel: Panel) -> Path:
    with np.load(folder / f"{panel.file}.npz", allow_pickle=False) as arrays:
        return save(draw(dict(arrays), panel, record), folder / f"{panel.file}.{suffix}")


def main() -> None:
    """`python -m figures.maps RUN/map`"""
    folder_script(draw_maps, "the maps of the training views", "map")


if __name__ == "__main__":
    main()
