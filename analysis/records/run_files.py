"""The files beside a run's checkpoint: their names, their layout, and how they are read.

    RUN/metrics.json      Scores, written by `analysis/train/command.py`
    RUN/seconds.json      Seconds, written by `analysis/train/progress.py`
    RUN/trajectory.csv    a row for each record along the training, written by `analysis/train/trajectory.py`
    RUN/map/map.json      MapRecord, written by `landscape map`
    OUT/compare.json      Comparison, written by `landscape compare`

What is damaged is refused by the name of the file, with what to do.  Needs no torch.
"""

import reprlib
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from msgspec import Meta, Struct

from analysis.records.findings import ATTRIBUTES
from analysis.records.json_files import read_json, with_remedy
from analysis.records.provenance import Provenance
from analysis.records.quantities import Shade
from analysis.records.schema import INDICES, Count, NonNegative, Number, Portion
from landscape.errors import InputError
from splat.model.untrusted import NAME, read_arrays, read_table
from splat.training.origin.fingerprint import Fingerprint

if TYPE_CHECKING:
    import pandas as pd

CHECKPOINT, METRICS, SECONDS, RECORDS, COMPARISON = (
    "checkpoint.pt", "metrics.json", "seconds.json", "trajectory.csv", "compare.json",
)  # fmt: skip
MAP = "map"  # RUN/map, a folder of `landscape map`
STATES = ("whole", "coarse", "skipped")  # of a record of a trajectory
TRAJECTORY_INDICES = INDICES[:4]  # of the anisotropy
ENDS = {"lambda_max": "largest eigenvalue", "lambda_min": "smallest eigenvalue"}
WHOLE = ("step", "gaussians")  # columns of a trajectory
ALWAYS = (*WHOLE, "seconds")
LARGEST = 2**53  # that a table holds exactly
NUMBERS = (  # more of them, empty where not determined; others may be there too
    *(f"trace_{name}{part}" for name in ATTRIBUTES for part in ("", "_error", "_low", "_high")),
    *(f"{name}{part}" for name in ENDS for part in ("", "_error")),
    *(f"{name}{part}" for name in TRAJECTORY_INDICES for part in ("", "_low", "_high")),
)
FileName = Annotated[str, Meta(pattern=NAME)]  # without its suffix
_TRAJECTORY = "the records of landscape train --probe-every"


class ViewScores(Struct, kw_only=True):
    """Means over views; psnr in dB, infinite for perfect images; lpips, avge: None where they cannot be computed.

    views: those of each, by its name.
    """

    psnr: Number = None
    ssim: Number = None
    lpips: Number = None
    avge: Number = None
    views: dict[str, "ViewScores"] = {}


class Seconds(Struct):
    """Time that the steps of a training took until its last checkpoint, at `step`.

    wall, cpu: seconds by the clock, and of all processors together.  threads: that a kernel might use, None where a resume
    changed them.  peak: the most bytes of memory that the process held, loading too (of a GPU's none).
    """

    step: Count
    wall: float
    cpu: float
    threads: int | None = None
    peak: int | None = None


class Scores(Struct, kw_only=True):
    """Scores of a training; test: None without held-out views."""

    gaussians: Count
    train: ViewScores | None = None
    test: ViewScores | None = None
    seconds: Seconds | None = None
    provenance: Provenance | None = None


class Comparison(Struct, kw_only=True):
    """runs: label -> folder of the run's record; fingerprints: of the records when they were compared."""

    runs: dict[str, str]
    fingerprints: dict[str, Fingerprint] = {}


class Panel(Struct, kw_only=True):
    """A training view that was drawn.  place: among all of them; psnr: of its render, dB; file: of its arrays, NAME.npz."""

    name: str
    place: Count
    file: FileName
    psnr: Number


class Carrier(Struct, kw_only=True):
    """A Gaussian that carries a part of an eigenvector v.

    gaussian: its number among all of the checkpoint.  share: of |v|^2; attributes: shares of |v|^2 in its own parameters.
    sigmas: standard deviations, world units, the largest first.  aspect: of its splat in the picture, with the blur.  views:
    that see it; one_view: share of its weight in one of them.  outline: of its splat at two standard deviations in the picture:
    centre x, y, half axes (px), and the first axis' angle from +x towards +y (radians).
    """

    gaussian: Count
    share: Portion
    attributes: dict[str, Portion]
    sigmas: Annotated[list[NonNegative], Meta(min_length=3, max_length=3)]
    aspect: float
    opacity: Portion
    views: Count
    one_view: Portion
    outline: Annotated[list[float], Meta(min_length=5, max_length=5)]


class Steepest(Struct, kw_only=True):
    """An eigenvector of one end of the spectrum, shown where it acts.

    curvature: its eigenvalue.  participation: over how many Gaussians it is spread.  view: in which the first of the carriers
    weighs most; crop: left, top, right, bottom of the part that is shown, px.  step: along the unit vector; length: this in
    words; losses: at -step, 0, +step.  rendered: how far renders agree, in words.  difference: scale of render(+step) -
    render(-step).  file: of the pictures, NAME.npz.
    """

    name: str
    curvature: float
    participation: float
    carriers: Annotated[list[Carrier], Meta(min_length=1)]
    view: str
    crop: tuple[Count, Count, Count, Count]
    step: NonNegative
    losses: tuple[float, float, float]
    length: str = ""
    difference: Shade
    file: FileName
    sentence: str
    rendered: str = ""


