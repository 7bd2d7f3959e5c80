"""What `landscape probe` measures at one point of a scene's loss, stage by stage.

    linearise           every view's derivatives, each Gaussian's own block of H, a first render
    checks              symmetry, round-off, finiteness of H; H v against differences of the float64 gradient
    traces              of each attribute's block: exact, but for the coupling of pixels by SSIM, which is sampled
    eigenvalues         the two largest and the smallest; the search begins at `splat.curvature.block_eigenvectors`
    power iteration *   both ends as the paper takes them
    density *           stochastic Lanczos quadrature, for sums and quantiles of |lambda|
    finite probe *      the second difference of the loss along the first eigenvector, over a range of steps
    slice               the plane of the two largest eigenvalues' vectors: renders along both axes and where needed between them
    depth *             the positions' gradient and curvature along the rays and across them, and what finite steps there do

* not in a quick probe, which has too few products for them.  Every kernel has worked once when the checks are done: what
follows compiles nothing.  The estimators stop at their tolerance, at their budget of products, or when their share of the time
is spent; each result says which.  Time that a stage leaves goes to the later ones.  The numbers depend on the seed alone unless
time ran out.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from time import monotonic

import torch
from jaxtyping import Float64
from torch import Tensor

from analysis.console.budget import Budget, Share, Stage
from analysis.measures.depth import STEPS as DEPTH_STEPS
from analysis.measures.depth import measure_depth
from analysis.measures.gradient_check import check_against_gradient
from analysis.measures.memory import basis_within, vectors_within
from analysis.records.schema import Depth
from landscape import (
    CountingOperator,
    DerivativeCheck,
    EigenEnds,
    EigenSettings,
    OperatorCheck,
    PowerSettings,
    Slice,
    SpectralDensity,
    TraceEstimate,
    TraceSettings,
    check_operator,
    curvature_reach,
    evaluate_slice,
    extreme_eigenpairs,
    power_ends,
    spectral_density,
    symmetric_axis,
)
from landscape.errors import InputError
from landscape.probes import spawn
from landscape.results import Progress
from landscape.slices.finite_probe import NOISE_POINTS, STEPS, FiniteProbe, finite_probe
from landscape.slices.grid_evaluations import Loss
from landscape.slices.refinement import SliceSettings
from landscape.spectrum.density import ActiveSpace
from landscape.traces.trace import total_trace
from splat.backend.cpu.threads import single_threaded, thread_count
from splat.backend.device import by_triton
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces

OPTIONAL = ("power iteration", "density", "finite probe", "depth")  # stages
FEWEST_STEPS, FEWEST_POINTS = 4, 5  # of a density and along a side of a slice that are worth their time
FEWEST_STARTS = 3  # of a density of less than MANY_MATVECS; two have three times the interval
MANY_MATVECS = 48
MOST_AT_ONCE = 4  # start vectors
SHORTEST = 1e-9  # seconds


@dataclass(frozen=True)
class ProbeSettings:
    """How much of everything; the defaults are for numbers to 1%.

    checked_vectors, checked_views: of the self-checks; None: all views.
    trace_samples: exactly so many for each trace; None: as many as `traces` asks for.
    power: None: no power iteration.  density_matvecs: products of the spectral density; 0: it is left out.
    slice_radius: half the slice's side, in curvature units sqrt(2 rise / |lambda|); slice_rise: the rise in these, as a share
        of the loss; slice_tolerance: error of the points that are not rendered, as a share of the slice's range;
        slice_plane: whether to render more than its two axes.
    probe_steps: of the finite probe, in parameter units; (): it is left out.  noise_points: renders from which it tells the
        noise of a render.
    depth: for the traces along and across the rays; None: these and the finite steps there, of `depth_steps` px, are left out.
    seconds: for all estimators together.  memory: GiB for the vectors of a basis.
    """

    checked_vectors: int = 4
    checked_views: int | None = None
    traces: TraceSettings = field(default_factory=lambda: TraceSettings(rtol=0.01, max_probes=128))
    trace_samples: int | None = None
    eigen: EigenSettings = field(default_factory=lambda: EigenSettings(largest=2, smallest=1, max_matvecs=150))
    power: PowerSettings | None = field(default_factory=lambda: PowerSettings(max_matvecs=40))
    density_matvecs: int = 96
    slice_points: int = 41
    slice_radius: float = 3.0
    slice_rise: float = 0.001
    slice_tolerance: float = 0.01
    slice_plane: bool = True
    probe_steps: tuple[float, ...] = STEPS
    depth: TraceSettings | None = field(default_factory=lambda: TraceSettings(rtol=0.05, max_probes=64))
    depth_steps: tuple[float, ...] = DEPTH_STEPS
    noise_points: int = NOISE_POINTS
    seconds: float = 45.0
    memory: float = 2.0

    def __post_init__(self) -> None:
        if self.slice_points < FEWEST_POINTS or self.slice_points % 2 == 0:
            raise InputError(
                f"expected an odd number of at least {FEWEST_POINTS} slice points, got {self.slice_points}"
            )
        if not (self.slice_radius > 0 and self.slice_rise > 0):
            raise InputError(f"expected slice_radius and slice_rise > 0, got {self.slice_radius} and {self.slice_rise}")
        if not (self.seconds > 0 and self.memory > 0):
            raise InputError(f"expected seconds and memory > 0, got {self.seconds} and {self.memory}")

    @classmethod
    def quick(cls) -> "ProbeSettings":
        """Numbers to 10%, in a quarter of the time."""
        return cls(
            checked_vectors=2,
            checked_views=1,
            traces=TraceSettings(rtol=0.1),
            trace_samples=5,
            eigen=EigenSettings(largest=2, smallest=1, rtol=0.1, max_matvecs=60),
            power=None,
            density_matvecs=0,
            slice_points=21,
            slice_plane=False,
            probe_steps=(),
            depth=None,
            seconds=12.0,
        )


@dataclass(frozen=True, eq=False)
class PlaneSlice:
    """The slice, the rise of the loss that makes a curvature unit, and that unit along each direction."""

    slice: Slice
    loss_scale: float
    units: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured; density, finite, depth and plane are None where a note says why, power where it was not asked for.

    matvecs: products H v of all stages; spared: products of single views that moved nothing there and were left out; rank:
    of the directions that are not exactly flat.
    """

    value: float
    gradient_norm: float
    operator_check: OperatorCheck
    gradient_check: DerivativeCheck
    traces: dict[str, TraceEstimate]
    ends: EigenEnds
    power: EigenEnds | None
    density: SpectralDensity | None
    finite: FiniteProbe | None
    depth: Depth | None
    plane: PlaneSlice | None
    matvecs: int
    spared: int
    rank: int
    notes: tuple[str, ...]


