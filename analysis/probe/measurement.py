"""What `landscape probe` measures at one point of a scene's loss, stage by stage.

    linearise           every view's derivatives, each Gaussian's own block of H, a first render
    checks              symmetry, round-off, finiteness of H; H v against differences of the float64 gradient
    traces              of each attribute's block: exact, but for the coupling of pixels by SSIM, which is sampled where that
                        is cheaper
    eigenvalues         the two largest and the smallest; the search begins at `splat.curvature.block_eigenvectors`
    slice               the plane of the two largest eigenvalues' vectors: true renders where needed, interpolated elsewhere
    density *           stochastic Lanczos quadrature, for sums and quantiles of |lambda|; its first runs hold the iterates of
                        the paper's power iteration
    power iteration     for itself, where that is asked for
    finite probe *      the second difference of the loss along the first eigenvector, over a range of steps
    depth *             the positions' gradient and curvature along the rays and across them, and what finite steps there do
    block shares        which share of H lies within the Gaussians' own blocks

* not in a quick probe.  Every kernel has worked once when the checks are done: what follows compiles nothing.  The estimators
stop at their accuracy or after so many products as settings allow at most; each result says which.  No clock decides but for a
deadline, which ends what is under way.  The numbers depend on the seed alone, also where stages were kept from a run before.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from statistics import median
from time import monotonic
from types import MappingProxyType

import torch
from jaxtyping import Float64
from torch import Tensor

from analysis.console.kept import Kept
from analysis.console.stages import Stages, Work
from analysis.measures.depth import measure_depth
from analysis.measures.gradient_check import ProductCheck, check_against_gradient
from analysis.measures.memory import basis_within, vectors_within
from analysis.probe.settings import FEWEST_STEPS, ProbeSettings
from analysis.records.schema import Depth
from landscape import (
    CountingOperator,
    EigenEnds,
    OperatorCheck,
    Slice,
    SpectralDensity,
    TraceEstimate,
    check_operator,
    curvature_reach,
    evaluate_slice,
    extreme_eigenpairs,
    power_ends,
    spectral_density,
    symmetric_axis,
)
from landscape.eigen.lanczos import LanczosFactorization
from landscape.eigen.power import power_of_runs
from landscape.operators.operator import finished
from landscape.probes import spawn
from landscape.results import Progress
from landscape.slices.finite_probe import FiniteProbe, finite_probe
from landscape.slices.grid_evaluations import Loss
from landscape.slices.refinement import SliceSettings
from landscape.spectrum.density import ActiveSpace
from landscape.traces.trace import total_trace
from splat.backend.cpu.threads import single_threaded, thread_count
from splat.backend.device import by_triton
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.scores.shares import BlockShare, block_shares
from splat.curvature.traces import block_traces, exact_traces

STAGES = ("traces", "eigenvalues", "slice", "density", "power iteration", "finite probe", "depth", "block shares")
# what is said of a stage that was not asked for
LEFT_OUT = {
    "density": "the spectral density was left out, and the indices that need it",
    "finite probe": "the finite probe was left out",
    "depth": "positions along and across the rays were left out",
}
MOST_AT_ONCE = 4  # start vectors
PRODUCT, BEFORE = 4.5, 50  # renders that a product with them takes, and what comes before the first stage
TIMED = 3  # calls, of which the middle one tells how long one takes
MOST_SAMPLES = 64  # of a trace, beyond which its exact value takes less
Expected = Mapping[str, tuple[int, float, float]]
"""What a stage takes: units, as its progress counts them (0: of different kinds), products of MOST_AT_ONCE vectors, and renders
of all views."""
NOTHING: Expected = MappingProxyType({})
# on real scenes of different kinds
TYPICAL: Expected = {
    "traces": (25, 11, 0),
    "eigenvalues": (60, 28, 0),
    "slice": (320, 0, 240),
    "depth": (0, 3, 60),
    "block shares": (0, 4, 0),
}
PICTURES, QUICK_PICTURES = 3.0, 0.5  # seconds that pictures take, which hardly depend on the scene


@dataclass(frozen=True, eq=False)
class PlaneSlice:
    """The slice, the rise of the loss that makes a curvature unit, and that unit along each direction."""

    slice: Slice
    loss_scale: float
    units: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The density, None where there is no memory for it, and the power iteration that its runs hold."""

    density: SpectralDensity | None
    power: EigenEnds | None


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured; density, power, finite, depth, plane and shares are None where a note says why.

    matvecs: products H v of all stages; spared: products of single views that moved nothing there and were left out; rank:
    of the directions that are not exactly flat; unreached: stages that time did not reach.  left_out: where views were.
    """

    value: float
    gradient_norm: float
    operator_check: OperatorCheck
    gradient_check: ProductCheck
    traces: dict[str, TraceEstimate]
    ends: EigenEnds
    power: EigenEnds | None
    density: SpectralDensity | None
    finite: FiniteProbe | None
    depth: Depth | None
    plane: PlaneSlice | None
    shares: list[BlockShare] | None
    matvecs: int
    spared: int
    rank: int
    notes: tuple[str, ...]
    unreached: tuple[str, ...] = ()
    left_out: "LeftOut | None" = None


@dataclass(frozen=True, eq=False)
class LeftOut:
    """What tells the error of measuring on fewer views than the training has.

    population: those that it has.  losses: of the views measured; curvatures: v . H_m v in each of these views, of the
    eigenvectors of the two largest eigenvalues and of the smallest.
    """

    population: int
    losses: Float64[Tensor, " m"]
    curvatures: Float64[Tensor, "m 3"]


def measure(
    objective: SceneObjective,
    settings: ProbeSettings,
    generator: torch.Generator,
    stages: Stages,
    folder: Path | None = None,
    told: str = "",
    deadline: float = inf,
    population: int | None = None,
    after: Expected = NOTHING,
) -> Measured:
    """Run every stage.  folder, told, deadline: see `Kept`; population: training views, where the objective has fewer; after:
    what the caller does then."""
    with stages.stage("linearise") as report:
        hessian = SceneHessian(objective)
        operator = CountingOperator(hessian)
        gradient, value = _linearised(objective, report)
        objective.approximate_blocks  # noqa: B018 (made here, where kernels compile)
        if settings.block_coupling or not settings.trace_samples:
            _compile_blocks(objective)
    with stages.stage("checks") as report:
        operator_check = check_operator(operator, spawn(generator), settings.checked_vectors)
        gradient_check = check_against_gradient(hessian, spawn(generator), report, settings.checked_views)
    checks = operator.matvecs, hessian.views.spared
    product, render = _seconds_of_product(hessian), seconds_of_render(objective)
    words = f"{MOST_AT_ONCE} products at once take {product:.2g} s, a render of all views {render:.2g} s"
    kept = Kept(stages, generator, STAGES, lambda: [operator.matvecs, hessian.views.spared], folder, told, deadline)
    plan = _plan(settings, product, render, after)
    stages.expect({name: work for name, work in plan.items() if not kept.has(name)}, words)
    point = _Point(objective, hessian, operator, settings, gradient, value)
    return _all_stages(point, kept, operator_check, gradient_check, checks, population)


@dataclass(frozen=True, eq=False)
class _Point:
    """What the stages work with."""

    objective: SceneObjective
    hessian: SceneHessian
    operator: CountingOperator
    settings: ProbeSettings
    gradient: Tensor
    value: float


def _all_stages(
    at: _Point,
    kept: Kept,
    operator_check: OperatorCheck,
    gradient_check: ProductCheck,
    checks: tuple[int, int],
    population: int | None,
) -> Measured:
    objective, settings = at.objective, at.settings
    traces = kept.run("traces", dict[str, TraceEstimate], lambda g, report, _: _traces(at, kept.left, g, report), True)
    ends = kept.run("eigenvalues", EigenEnds, lambda *told: _ends(at, kept.left, *told), True)
    assert traces is not None and ends is not None  # what time allows of them
    plane = kept.run("slice", PlaneSlice | None, lambda *told: _plane(at, ends, *told))  # pyright: ignore[reportArgumentType]
    spectrum = power = finite = depth = None
    if settings.density_matvecs:
        spectrum = kept.run("density", Spectrum, lambda *told: _spectrum(at, ends, traces, *told))
    if settings.power_apart:
        power = kept.run(
            "power iteration", EigenEnds, lambda g, report, _: power_ends(at.operator, g, settings.power, report)
        )
    if settings.probe_steps:
        finite = kept.run("finite probe", FiniteProbe, lambda g, report, _: _finite(at, ends, report))
    if settings.depth is not None:
        accuracy, steps = settings.depth, settings.depth_steps
        depth = kept.run("depth", Depth, lambda g, report, _: measure_depth(objective, accuracy, steps, g, report))
    shares = kept.run("block shares", list[BlockShare], lambda g, report, _: _shares(at, g, report))
    matvecs, spared = (first + more for first, more in zip(checks, kept.counts, strict=True))
    wanted = {"density": settings.density_matvecs, "finite probe": settings.probe_steps, "depth": settings.depth}
    return Measured(
        value=at.value,
        gradient_norm=float(at.gradient.double().norm()),
        operator_check=operator_check,
        gradient_check=gradient_check,
        traces=traces,
        ends=ends,
        power=power or (spectrum and spectrum.power),
        density=spectrum and spectrum.density,
        finite=finite,
        depth=depth,
        plane=plane,
        shares=shares,
        matvecs=matvecs,
        spared=spared,
        rank=at.hessian.rank,
        notes=(*(LEFT_OUT[name] for name, each in wanted.items() if not each), *kept.notes),
        unreached=tuple(kept.unreached),
        left_out=None if population is None else _left_out(at, ends, population),
    )


def _left_out(at: _Point, ends: EigenEnds, population: int) -> LeftOut:
    vectors = torch.cat([ends.largest.vectors[:, :2], ends.smallest.vectors[:, :1]], dim=1)
    return LeftOut(population, at.objective.losses, at.hessian.by_view(vectors))


def _linearised(objective: SceneObjective, report: Progress) -> tuple[Tensor, float]:
    """The gradient and the loss."""
    report(0, 1, f"{len(objective.views)} views")
    gradient = objective.gradient
    report(1, 1, f"{len(objective.views)} views")
    return gradient, objective.loss(objective.active.flat)


def _compile_blocks(objective: SceneObjective) -> None:
    """The kernel of exact blocks, by those of one Gaussian: only late stages need it, whose time is told before."""
    if objective.couples_pixels and not by_triton(objective.active.flat):
        one = objective.active.select(torch.zeros(1, dtype=torch.int64))
        objective.linearizer(one)(0).block_diagonals(approximate=False, parts=(False, True))


def _seconds_of_product(hessian: SceneHessian) -> float:
    """With MOST_AT_ONCE vectors."""
    V = torch.ones_like(hessian.objective.active.flat)[:, None].expand(-1, MOST_AT_ONCE).contiguous()
    return _seconds_of(lambda: finished(hessian.apply(V)))


def seconds_of_render(objective: SceneObjective) -> float:
    """Of all views, with all threads; compiles nothing only where one has been made before."""
    return _seconds_of(lambda: objective.loss(objective.active.flat))


def _seconds_of(call: Callable[[], object]) -> float:
    taken = []
    for _ in range(TIMED):
        start = monotonic()
        call()
        taken.append(monotonic() - start)
    return median(taken)


def _plan(settings: ProbeSettings, product: float, render: float, after: Expected = NOTHING) -> Mapping[str, Work]:
    """What every stage is expected to take, from the seconds of a product and of a render."""
    work = dict(TYPICAL)
    if settings.trace_samples:
        work["traces"] = (settings.trace_samples, 0.45 * settings.trace_samples, 0)
    units, _, renders = work["slice"]
    points = min(units, settings.slice_points**2) if settings.slice_plane else 2 * settings.slice_points
    work["slice"] = (points, 0, renders * points / units)
    if count := settings.density_matvecs:
        work["density"] = (count, 0.3 * count, 0)
    if settings.power_apart:
        work["power iteration"] = (0, settings.power.max_matvecs, 0)
    if settings.probe_steps:
        count = 2 * len(settings.probe_steps) + settings.noise_points + 1
        work["finite probe"] = (count, 0, count)
    if settings.depth is None:
        del work["depth"]
    if settings.block_coupling:
        work["block shares"] = (0, 24, 0)  # exact blocks take longest
    found = {
        name: Work(products * product + renders * render, units)
        for name, (units, products, renders) in (work | dict(after)).items()
    }
    return found | {"pictures": Work(PICTURES if settings.slice_plane else QUICK_PICTURES)}


def expected_seconds(settings: ProbeSettings, render: float, after: Expected = NOTHING) -> float:
    """About how long all stages take, from the seconds of a render of all views alone."""
    stages = _plan(settings, PRODUCT * render, render, after).values()
    return sum(work.seconds for work in stages) + BEFORE * render


def _traces(at: _Point, seconds: float, generator: torch.Generator, report: Progress) -> dict[str, TraceEstimate]:
    """To their accuracy; on a CPU those that MOST_SAMPLES do not bring there are summed over the exact blocks instead."""
    allowed, samples = replace(at.settings.traces, max_seconds=seconds), at.settings.trace_samples
    if samples or by_triton(at.objective.active.flat):
        return exact_traces(at.objective, generator, allowed, report, samples=samples)
    few = replace(allowed, max_probes=min(allowed.max_probes, MOST_SAMPLES))
    found = exact_traces(at.objective, generator, few, report)
    if not (still := [name for name, trace in found.items() if trace.reason == "matvec budget"]):
        return found
    exact = block_traces(at.objective)
    return {name: exact[name] if name in still else trace for name, trace in found.items()}


def _ends(at: _Point, seconds: float, generator: torch.Generator, report: Progress, notes: list[str]) -> EigenEnds:
    """In the time that there is, with a basis that memory has room for."""
    eigen, memory = at.settings.eigen, at.settings.memory
    basis = basis_within(eigen, vectors_within(at.objective, memory))
    if basis < eigen.basis:
        notes.append(
            f"the search for the ends kept {basis} vectors instead of {eigen.basis}, to stay within {memory:g} GiB and half of "
            "what was free"
        )
    start = BlockEigenvectors(at.objective, *at.objective.approximate_blocks).warm_start()
    eigen = replace(eigen, max_seconds=seconds, basis=basis)
    return extreme_eigenpairs(at.operator, generator, eigen, start, report)


def _spectrum(
    at: _Point,
    ends: EigenEnds,
    traces: dict[str, TraceEstimate],
    generator: torch.Generator,
    report: Progress,
    notes: list[str],
) -> Spectrum:
    """In runs that memory has room for."""
    settings, iterates = at.settings, []
    room = vectors_within(at.objective, settings.memory)
    batch = MOST_AT_ONCE if room > FEWEST_STEPS * MOST_AT_ONCE else 1
    longest = room // (batch + 1)
    if longest < FEWEST_STEPS:
        notes.append(f"the spectral density was left out: memory allowed runs of {longest} products")
        return Spectrum(None, None)

    def watch(runs: Sequence[LanczosFactorization]) -> None:
        iterates.append(power_of_runs(runs, settings.power))

    active = ActiveSpace(at.hessian.project, at.hessian.rank)
    density = spectral_density(
        at.operator, generator, settings.density_matvecs, longest=longest, batch=batch, progress=report,
        active=active, ends=ends, trace=total_trace(traces), watch=watch,
    )  # fmt: skip
    return Spectrum(density, iterates[0] if iterates else None)


def _shares(at: _Point, generator: torch.Generator, report: Progress) -> list[BlockShare]:
    settings = at.settings
    return block_shares(at.objective, generator, settings.block_samples, report, coupled=settings.block_coupling)


def _finite(at: _Point, ends: EigenEnds, report: Progress) -> FiniteProbe:
    """Along the first eigenvector."""
    center, vector = at.objective.active.flat, ends.largest.vectors[:, 0]
    steps, points = at.settings.probe_steps, at.settings.noise_points
    return finite_probe(at.objective.evaluate, center, vector, at.operator, steps, report, points)


def _plane(
    at: _Point, ends: EigenEnds, generator: torch.Generator, report: Progress, notes: list[str]
) -> PlaneSlice | None:
    settings, center, loss_scale = at.settings, at.objective.active.flat, at.settings.slice_rise * at.value
    curvatures: Float64[Tensor, 2] = ends.largest.values[:2]
    if loss_scale <= 0 or not curvatures.all():
        notes.append("the slice was left out: the loss or one of the two largest curvatures is exactly 0")
        return None
    first, second = (curvature_reach(float(curvature), loss_scale) for curvature in curvatures)
    axes = [symmetric_axis(settings.slice_radius * unit, settings.slice_points) for unit in (first, second)]
    vectors = ends.largest.vectors[:, :2]
    workers = 1 if at.objective.ranks.size > 1 or by_triton(center) else thread_count()
    # without a budget for it, the two axes alone
    most = inf if settings.slice_plane else 1
    accuracy = SliceSettings(settings.slice_tolerance, workers=workers, max_evaluations=most)
    # Ritz vectors: H between any two of them is their values' diagonal matrix
    known, evaluate = curvatures.diag(), evaluation(at.objective, workers)
    plane = evaluate_slice(evaluate, center, vectors, axes, at.gradient, known, accuracy, generator, progress=report)
    return PlaneSlice(plane, loss_scale, (first, second))


def evaluation(objective: SceneObjective, workers: int) -> Loss:
    """The objective for so many threads at once: each alone, or one with all processors to itself."""
    return objective.evaluate if workers == 1 else single_threaded()(objective.evaluate)
