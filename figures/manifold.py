"""Recorded slices of several landscapes to one scale, for the figures that compare them.

Every slice is drawn along its own two steepest eigenvectors, but all share their axes: steps in units of the parameters, as far
as all of them reach, and the change of the loss from its own centre.  So a valley that is narrower looks narrower, and all that
is shown was rendered; `landscape slice --radius` renders farther.
"""

import math
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from analysis.records.provenance import require_alike
from analysis.records.quantities import exponent_of, unit_suffix
from analysis.records.records import ProbeRecord, Record, SliceRecord, read_record
from analysis.records.run_files import CHECKPOINT
from figures.plane import NOT_CONFIRMED, Plane, plane
from figures.scripts import add_paper, print_files
from figures.style import BLACK, FIELD_MAP, MISSING, literal, save
from landscape.errors import InputError

START = "start"
ROOM = 0.05  # of the range of sections, beyond it
INNER = 0.65  # of the reach of a surface: no tick farther out
ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
# beside a checkpoint, the first that is there
SLICES = (("slice-eigenvectors-2d", SliceRecord), ("probe", ProbeRecord))
LEVELS, POINTS = 10, 61  # of a contour plot; of a window, each way
NAMES = ("e₁", "e₂")
FUNCTION = {"views": "training views", "sizes": "sizes of the views", "loss": "loss", "background": "background"}


@dataclass(frozen=True)
class Scale:
    """Limits that landscapes share: steps to +-reach, changes of the loss from low to high."""

    reach: float
    low: float
    high: float

    @classmethod
    def of(cls, *landscapes: Plane) -> "Scale":
        reach = min(float(np.abs(d.steps).max()) for each in landscapes for d in (each.x, each.y))
        shown = [window(each, reach)[1] for each in landscapes]
        low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
        return cls(reach, low, high if high > low else low + 1.0)

    @property
    def steps(self) -> int:
        return exponent_of(self.reach)

    @property
    def loss(self) -> int:
        return exponent_of(np.array([self.low, self.high]))

    @property
    def loss_label(self) -> str:
        return f"change of loss{unit_suffix(self.loss)}"

    def step_label(self, name: str) -> str:
        return f"step along {name}{unit_suffix(self.steps)}"

    def flat_label(self, name: str) -> str:
        """Label of a horizontal axis, which has the room for the unit below."""
        return f"{self.step_label(name)}\n(units of the parameters)"

    def of_sections(self, *landscapes: Plane) -> "Scale":
        """Limits with the same steps that hold the landscapes' sections, with some room."""
        near = np.ma.concatenate(
            [
                each.through_centre(each.rise, axis)[np.abs(along.steps) <= self.reach]
                for each in landscapes
                for axis, along in enumerate((each.x, each.y))
            ]
        )
        low, high = float(near.min()), float(near.max())
        room = ROOM * (high - low) or 1.0
        return replace(self, low=low - room, high=high + room)


