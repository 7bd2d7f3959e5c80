"""The recorded 2-D slice as the figures want it: losses relative to the centre, axes with their names and units.

x, y        steps along the two directions: in units of the parameters where they are unit vectors, else as `scale` says
change      loss minus the loss at the centre
unit        sqrt(2 loss_scale / |curvature|): the step within which the curvature alone changes the loss by loss_scale
evaluated   a point that is a true render; the others are interpolated, or unknown where the plane is not resolved
crossed     a render whose order of splats or set of visible ones is not the centre's: the loss may jump on the way there
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from analysis.records import schema
from analysis.records.findings import unresolved
from analysis.records.quantities import exponent_of, unit_suffix
from analysis.records.records import Record
from figures.style import literal
from landscape.errors import InputError

NOT_CONFIRMED = "not confirmed by renders"
TRUE_PROPORTIONS = 2.5  # ranges whose ratio is below this are drawn to the same scale


@dataclass(frozen=True)
class Direction:
    """One axis of the slice; `exponent` is the power of ten taken out of its labels, `scale` what a step of 1 is."""

    name: str
    curvature: float
    unit: float
    steps: np.ndarray
    exponent: int
    scale: str = "units of the parameters"
    kind: str = ""

    @property
    def label(self) -> str:
        return f"step along {self.name}, {self.scale}{unit_suffix(self.exponent)}"

    @property
    def short_label(self) -> str:
        return f"step along {self.name}{unit_suffix(self.exponent)}"

    @property
    def scaled(self) -> np.ndarray:
        return self.steps / 10.0**self.exponent

    @property
    def centre(self) -> int:
        """The index of the step nearest to 0."""
        return int(np.argmin(np.abs(self.steps)))

    def count_units(self, axes: Axes, ticks: int, label: str, **look: Any) -> None:
        """An upper axis that counts steps in curvature units, where there is such a unit."""
        step = self.unit / 10.0**self.exponent
        if np.isfinite(step) and step > 0:
            both = (lambda x: np.divide(x, step), lambda u: np.multiply(u, step))
            upper = axes.secondary_xaxis("top", functions=both)
            upper.xaxis.set_major_locator(MaxNLocator(ticks))
            upper.set_xlabel(label, **look)


@dataclass(frozen=True)
class Plane:
    """change, model [nx, ny], masked where not finite, in units of 10**exponent; model and crossed may be absent.

    error: of the interpolation, as a share of the range of the loss: the tolerance that its bound met; 0 where every point
    is evaluated.  unresolved: why there is no surface, in words; empty where there is one.
    """

    x: Direction
    y: Direction
    change: np.ma.MaskedArray
    model: np.ma.MaskedArray | None
    crossed: np.ndarray | None
    evaluated: np.ndarray
    error: float | None
    unresolved: str
    exponent: int
    loss_scale: float

    @property
    def label(self) -> str:
        return f"change of loss{unit_suffix(self.exponent)}"

    @property
    def rise(self) -> np.ma.MaskedArray:
        """The change in the loss's own unit."""
        return self.change * 10.0**self.exponent

    def through_centre(self, values: np.ndarray, axis: int) -> np.ndarray:
        """Values [nx, ny] on the grid's line through the centre along the first (axis 0) or the second direction."""
        other = self.y if axis == 0 else self.x
        return values.take(other.centre, axis=1 - axis)

    @property
    def others(self) -> list[tuple[float, float]]:
        """Where other checkpoints lie: at the ends of lines."""
        lines = [direction.kind == "line" for direction in (self.x, self.y)]
        return [place for place, line in zip([(1.0, 0.0), (0.0, 1.0)], lines, strict=True) if line]

    @property
    def dots(self) -> np.ndarray:
        """Renders, which pictures mark where there are other points."""
        return self.evaluated & (not self.evaluated.all())


def plane(record: Record) -> Plane:
    """The slice of a record.  Raises InputError where none was recorded, or none of its points is finite."""
    about = record.data.slice
    if about is None or "slice" not in record.arrays:
        raise InputError(f"expected a recorded slice in {record.folder / 'slice.npz'}, got none; probe with a slice")
    arrays = record.arrays["slice"]
    if "y" not in arrays:
        raise InputError(f"expected a slice over a plane in {record.folder / 'slice.npz'}, got one along a line")
    changes = [arrays[name] - about.center_loss for name in ("loss", "model") if name in arrays]
    if not np.isfinite(changes[0]).any():
        raise InputError(f"expected finite losses in {record.folder / 'slice.npz'}, got none")
    exponent = exponent_of(changes[0])
    masked = [np.ma.masked_invalid(change / 10.0**exponent) for change in changes]
    common, spans = exponent_of(arrays["x"], arrays["y"]), sorted((np.ptp(arrays["x"]), np.ptp(arrays["y"])))
    alike = spans[1] < 100 * spans[0]  # both axes read well with the same power of ten taken out
    directions = [
        direction(d, steps, common if alike else exponent_of(steps))
        for d, steps in zip(about.directions, (arrays["x"], arrays["y"]), strict=True)
    ]
    return Plane(
        *directions,
        change=masked[0],
        model=masked[1] if len(masked) == 2 else None,
        crossed=arrays.get("crossed"),
        evaluated=arrays.get("evaluated", np.ones(arrays["loss"].shape, bool)),
        error=about.tolerance or about.interpolation_error,
        unresolved="" if about.is_resolved else unresolved(about, record.data.provenance),
        exponent=exponent,
        loss_scale=about.loss_scale,
    )


def direction(about: schema.Direction, steps: np.ndarray, exponent: int) -> Direction:
    """An axis as it was recorded."""
    curvature, unit = (np.nan if number is None else number for number in (about.curvature, about.unit))
    scale = about.scale or Direction.scale
    return Direction(literal(about.name), curvature, unit, steps, exponent, literal(scale), about.kind or "")


def same_scale(x: float, y: float) -> bool:
    """Whether two ranges are drawn to the same scale."""
    return 1 / TRUE_PROPORTIONS < x / y < TRUE_PROPORTIONS
