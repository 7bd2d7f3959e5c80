"""One look for every figure: legible at column width, safe for colour-blind readers, the same in PNG and PDF.

Sizes are in inches, fonts in points.  Categories use the palette of Okabe and Ito (2008), fields the perceptually
uniform map cividis.  Figures are made without pyplot, so drawing has no global state.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from string import ascii_lowercase
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from PIL import Image

from analysis.records.quantities import power_of_ten
from landscape.errors import InputError
from splat.model.untrusted import replacing, write_atomically

COLUMN = 3.3
SUFFIXES = ("png", "pdf", "svg")
PAPER = ".paper.pdf"  # ends the name of a figure `for_paper`
PAPER_FONTS = ["STIXGeneral", "DejaVu Sans"]  # the second for what the first lacks
FIELD_MAP = "cividis"
MISSING = "0.85"  # grey of points without a value

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
SIDES: tuple[Literal["left", "center", "right"], ...] = ("left", "center", "right")  # of a title
RUNS = (VERMILION, GREEN, BLUE, ORANGE, PURPLE, SKY, BLACK)  # a run has the same colour in every figure
POSITIVE, NEGATIVE, UNDETERMINED = BLUE, VERMILION, "0.45"

_RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 7,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "legend.fontsize": 6.5,
    "axes.linewidth": 0.6,
    "axes.formatter.useoffset": False,
    "axes.unicode_minus": True,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    "legend.frameon": False,
    "grid.linewidth": 0.4,
    "grid.color": "0.88",
    "axes.axisbelow": True,
    "figure.dpi": 300,
    "savefig.dpi": 300,
    "pdf.fonttype": 42,  # text stays text
    "hatch.linewidth": 0.4,
}


@contextmanager
def style() -> Iterator[None]:
    """The project's matplotlib settings, within the block."""
    with mpl.rc_context(_RC):
        yield


def new_figure(height: float, width: float = COLUMN) -> Figure:
    """A figure, of column width by default, that lays itself out without overlaps."""
    return Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.05))


def for_paper(figure: Figure) -> str:
    """Set a figure as a paper has it: one or two columns wide, serif, its panels lettered; returns its titles as a caption."""
    figure.set_figwidth(COLUMN if figure.get_figwidth() <= COLUMN else 2 * COLUMN + 0.3)
    figure.draw_without_rendering()  # where the panels are
    places = {axes: axes.get_window_extent() for axes in figure.axes if any(map(axes.get_title, SIDES))}
    titled, said = sorted(places, key=lambda axes: (-round(places[axes].y1 / figure.dpi), places[axes].x0)), []
    for letter, axes in zip(ascii_lowercase, titled, strict=False):
        words = " ".join(filter(None, map(axes.get_title, SIDES)))
        for side in SIDES:
            axes.set_title(f"({letter})" if side == "left" and len(titled) > 1 else "", loc=side)
        said.append(f"({letter}) {words}." if len(titled) > 1 else f"{words}.")
    for part in (figure, *figure.subfigs):
        if words := part.get_suptitle():
            said.insert(0, f"{words}.")
            part.suptitle("")
    for text in figure.findobj(Text):
        text.set_fontfamily(PAPER_FONTS)
    return " ".join(" ".join([str(figure.get_label()), *said]).replace(r"\$", "$").split())


def save(figure: Figure, path: str | Path, compression: int = 6) -> Path:
    """Write the figure (PNG, PDF or SVG by its suffix) so that `path` is the old file or the whole new one.

    A name that ends with PAPER is drawn `for_paper`, with the caption as text beside it.

    compression: of a PNG, 0 to 9; of photographs a low one takes a fifth of the time for a few percent more bytes.
    """
    path = Path(path)
    if path.suffix[1:] not in SUFFIXES:
        raise InputError(f"expected a file that ends with .png, .pdf or .svg, got {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.name.endswith(PAPER):
        caption = for_paper(figure)
        write_atomically(path.with_suffix(".txt"), f"{caption}\n".encode())
    with style(), replacing(path) as partial:
        # savefig draws twice, once for the layout alone, and keeps that nothing shines through
        if path.suffix == ".png":
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
            picture.save(partial, "png", compress_level=compression, dpi=(figure.dpi, figure.dpi))
        else:
            figure.savefig(partial, format=path.suffix[1:])
    return path


def literal(text: str) -> str:
    """Text from a record, with nothing in it read as mathematics."""
    return text.replace("$", r"\$")


def few_decades(axis: Axis) -> None:
    """Ticks of a logarithmic axis: decades; where it spans less than two of them also 2 and 5; less than one: round numbers."""
    low, high = axis.get_view_interval()
    decades = LogLocator(subs=(1.0, 2.0, 5.0) if high < 100 * low else (1.0,), numticks=6)
    axis.set_major_locator(MaxNLocator(3) if high < 8 * low else decades)
    axis.set_major_formatter(FuncFormatter(round_number))
    axis.set_minor_formatter(NullFormatter())


def round_number(value: float, _: int | None = None) -> str:
    """A round number as the label of a tick.

    >>> round_number(20.0), round_number(1e-5), round_number(-5e-5), round_number(0.0)
    ('20', '10⁻⁵', '−5×10⁻⁵', '0')
    """
    exponent = math.floor(math.log10(abs(value)) + 1e-9) if value else 0
    leading, sign = round(abs(value) / 10.0**exponent), "−" if value < 0 else ""
    if -3 <= exponent <= 3:
        return f"{sign}{abs(value):g}"
    return sign + (f"{leading}×" if leading > 1 else "") + power_of_ten(exponent)
