"""One look for every figure: legible at column width, safe for colour-blind readers, the same in PNG and PDF.

Sizes are in inches, fonts in points.  Categories use the palette of Okabe and Ito (2008), fields the perceptually
uniform map cividis.  Figures are made without pyplot, so drawing has no global state.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

from landscape.errors import InputError
from splat.model.untrusted import replacing

COLUMN = 3.3
SUFFIXES = ("png", "pdf", "svg")
FIELD_MAP = "cividis"
MISSING = "0.85"  # grey of points without a value

BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
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


def save(figure: Figure, path: str | Path, compression: int = 6) -> Path:
    """Write the figure (PNG, PDF or SVG by its suffix) so that `path` is the old file or the whole new one.

    compression: of a PNG, 0 to 9; of photographs a low one takes a fifth of the time for a few percent more bytes.
    """
    path = Path(path)
    if path.suffix[1:] not in SUFFIXES:
        raise InputError(f"expected a file that ends with .png, .pdf or .svg, got {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with style(), replacing(path) as partial:
        if (
            path.suffix == ".png"
        ):  # savefig draws twice, once for the layout alone, and keeps that nothing shines through
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
