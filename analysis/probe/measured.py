"""Results of a probe's stages."""

from dataclasses import dataclass

from jaxtyping import Float64
from torch import Tensor

from analysis.measures.gradient_check import ProductCheck
from analysis.records.schema import Carries, Depth
from landscape import EigenEnds, OperatorCheck, Slice, SpectralDensity, TraceEstimate
from landscape.slices.finite_probe import FiniteProbe


@dataclass(frozen=True, eq=False)
class PlaneSlice:
    """A slice with its units: along each direction the step at which curvature alone raises the loss by loss_scale."""

    slice: Slice
    loss_scale: float
    units: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Search:
    """Both ends of the spectrum, and of the first TEN eigenpairs from either end, as far as they were found, the eigenvalue
    and over how many Gaussians the eigenvector is spread."""

    ends: EigenEnds
    spreads: tuple[list[tuple[float, float]], list[tuple[float, float]]]


@dataclass(frozen=True, eq=False)
class Rendered:
    """Losses at finite steps along the eigenvectors of both ends (None of an eigenvalue 0), and the Gaussians that carry these.

    steps: the optimiser's along each; kinks: see `analysis.measures.steepest`; rises: `analysis.measures.units.step_rises`.
    """

    ends: tuple[FiniteProbe | None, FiniteProbe | None]
    steps: tuple[float, float]
    kinks: tuple[float, float]
    carriers: list[Carries]
    rises: dict[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The density, None where memory is too small for it, and the power iteration that its runs hold."""

    density: SpectralDensity | None
    power: EigenEnds | None


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Numbers of each of the m views measured, for the standard error of measuring on fewer than the training has.

    population: the training's views.  curvatures: v . H_m v of the eigenvectors of the two largest eigenvalues and of
    the smallest.
    """

    population: int
    losses: Float64[Tensor, " m"]
    curvatures: Float64[Tensor, "m 3"]


@dataclass(frozen=True, eq=False)
class Measured:
    """Results of all stages; rendered, density, power, depth and plane are None where a note says why.

    matvecs: products H v of all stages; rank: number of
    directions that are not exactly flat; spreads: see `Search`; left_out: of training views, if any were.
    """

    value: float
    gradient_norm: float
    operator_check: OperatorCheck
    gradient_check: ProductCheck
    traces: dict[str, TraceEstimate]
    ends: EigenEnds
    spreads: tuple[list[tuple[float, float]], list[tuple[float, float]]]
    power: EigenEnds | None
    density: SpectralDensity | None
    depth: Depth | None
    plane: PlaneSlice | None
    rendered: Rendered | None
    matvecs: int
    rank: int
    notes: tuple[str, ...]
    left_out: LeftOut | None = None
