"""Settings of a probe: how much of everything it measures."""

from dataclasses import dataclass, field

from analysis.measures.depth import STEPS as DEPTH_STEPS
from analysis.measures.gradient_check import FEW
from landscape import EigenSettings, PowerSettings, TraceSettings
from landscape.errors import InputError

FEWEST_STEPS, FEWEST_POINTS = 4, 5  # of a density's run and along a side of a slice
FEWEST_PRODUCTS = 16  # of a density
TEN = 10  # eigenpairs from either end whose spread over Gaussians is told


@dataclass(frozen=True)
class ProbeSettings:
    """Amounts of everything; the defaults are for numbers to 1%.

    checked_vectors, checked_views: of the self-checks.
    traces: their accuracy where they are sampled: a CPU sums exact blocks, which takes less time than samples to 1%.
    trace_samples: exactly so many for each trace; None: exact blocks, or as many as `traces` asks for.
    power: iterates of power iteration, read from the density.  density_matvecs: products of the spectral density (a tenth of
        them see the ends again); 0: it is left out.
    slice_radius: half the slice's side, in curvature units sqrt(2 rise / |lambda|); slice_rise: the rise in these, as a share
        of the loss; slice_tolerance: error of the points that are not rendered, as a share of the slice's range;
        slice_plane: whether to render more than its two axes.
    depth: for the traces along and across the rays; None: these and the finite steps there, of `depth_steps` px, are left out.
    memory: GiB for the vectors of a basis.
    """

    checked_vectors: int = 4
    checked_views: int = FEW
    traces: TraceSettings = field(default_factory=lambda: TraceSettings(rtol=0.01, max_probes=2048))
    trace_samples: int | None = None
    eigen: EigenSettings = field(default_factory=lambda: EigenSettings(2, 1, max_matvecs=3000, further=TEN - 1))
    power: PowerSettings = field(default_factory=lambda: PowerSettings(max_matvecs=40))
    density_matvecs: int = 108
    slice_points: int = 41
    slice_radius: float = 3.0
    slice_rise: float = 0.001
    slice_tolerance: float = 0.01
    slice_plane: bool = True
    depth: TraceSettings | None = field(default_factory=lambda: TraceSettings(rtol=0.05, max_probes=1024))
    depth_steps: tuple[float, ...] = DEPTH_STEPS
    memory: float = 2.0

    def __post_init__(self) -> None:
        if self.slice_points < FEWEST_POINTS or self.slice_points % 2 == 0:
            raise InputError(
                f"expected an odd number of at least {FEWEST_POINTS} slice points, got {self.slice_points}"
            )
        if not self.memory > 0:
            raise InputError(f"expected memory > 0, got {self.memory}")
        if self.density_matvecs and self.density_matvecs < FEWEST_PRODUCTS:
            raise InputError(f"expected {FEWEST_PRODUCTS} products of the density or more, got {self.density_matvecs}")

    @classmethod
    def quick(cls) -> "ProbeSettings":
        """Numbers to 10%, in a quarter to half of the time."""
        return cls(
            checked_vectors=2,
            checked_views=1,
            traces=TraceSettings(rtol=0.1),
            trace_samples=5,
            eigen=EigenSettings(2, 1, rtol=0.1, max_matvecs=1000, further=TEN - 1),
            density_matvecs=0,
            slice_points=21,
            slice_plane=False,
            depth=None,
        )