def measure(objective: SceneObjective, settings: ProbeSettings, generator: torch.Generator, stage: Stage) -> Measured:
    """Run every stage.  stage(name): see `analysis.console.stages`."""
    with stage("linearise") as report:
        hessian = SceneHessian(objective)
        operator = CountingOperator(hessian)
        gradient, value, render = _linearised(objective, report)
        blocks = objective.approximate_blocks
    with stage("checks") as report:
        operator_check = check_operator(operator, spawn(generator), settings.checked_vectors)
        gradient_check = check_against_gradient(hessian, spawn(generator), report, settings.checked_views)
    wanted = settings.power, settings.density_matvecs, settings.probe_steps, settings.depth
    unasked = [name for name, each in zip(OPTIONAL, wanted, strict=True) if not each]
    budget = Budget(settings.seconds, unasked, generator, stage)
    with budget.stage("traces") as share:
        allowed = replace(settings.traces, max_seconds=share.seconds)
        traces = exact_traces(objective, share.generator, allowed, share.report, samples=settings.trace_samples)
    with budget.stage("eigenvalues") as share:
        eigen, start = _search(operator, settings, share), BlockEigenvectors(objective, *blocks).warm_start()
        timed = CountingOperator(operator)
        ends = extreme_eigenpairs(timed, share.generator, eigen, start, share.report)
    power = density = finite = depth = None
    if settings.power is not None:
        with budget.stage("power iteration") as share:
            each = replace(settings.power, max_seconds=share.seconds / 2)
            power = power_ends(operator, share.generator, each, share.report)
    if settings.density_matvecs:
        with budget.stage("density") as share:
            active, room = ActiveSpace(hessian.project, hessian.rank), vectors_within(operator, settings.memory)
            run = partial(spectral_density, operator, active=active, ends=ends, trace=total_trace(traces))
            density = _density(run, room, settings, timed.seconds / timed.matvecs, share)
    if settings.probe_steps:
        with budget.stage("finite probe") as share:
            finite = _finite(objective, operator, ends, settings, render, share)
    with budget.stage("slice") as share:
        plane = _plane(objective, gradient, value, ends, settings, share)
    if settings.depth is not None:
        with budget.stage("depth") as share:
            depth = measure_depth(objective, settings.depth, settings.depth_steps, render, share)
    return Measured(
        value=value,
        gradient_norm=float(gradient.double().norm()),
        operator_check=operator_check,
        gradient_check=gradient_check,
        traces=traces,
        ends=ends,
        power=power,
        density=density,
        finite=finite,
        depth=depth,
        plane=plane,
        matvecs=operator.matvecs,
        spared=hessian.views.spared,
        rank=hessian.rank,
        notes=tuple(budget.notes),
    )


