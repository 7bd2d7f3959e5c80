"""The sections of a record as typed structures (`msgspec`): meaning and type of every key.

The whole files `probe.json` and `slice.json` are `ProbeRecord` and `SliceRecord` in `analysis.records.records`.  Losses are
dimensionless; curvatures are loss per squared unit of the parameters, with respect to the stored parameters.

null (None)   not determined; the `note` beside it says why
UNSET         the key is absent: not every file has it.  UNSET is false, as None is
not finite    a float; in the file, which is strict JSON, the text "NaN", "Infinity" or "-Infinity"

Keys of a file that are not fields are ignored; a file of another version of its format is refused.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Generic, Literal, TypeVar

from msgspec import UNSET, Meta, Struct, UnsetType

T = TypeVar("T")
Maybe = T | UnsetType  # a key that may be absent
Number = float | None
Count = Annotated[int, Meta(ge=0)]
Sign = Literal["positive", "negative", "zero", "undetermined"]
Operator = Literal["hessian", "gauss-newton"]
IndexName = Literal["eigenvalue_ratio", "negative_ratio", "top_mass", "participation_ratio"]
ROUND_OFF = 1e-6  # by which shares may leave [0, 1]
NonNegative = Annotated[float, Meta(ge=0)]
Portion = Annotated[float, Meta(ge=-ROUND_OFF, le=1 + ROUND_OFF)]


class Named(Struct, Generic[T]):
    """Entries of one kind under names; some may be absent."""

    def items(self) -> Iterator[tuple[str, T]]:
        """Entries that are there, by name."""
        return ((name, getattr(self, name)) for name in self.__struct_fields__ if getattr(self, name))


class Objective(Struct, kw_only=True):
    """The function whose curvature is measured.

    loss: its formula in words.  sizes: (width, height) of each view, px.  value: L at the checkpoint.
    gradient_norm: |dL/dTheta|.  views_error: of value, as for `TraceOf`.
    """

    loss: str | None = None
    sizes: list[tuple[int, int]] | None = None
    background: tuple[float, float, float] | None = None
    value: Number = None
    gradient_norm: Number = None
    views_error: Maybe[Number] = UNSET


class TraceOf(Struct, kw_only=True):
    """The estimate of a trace.

    standard_error: of value; 0 where the method is exact.  low, high: ends of the interval at `confidence`, e.g. 0.95.
    sign: "undetermined" where the interval does not decide it.  dim: parameters of the block.  probes: random vectors; 0 where
    exact.  matvecs: products H v.  reason: why it stopped, one of `landscape.results.StopReason`.
    method: "exact", or "exact, but SSIM's window is sampled".
    views_error: where training views were left out (`Counts.views_of`), the standard error of value as an estimate for all
    views, as if those measured had been drawn at random; null where not known.
    """

    value: Number
    standard_error: Number
    low: Number = None
    high: Number = None
    confidence: Number = None
    sign: Sign
    dim: Count
    probes: Count
    matvecs: Count = 0
    reason: str = ""
    method: str
    views_error: Maybe[Number] = UNSET

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high); where not known, one standard error to either side of value."""
        if self.low is not None and self.high is not None and math.isfinite(self.high - self.low):
            return self.low, self.high
        value, error = self.value or 0.0, self.standard_error
        error = error if error is not None and math.isfinite(error) else 0.0
        return value - error, value + error

    @property
    def magnitudes(self) -> tuple[float, float]:
        """The least and the largest |x| in the interval, which two of views_error make wider to either side."""
        apart = 0.0 if self.views_error is UNSET else math.inf if self.views_error is None else 2 * self.views_error
        low, high = self.interval[0] - apart, self.interval[1] + apart
        return 0.0 if low <= 0 <= high else min(abs(low), abs(high)), max(abs(low), abs(high))


class Trace(TraceOf, kw_only=True):
    """Trace of one attribute's block.  dim: its directions that are not exactly flat; tau: sqrt(max(value, 0) / dim)."""

    tau: Number


class LivesOn(Struct, kw_only=True):
    """Localization of an eigenvector (`analysis.measures.localization`).

    participation: over how many Gaussians the squared mass |v|^2 is spread.  needles: share of it on Gaussians with a condition
    number above 100; needle_count: the number of those.
    """

    participation: Number
    needles: Portion
    needle_count: Count


class End(Struct, kw_only=True):
    """A Ritz value of an operator, signed, with its unit Ritz vector v.

    residual: |H v - value v|: an eigenvalue lies within this distance.  reason: as for `TraceOf`.  views_error: likewise, of
    v . H v at this v; in the views left out another direction may be steeper; the largest eigenvalue of few views is usually
    too large, as it is convex in H.
    """

    value: Number
    residual: Number
    reason: str | None = None
    views_error: Maybe[Number] = UNSET

    @property
    def is_reached(self) -> bool:
        """Whether the search for it did not end at a budget."""
        return not (self.reason or "").endswith("budget")