class Swaps(Struct, kw_only=True):
    """Effect of Gaussians changing places with those next in front of them, on their rays.

    lengths: of ways along the ray, px.  share: of the pairs that such a way swaps, by view and length; pairs: in each view.
    jump: the mean |change of the mean loss| where a pair of the sample swaps, with its standard error; sampled: how many.
    """

    lengths: list[float]
    share: list[list[float]]
    pairs: list[Count]
    jump: Number
    jump_error: Number
    sampled: Count


class Fragility(Struct, kw_only=True):
    """The three axes (`analysis.measures.fragility`).  Shares are of the Gaussians in sight, or of a trace where it says so.

    needles: share that are; needles_steepest: share of the steepest hundredth in an attribute that are; needles_trace: share of
    an attribute's curvature that they hold.  one_view: share that one view alone sees, one_view_trace: share of opacity's
    curvature on these, opacity_one_view: rank correlation of a Gaussian's curvature in opacity with the share of its weight
    that one view alone sees; None where all have the same.  depth_gradient: of the positions' gradient along the rays over one
    direction across them (`analysis.measures.depth`).
    """

    swaps: Swaps
    needles: float
    needles_steepest: dict[str, float]
    needles_trace: dict[str, float]
    one_view: float
    one_view_trace: Number
    opacity_one_view: Number
    depth_gradient: Number = None


class MapRecord(Struct, kw_only=True):
    """Results of `landscape map`.  gaussians, seen: how many, and of these in sight; field: the one that the panels show.

    shades: of the maps, by name; that of "error" is of the mean over the channels of |render - photograph|.
    sentences: what the map says.  steepest: the ends of the spectrum, where a probe has found them.
    """

    COMMAND: ClassVar[str] = "map"
    FILE: ClassVar[str] = "map.json"

    gaussians: Count
    seen: Count
    field: str
    shades: dict[str, Shade]
    panels: list[Panel]
    sentences: list[str] = []
    steepest: list[Steepest] = []
    fragility: Fragility
    notes: list[str] = []
    provenance: Provenance
    timing: dict[str, float] = {}

    def __post_init__(self) -> None:
        if missing := sorted({self.field, "error"} - self.shades.keys()):
            raise ValueError(f"Expected a shade of {missing[0]}, got {', '.join(self.shades) or 'none'}")
        if self.seen > self.gaussians:
            raise ValueError(f"Expected at most {self.gaussians} Gaussians as `seen`, got {self.seen}")


def read_scores(run: Path) -> Scores:
    remedy = "remove it and repeat the training's command with --resume, which scores again"
    return read_json(run / METRICS, Scores, "the scores of landscape train", remedy)


def read_map(folder: Path) -> MapRecord:
    return read_json(folder / MapRecord.FILE, MapRecord, "a record of `landscape map`", "map again")


def read_maps(folder: Path, file: str, names: Collection[str]) -> dict[str, np.ndarray]:
    """The pictures of these names in a file of a map, in bytes, (h, w) or (h, w, 3).  InputError where one is none."""
    path = folder / f"{file}.npz"
    maps = with_remedy("map again", read_arrays, path)
    for name in names:
        found = maps.get(name)
        if found is None or found.dtype != np.uint8 or found.ndim not in (2, 3) or found.shape[2:] not in ((), (3,)):
            kind = "none" if found is None else f"{found.dtype} of shape {found.shape}"
            raise InputError(f"expected a picture in bytes as {name} in {path}, got {kind}; map again")
    sizes = {maps[name].shape[:2] for name in names if name not in ("view", "difference")}
    if len(sizes) > 1 or 0 in min(sizes):
        raise InputError(f"expected pictures of one size in {path}, got {sorted(sizes)}; map again")
    return {name: maps[name] for name in names}


def read_comparison(folder: Path) -> Comparison:
    return read_json(folder / COMPARISON, Comparison, "the runs of landscape compare", "compare again")


def read_trajectory(path: Path) -> "pd.DataFrame":
    """The rows of a trajectory, whose columns ALWAYS and NUMBERS hold numbers.  InputError names the file and the column."""
    import pandas as pd  # a third of a second of imports

    table = read_table(path, _TRAJECTORY)
    for name in ("state", *ALWAYS, *NUMBERS):
        if name not in table:
            raise InputError(f"expected {_TRAJECTORY} in {path}, got no column {name}")
        column = pd.Series(table[name])
        if name == "state":
            wrong, what = ~column.isin(STATES), " or ".join(STATES)
        else:
            numbers = pd.Series(pd.to_numeric(column, errors="coerce"))
            wrong, what = numbers.isna() & (column.notna() | (name in ALWAYS)), "a number"
            if name in WHOLE and not wrong.any():
                wrong, what = (numbers % 1 != 0) | ~numbers.between(0, LARGEST), "a whole number of at least 0"
            table[name] = numbers
        if wrong.any():
            row = int(wrong.to_numpy().argmax())
            raise InputError(
                f"expected {what} as {name} in {path}, got {reprlib.repr(column.iloc[row])} in row {row + 1}"
            )
    return table