def _linearised(objective: SceneObjective, report: Progress) -> tuple[Tensor, float, float]:
    """The gradient, the loss, and the seconds that rendering it takes; for the first render the kernels may compile."""
    report(0, 1, f"{len(objective.views)} views")
    gradient, center = objective.gradient, objective.active.flat
    report(1, 1, f"{len(objective.views)} views")
    objective.loss(center)
    start = monotonic()
    return gradient, objective.loss(center), monotonic() - start


def _search(operator: CountingOperator, settings: ProbeSettings, share: Share) -> EigenSettings:
    """For the ends: in the time of the stage, with a basis that memory has room for."""
    eigen = settings.eigen
    basis = basis_within(eigen, vectors_within(operator, settings.memory))
    if basis < eigen.basis:
        share.notes.append(
            f"the search for the ends kept {basis} vectors instead of {eigen.basis}, to stay within {settings.memory:g} GiB"
        )
    return replace(eigen, max_seconds=share.seconds, basis=basis)


def _density(
    run: Callable[..., SpectralDensity], room: int, settings: ProbeSettings, each: float, share: Share
) -> SpectralDensity | None:
    """As many products as time allows at so many seconds each, in runs that memory has room for (of that many vectors); None
    where they are too few."""
    matvecs = int(min(settings.density_matvecs, share.seconds / each))
    starts = FEWEST_STARTS if matvecs < MANY_MATVECS else None
    batch = MOST_AT_ONCE if room > FEWEST_STEPS * MOST_AT_ONCE else 1
    longest = room // (batch + 1)
    if min(matvecs // FEWEST_STARTS, longest) < FEWEST_STEPS:
        share.notes.append(
            f"the spectral density was left out: time and memory allowed {matvecs} products in runs of {longest}"
        )
        return None
    if matvecs < settings.density_matvecs:
        share.notes.append(f"the spectral density took {matvecs} products instead of {settings.density_matvecs}")
    return run(share.generator, progress=share.report, matvecs=matvecs, starts=starts, longest=longest, batch=batch)


def _finite(
    objective: SceneObjective,
    operator: CountingOperator,
    ends: EigenEnds,
    settings: ProbeSettings,
    render: float,
    share: Share,
) -> FiniteProbe | None:
    """Along the first eigenvector; None where its renders, of so many seconds each, would take longer than they may."""
    if (2 * len(settings.probe_steps) + settings.noise_points + 1) * render > max(share.seconds, SHORTEST):
        share.notes.append(
            "the finite probe was left out: its renders would have taken more than its share of the time"
        )
        return None
    center, vector = objective.active.flat, ends.largest.vectors[:, 0]
    return finite_probe(
        objective.evaluate, center, vector, operator, settings.probe_steps, share.report, settings.noise_points
    )


def _plane(
    objective: SceneObjective, gradient: Tensor, value: float, ends: EigenEnds, settings: ProbeSettings, share: Share
) -> PlaneSlice | None:
    center, loss_scale = objective.active.flat, settings.slice_rise * value
    curvatures: Float64[Tensor, 2] = ends.largest.values[:2]
    if loss_scale <= 0 or not curvatures.all():
        share.notes.append("the slice was left out: the loss or one of the two largest curvatures is exactly 0")
        return None
    first, second = (curvature_reach(float(curvature), loss_scale) for curvature in curvatures)
    axes = [symmetric_axis(settings.slice_radius * unit, settings.slice_points) for unit in (first, second)]
    vectors = ends.largest.vectors[:, :2]
    workers = 1 if objective.ranks.size > 1 or by_triton(center) else thread_count()
    # without a budget for it, the two axes alone
    most, limit = (inf if settings.slice_plane else 1), max(share.seconds, SHORTEST)
    allowed = SliceSettings(settings.slice_tolerance, workers=workers, max_evaluations=most, max_seconds=limit)
    evaluate = evaluation(objective, allowed.workers)
    # Ritz vectors: H between any two of them is their values' diagonal matrix
    known = curvatures.diag()
    plane = evaluate_slice(
        evaluate, center, vectors, axes, gradient, known, allowed, share.generator, progress=share.report
    )
    return PlaneSlice(plane, loss_scale, (first, second))


def evaluation(objective: SceneObjective, workers: int) -> Loss:
    """The objective for so many threads at once: each alone, or one with all processors to itself."""
    if workers == 1:
        return objective.evaluate

    def alone(theta: Tensor) -> tuple[float, Hashable]:
        with single_threaded():
            return objective.evaluate(theta)

    return alone