class Renders(Struct, kw_only=True):
    """Rendered losses along an eigenvector v beside its eigenvalue (`landscape.slices.finite_probe`).

    steps: along v, each twice the one before; ratios: to the quadratic model, of the second difference to the
    eigenvalue; errors: of these, four standard errors of round-off.  confirmed: null where round-off decides; low, high: of
    the steps that confirm.  optimiser_step: the root mean square length along v of a step with random signs, as long as the
    optimiser's first in every parameter: one of the steps; 0 where not known.  kinks: the curvature
    of L1's kinks along v, which the eigenvalue leaves out (`analysis.measures.steepest`).
    """

    confirmed: bool | None
    low: Number = None
    high: Number = None
    optimiser_step: NonNegative = 0.0
    kinks: NonNegative = 0.0
    steps: list[float]
    ratios: list[Number]
    errors: list[Number]

    @property
    def at_step(self) -> Number:
        """The ratio at the optimiser's step; None where it is not known or round-off hides it."""
        if not self.optimiser_step:
            return None
        i = self.steps.index(self.optimiser_step)
        ratio, error = self.ratios[i], self.errors[i]
        return ratio if ratio is not None and error is not None and abs(ratio) > error else None

    @property
    def hidden(self) -> float:
        """The longest step of which round-off leaves open whether its ratio is of 1/2 to 2; 0 without one."""
        numbers = zip(self.steps, self.ratios, self.errors, strict=True)
        known = [(step, ratio, error) for step, ratio, error in numbers if ratio is not None and error is not None]
        return max((d for d, r, e in known if r - e < 2 and r + e >= 0.5 and not max(e, 0.5) < r < 2), default=0.0)

    def bent_by_kinks(self, value: float) -> bool:
        """Whether L1's kinks are why the eigenvalue is not confirmed: they bend upwards, as renders then do beside it."""
        ratio = self.at_step
        return self.confirmed is False and self.kinks > abs(value) and (ratio is None or ratio * value > value)


class Carries(Struct, kw_only=True):
    """The Gaussian with most mass in an eigenvector.

    gaussian: its number among all of the checkpoint.  share: of |v|^2; random_share: the largest that a Gaussian has of a
    random vector.  attribute: that of most mass in it.  shape: kind and place of its splat, in words; view: where it has most
    weight; outline: its ellipse there, px, in order x, y, half axes, angle.  found: of the first ten eigenpairs from this end,
    those that the search found; wide: of these, the first on more than ten Gaussians: place, eigenvalue, participation over
    Gaussians; absent where there is none.
    """

    gaussian: Count
    share: Portion
    random_share: Portion = 0.0
    attribute: str
    shape: str = ""
    view: str = ""
    outline: list[float] = []
    found: Count = 0
    wide: Maybe[tuple[Count, float, float]] = UNSET


class Eigenvalue(End, kw_only=True):
    """Eigenvalue of the active operator.  matvecs: products H v of its search.  shares: of v's squared mass by attribute."""

    matvecs: Count | None = None
    method: str = ""
    shares: dict[str, Portion] = {}
    lives_on: Maybe[LivesOn] = UNSET
    renders: Maybe[Renders] = UNSET
    carrier: Maybe[Carries] = UNSET

    @property
    def doubted(self) -> bool:
        """Whether it was rendered without being confirmed."""
        return bool(self.renders and not self.renders.confirmed)


class Eigenvalues(Named[Eigenvalue], kw_only=True):
    """The two largest and the smallest, and both ends by the paper's power iteration."""

    max: Eigenvalue
    second: Maybe[Eigenvalue] = UNSET
    min: Eigenvalue
    power_max: Maybe[Eigenvalue] = UNSET
    power_min: Maybe[Eigenvalue] = UNSET


class Index(Struct, kw_only=True):
    """An index and its bracket.  value: None where undefined; low, high: None where unbounded."""

    value: Number
    low: Number
    high: Number
    note: str


class Anisotropy(Named[Index], kw_only=True):
    """The indices of `landscape.spectrum.anisotropy`."""

    eigenvalue_ratio: Maybe[Index] = UNSET
    negative_ratio: Maybe[Index] = UNSET
    top_mass: Maybe[Index] = UNSET
    participation_ratio: Maybe[Index] = UNSET


INDICES = Anisotropy.__struct_fields__


class Concentration(Named[Index], kw_only=True):
    """In how few directions the curvature lies (`landscape.spectrum.concentration`), with brackets over start vectors.

    half: the number of directions that hold half of all curvature.  top_10, top_100: the share that so many hold.
    """

    half: Index
    top_10: Index
    top_100: Index