def window(landscape: Plane, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps up to `reach`, POINTS each way, and the change of the loss there [along x, along y], linear between the grid's.

    nan next to a loss that is not finite.
    """
    steps, rise = np.linspace(-reach, reach, POINTS), landscape.rise.filled(np.nan)
    across = np.stack([np.interp(steps, landscape.x.steps, line) for line in rise.T])
    return steps, np.stack([np.interp(steps, landscape.y.steps, line) for line in across.T])


def require_same_function(runs: Sequence[Path]) -> None:
    """InputError where the runs' landscapes are those of different functions; what a record lacks is not compared."""
    records = {run: record_of(run).data for run in runs}
    for key, what in FUNCTION.items():
        found = {
            run: getattr(data.provenance if key == "views" else data.objective, key) for run, data in records.items()
        }
        known = {run: value for run, value in found.items() if value}
        require_alike(what, known, "draw them apart")


def landscape_of(run: Path) -> Plane:
    """The recorded slice around a run's checkpoint, along its two steepest eigenvectors.

    FileNotFoundError or ValueError name the record that is missing and the command that makes it.
    """
    return plane(record_of(run))


def record_of(run: Path) -> Record:
    for name, kind in SLICES:
        if (run / name / kind.FILE).is_file():
            found = read_record(run / name, kind)
            directions = found.data.slice.directions if found.data.slice else ()
            if tuple(direction.name for direction in directions) != NAMES:
                raise InputError(
                    f"expected a slice along {' and '.join(NAMES)} in {run / name}, got others; {_slice(run)}"
                )
            if found.data.slice is None or found.data.slice.is_resolved:
                return found
    if not (run / CHECKPOINT).is_file():
        raise FileNotFoundError(f"expected a run of `landscape train` in {run}, found no {CHECKPOINT} there")
    raise FileNotFoundError(
        f"expected a slice of {run} in {' or '.join(str(run / name) for name, _ in SLICES)}, with a surface, "
        f"found none; {_slice(run)}"
    )


def doubt_of(run: Path) -> str:
    """Words where renders of the run's probe do not confirm its λ max; none without such."""
    if not (run / "probe" / ProbeRecord.FILE).is_file():
        return ""
    return NOT_CONFIRMED * read_record(run / "probe", ProbeRecord).data.eigenvalues.max.doubted


def start_of(run: Path) -> Plane:
    """Landscape of where a run began."""
    recorded = any((run / START / name / kind.FILE).is_file() for name, kind in SLICES)
    if not recorded and not (run / START / CHECKPOINT).is_file():
        raise FileNotFoundError(
            f"expected the start of the run in {run / START / CHECKPOINT}, found none; train anew with --probe-every, "
            f"which keeps it, then {_slice(run / START)}"
        )
    return landscape_of(run / START)


def _slice(run: Path) -> str:
    return f"run: landscape slice {run / CHECKPOINT}"


def surface(
    figure: Figure, place: tuple[int, int, int], landscape: Plane, scale: Scale, title: str
) -> tuple[Axes3D, ScalarMappable]:
    """The loss as a surface over both steps: its axes, and its colours."""
    axes: Axes3D = figure.add_subplot(*place, projection="3d")  # pyright: ignore[reportAssignmentType]
    steps, loss = 10.0**scale.steps, 10.0**scale.loss
    along, rise = window(landscape, scale.reach)
    x, y = np.meshgrid(along / steps, along / steps, indexing="ij")
    height = rise / loss
    low, high = scale.low / loss, scale.high / loss
    drawn = axes.plot_surface(x, y, height, cmap=FIELD_MAP, rcount=60, ccount=60, linewidth=0.1, vmin=low, vmax=high)
    reach = scale.reach / steps
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(low, high))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(FixedLocator(_inner_ticks(reach)))
    axes.zaxis.set_major_locator(MaxNLocator(3))
    axes.tick_params(labelsize=5, pad=-3)
    axes.set_xlabel(f"e₁{unit_suffix(scale.steps)}", fontsize=6, labelpad=-4)
    axes.set_ylabel(f"e₂{unit_suffix(scale.steps)}", fontsize=6, labelpad=-3)
    axes.set_title(f"{literal(title)};\n{scale.loss_label}", y=0.95)
    axes.view_init(elev=45, azim=-58)  # into the valley, over its walls
    # the layout does not count the labels of such axes
    axes.set_box_aspect(None, zoom=0.72)  # pyright: ignore[reportArgumentType]
    return axes, drawn


def _inner_ticks(reach: float) -> list[float]:
    """A round number to either side, far enough from the ends, where another axis has ticks.

    >>> _inner_ticks(0.067)
    [-0.04, 0.04]
    """
    power = 10.0 ** math.floor(math.log10(INNER * reach))
    tick = max(round_one * power for round_one in ROUND if round_one * power <= INNER * reach)
    return [-tick, tick]


def contours(axes: Axes, landscape: Plane, scale: Scale) -> QuadContourSet:
    """Landscape from above, at levels that all landscapes share."""
    steps, loss = 10.0**scale.steps, 10.0**scale.loss
    levels = np.asarray(MaxNLocator(LEVELS).tick_values(scale.low / loss, scale.high / loss))
    x, y = landscape.x.steps / steps, landscape.y.steps / steps
    change = np.ma.clip(landscape.rise.T / loss, levels[0], levels[-1])  # which it leaves outside the limits only
    axes.set_facecolor(MISSING)
    filled = axes.contourf(x, y, change, levels=levels, cmap=FIELD_MAP)
    axes.contour(x, y, change, levels=levels, colors=BLACK, linewidths=0.4, linestyles="solid")
    reach = scale.reach / steps
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):  # as many at any size: the layout counts their room at its first size
        axis.set_major_locator(MaxNLocator(4))
    axes.set_xlabel(scale.flat_label("e₁"))
    axes.set_ylabel(scale.step_label("e₂"))
    return filled


def section(axes: Axes, landscape: Plane, scale: Scale, axis: int, **look: object) -> None:
    """The grid's line through the centre along the first (axis 0) or the second direction."""
    steps, rise = (landscape.x, landscape.y)[axis].steps, landscape.through_centre(landscape.rise, axis)
    axes.plot(steps / 10.0**scale.steps, rise / 10.0**scale.loss, **look)  # pyright: ignore[reportArgumentType]
    reach, loss = scale.reach / 10.0**scale.steps, 10.0**scale.loss
    axes.set(xlim=(-reach, reach), ylim=(scale.low / loss, scale.high / loss))
    for each in (axes.xaxis, axes.yaxis):
        each.set_major_locator(MaxNLocator(4))
    axes.grid(True)


def runs_script(draw: Callable[[Sequence[Path]], Figure], name: str) -> int:
    """Draw two runs into a file."""
    parser = ArgumentParser(description=f"Draw {name} from the records of two runs.")
    parser.add_argument(
        "runs", type=Path, nargs=2, metavar="RUN", help="folders of landscape train: 3DGS, then StableGS"
    )
    parser.add_argument("--out", type=Path, default=Path(f"{name}.png"), help="PNG, PDF or SVG, by its suffix")
    options = add_paper(parser).parse_args()
    out = options.out.with_suffix(f".{options.format}") if options.format else options.out
    return print_files(lambda: [save(draw(options.runs), out)])