class FiniteProbe(Struct, kw_only=True):
    """The second difference (L(+d v) + L(-d v) - 2 L) / d^2 along a direction v, for all steps d of it.

    round_off: bound of its error.  crossed: whether the order of the splats or the set of visible ones changed, by step; None
    where not known.  infinitesimal: v . H v.  center_loss, noise: L and the standard deviation of the error of an evaluation.
    evaluations: renders of all views.
    """

    steps: Annotated[list[float], Meta(min_length=1)]
    curvatures: list[Number]
    round_off: list[Number]
    crossed: list[bool] | None
    infinitesimal: Number
    center_loss: Number = None
    noise: Number = None
    evaluations: Count = 0

    def __post_init__(self) -> None:
        columns = [self.curvatures, self.round_off, *([self.crossed] if self.crossed else [])]
        if {len(column) for column in columns} != {len(self.steps)}:
            raise ValueError("Expected one curvature, round_off and crossed for each step, got others")


class Rise(Struct, kw_only=True):
    """Rises of the loss by finite steps along the rays (depth) and across them (lateral), with standard errors; ratio: depth
    over lateral.

    pixels: length of the steps: the displacement in the image of a step across the ray.  _crossed: share of the renders in
    which the order of the splats or the set of visible ones changed.
    """

    pixels: float
    ratio: Number
    ratio_error: Number
    depth: Number
    depth_error: Number
    depth_crossed: Portion
    lateral: Number
    lateral_error: Number
    lateral_crossed: Portion


class Depth(Struct, kw_only=True):
    """Derivatives of the positions along the rays, over those in one direction across them (`analysis.measures.depth`).

    gradient_ratio: of root mean squares over `pairs` of a Gaussian and a view; gradient_median: median of the pairs' ratios.
    curvature: its traces both ways.  curvature_ratio: of the mean curvatures.  rises: one for each length of steps.
    """

    gradient_ratio: Number
    gradient_median: Number
    pairs: Count
    curvature: dict[Literal["depth", "lateral"], TraceOf]
    curvature_ratio: Index
    rises: list[Rise]


class BlockAnisotropy(Struct, kw_only=True):
    """The anisotropy of one diagonal block of one operator (`analysis.measures.per_attribute`).

    metric, unit: units in which curvature is compared, by name and in words.  block: "all" or an attribute.  split: whether of
    the split scene.  rank: rows of the block less the exact null space.  beyond: distance beyond the Ritz values that the
    spectrum may reach (`landscape.eigen.pairs.EigenEnds`).
    """

    metric: str
    unit: str
    operator: Operator
    block: str
    split: bool
    gaussians: Count
    rank: Count
    lambda_max: End
    lambda_min: End
    beyond: Number = None
    indices: Anisotropy


class Effect(Index, kw_only=True):
    """Ratio of an index of the split scene to that of the trained one."""

    operator: Operator
    block: str
    index: IndexName


class SplitControl(Struct, kw_only=True):
    """Effect of splitting every Gaussian in two (`analysis.measures.split_control`).

    gaussians: of the split scene.  rms, psnr (dB): change of the images; psnr is None where nothing changed.
    """

    gaussians: Count
    rms: float
    psnr: Number
    effects: list[Effect]


class Direction(Struct, kw_only=True):
    """One axis of a slice: a vector, of unit length in a probe.

    kind: "eigenvectors", "random", "gradient" or "line".  slope, curvature: of the loss along it.  residual: of an
    eigenvector, else None.  unit: sqrt(2 loss_scale / |curvature|), the step within which the curvature alone changes the loss
    by loss_scale; infinite without curvature.  scale: what a step of 1 is.  views_error: of the curvature, as for `TraceOf`.
    """

    name: str
    kind: Maybe[str] = UNSET
    slope: Maybe[Number] = UNSET
    curvature: Number
    residual: Number = None
    unit: Number
    scale: Maybe[str] = UNSET
    views_error: Maybe[Number] = UNSET


class Slice(Struct, kw_only=True):
    """The loss along a line or over a plane through the checkpoint.

    center_loss: L at the centre, rendered with the slice.  points, evaluated_points, crossed_points: of the grid, see ARRAYS;
    evaluations: renders of all views.  Errors are shares of the range of the losses.  tolerance: asked of
    interpolated points; None where all are evaluated.  resolved: whether it was reached; else only evaluated points have a
    loss.  interpolation_error: bound at every interpolated point (`landscape.slices.interpolation`); 0 where all are evaluated,
    None where there is no bound.  error_seen: the largest at `holdout_points` random points.  reason: as for `Trace`.
    """

    directions: Annotated[list[Direction], Meta(min_length=1, max_length=2)]
    loss_scale: float
    points: Count = 0
    evaluated_points: Count | None = None
    crossed_points: Count = 0
    evaluations: Count = 0
    center_loss: float
    tolerance: Maybe[Number] = UNSET
    resolved: Maybe[bool] = UNSET
    interpolation_error: Number = 0.0
    error_seen: Maybe[Number] = UNSET
    holdout_points: Count = 0
    reason: str = ""

    def __post_init__(self) -> None:
        if self.resolved is False and self.evaluated_points is None:
            raise ValueError("Expected `evaluated_points` of a plane that is not resolved, got none")

    @property
    def is_resolved(self) -> bool:
        """Whether every point of the grid has a loss."""
        return self.resolved is not False
