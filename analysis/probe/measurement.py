"""Stages of `landscape probe` at one point of a scene's loss with Hessian H.

    linearise           derivatives of every view, the gradient, a first render
    checks              symmetry, round-off, finiteness of H; H v against differences of the float64 gradient
    traces              of each attribute's block: exact, but for SSIM's window, which is sampled where that
                        is cheaper, and always in a quick probe or on a GPU
    eigenvalues         the two largest and the smallest, from the start vectors of `splat.curvature.block_eigenvectors`
    renders             the second difference of the loss along the eigenvectors of both ends, at steps that double, from a part
                        of the optimiser's to about one at which the curvature alone changes the loss by 1%; the Gaussian that
                        carries each end; the loss after random steps of the optimiser in each attribute
    slice               the loss over the plane of the first two eigenvectors: rendered where needed, interpolated elsewhere
                        (both on a CPU in boxes around the few Gaussians that move, where few whole renders tell the rest)
    density *           stochastic Lanczos quadrature, for sums of |lambda|; the Krylov spaces of its first runs
                        contain the iterates of the paper's power iteration
    depth *             the positions' gradient and curvature along the rays and across them, and finite steps both ways

* not in a quick probe.  Estimators stop at their accuracy or at a limit on products; their results say which.  Numbers depend
on the seed, and on free memory where it limits a basis or the density's runs; of a stage kept by an earlier run, on that run's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, inf, log2
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from analysis.console.kept import Kept
from analysis.console.stages import Stages
from analysis.measures.depth import measure_depth
from analysis.measures.gradient_check import ProductCheck, check_against_gradient
from analysis.measures.localization import masses, participation
from analysis.measures.memory import basis_within, vectors_within
from analysis.measures.steepest import heaviest, kink_curvature, loss_nearby
from analysis.measures.units import step_rises
from analysis.probe.measured import LeftOut, Measured, PlaneSlice, Rendered, Search, Spectrum
from analysis.probe.plan import MOST_AT_ONCE
from analysis.probe.settings import FEWEST_STEPS, TEN, ProbeSettings
from analysis.records.schema import Depth
from landscape import (
    CountingOperator,
    EigenEnds,
    Eigenpairs,
    OperatorCheck,
    TraceEstimate,
    check_operator,
    curvature_reach,
    evaluate_slice,
    extreme_eigenpairs,
    spectral_density,
    symmetric_axis,
)
from landscape.eigen.lanczos import LanczosFactorization
from landscape.eigen.power import power_of_runs
from landscape.operators.distributed import ALONE, DistributedOperator, Ranks
from landscape.operators.operator import LiftedOperator
from landscape.probes import spawn
from landscape.results import Progress
from landscape.slices.finite_probe import finite_probe
from landscape.slices.grid_evaluations import Loss
from landscape.slices.refinement import SliceSettings
from landscape.spectrum.density import ActiveSpace
from landscape.traces.trace import TraceSettings, total_trace
from splat.backend.cpu.threads import single_threaded, thread_count
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import block_traces, exact_traces
from splat.model.gaussians import Gaussians
from splat.render.backend import CPU, backend_of

# each stage has random numbers of its own; "": those of stages that are gone, so that the others keep theirs
STREAMS = ("traces", "eigenvalues", "slice", "density", "", "", "depth", "", "renders")
LEFT_OUT = {  # notes on stages that the settings exclude
    "density": "the spectral density was left out, and the indices that need it",
    "depth": "positions along and across the rays were left out",
}
# renders along the ends: from the optimiser's step HALVINGS halvings down (so that the shortest run of three ends near a tenth
# of it), and up to the first doubling at which the curvature changes the loss by RISE, but 1 to MOST_DOUBLINGS doublings
RISE, HALVINGS, MOST_DOUBLINGS = 0.01, 5, 5
MIXED = 0.1  # largest error of an eigenvector whose participation is recorded: 1% of its mass lies elsewhere
FEW_POINTS = 8  # renders for the estimate of a render's noise


def measure(
    objective: SceneObjective,
    settings: ProbeSettings,
    steps: Float[Tensor, " p"],
    generator: torch.Generator,
    stages: Stages,
    folder: Path | None = None,
    identity: str = "",
    population: int | None = None,
    ranks: Ranks = ALONE,
) -> Measured:
    """Run every stage.

    steps: length of the optimiser's first step in each parameter.  folder, identity: see `Kept`.  population:
    number of training views, where the objective has fewer.  ranks: processes that all measure the same, and share the views of
    the operator's products.
    """
    with stages.stage("linearise") as report:
        at = _linearised(objective, settings, ranks, report)
    with stages.stage("checks") as report:
        operator_check = check_operator(at.operator, spawn(generator), settings.checked_vectors)
        gradient_check = check_against_gradient(at.hessian, spawn(generator), report, settings.checked_views)
    of_checks = at.operator.matvecs
    kept = Kept(stages, generator, STREAMS, lambda: at.operator.matvecs, folder, identity)
    return _all_stages(at, steps, kept, operator_check, gradient_check, of_checks, population)


@dataclass(frozen=True, eq=False)
class _Point:
    """A point of the loss, and the quantities that all stages use.

    hessian: this process's part.  operator: the whole, summed over ranks.
    """

    objective: SceneObjective
    hessian: SceneHessian
    operator: CountingOperator
    settings: ProbeSettings
    gradient: Tensor
    value: float

    @property
    def exact_blocks(self) -> bool:
        """Whether exact blocks of the Gaussians are made: on a CPU, they take less time than traces sampled to 1%."""
        return not self.settings.trace_samples and backend_of(self.objective.active.flat).exact_blocks


def _linearised(objective: SceneObjective, settings: ProbeSettings, ranks: Ranks, report: Progress) -> _Point:
    hessian = SceneHessian(objective, indices=ranks.share(range(len(objective.views)), "training view"))
    operator = hessian if ranks.size == 1 else DistributedOperator(hessian, ranks)
    views = f"{len(objective.views)} views"
    report(0, 1, views)
    gradient = objective.gradient
    report(1, 1, views)
    value = objective.loss(objective.active.flat)
    return _Point(objective, hessian, CountingOperator(operator), settings, gradient, value)


def _all_stages(
    at: _Point,
    steps: Float[Tensor, " p"],
    kept: Kept,
    operator_check: OperatorCheck,
    gradient_check: ProductCheck,
    of_checks: int,
    population: int | None,
) -> Measured:
    """The stages after the checks.  of_checks: products H v that these took."""
    settings = at.settings
    traces = kept.run("traces", dict[str, TraceEstimate], partial(_traces, at))
    search = kept.run("eigenvalues", Search, partial(_ends, at))
    ends = search.ends
    rendered = kept.run("renders", Rendered, partial(_rendered, at, ends, steps))
    plane = kept.run("slice", PlaneSlice | None, partial(_plane, at, ends))  # pyright: ignore[reportArgumentType]
    spectrum = depth = None
    if settings.density_matvecs:
        spectrum = kept.run("density", Spectrum, partial(_spectrum, at, ends, traces))
    if settings.depth is not None:
        depth = kept.run("depth", Depth, partial(_depth, at, settings.depth))
    wanted = {"density": settings.density_matvecs, "depth": settings.depth}
    return Measured(
        value=at.value,
        gradient_norm=float(at.gradient.double().norm()),
        operator_check=operator_check,
        gradient_check=gradient_check,
        traces=traces,
        ends=ends,
        spreads=search.spreads,
        power=spectrum and spectrum.power,
        density=spectrum and spectrum.density,
        depth=depth,
        plane=plane,
        rendered=rendered,
        matvecs=of_checks + kept.count,
        rank=at.hessian.rank,
        notes=(*(LEFT_OUT[name] for name, each in wanted.items() if not each), *kept.notes),
        left_out=None if population is None else _left_out(at, ends, population),
    )


def _left_out(at: _Point, ends: EigenEnds, population: int) -> LeftOut:
    vectors = torch.cat([ends.largest.vectors[:, :2], ends.smallest.vectors[:, :1]], dim=1)
    return LeftOut(population, at.objective.losses, SceneHessian(at.objective).by_view(vectors))


def _traces(at: _Point, generator: torch.Generator, report: Progress, _: list[str]) -> dict[str, TraceEstimate]:
    """Traces summed over exact blocks, where these are made; else sampled to their accuracy."""
    if at.exact_blocks:
        return block_traces(at.objective, report)
    return exact_traces(at.objective, generator, at.settings.traces, report, samples=at.settings.trace_samples)


def _ends(at: _Point, generator: torch.Generator, report: Progress, notes: list[str]) -> Search:
    """Both ends of the spectrum, with as much of the basis asked for as fits into memory.

    The null space that is known is lifted off 0, where it would be the end of a semi-definite spectrum.
    """
    eigen, memory = at.settings.eigen, at.settings.memory
    basis = basis_within(eigen, vectors_within(at.objective, memory))
    if basis < eigen.basis:
        notes.append(
            f"the search for extreme eigenvalues kept {basis} vectors instead of {eigen.basis}, to stay within {memory:g} GiB "
            "and half of what was free"
        )
    start = BlockEigenvectors(at.objective, *at.objective.known_blocks(exact=at.exact_blocks)).warm_start()
    eigen = replace(eigen, basis=basis)
    lifted = LiftedOperator(at.operator, at.hessian.project, spawn(generator))
    found = extreme_eigenpairs(lifted, generator, eigen, start, report)
    assert found.further is not None
    ends, active = zip((found.largest, found.smallest), found.further, strict=True), at.objective.active
    spreads = [_spreads(pairs, active) for pairs in ends]
    return Search(replace(found, further=None), (spreads[0], spreads[1]))


def _spreads(pairs: Sequence[Eigenpairs], gaussians: Gaussians) -> list[tuple[float, float]]:
    """Eigenvalue, and participation over Gaussians, of the first TEN pairs, to the first whose vector error is above MIXED."""
    rows = []
    for some in pairs:
        for i in range(len(some)):
            if len(rows) == TEN or not some.vector_errors[i] <= MIXED:
                return rows
            rows.append((float(some.values[i]), participation(masses(some.vectors[:, i], gaussians))))
    return rows


def _spectrum(
    at: _Point,
    ends: EigenEnds,
    traces: dict[str, TraceEstimate],
    generator: torch.Generator,
    report: Progress,
    notes: list[str],
) -> Spectrum:
    """The density, from Lanczos runs of at most the length that fits into memory."""
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


def _rendered(
    at: _Point, ends: EigenEnds, steps: Float[Tensor, " p"], generator: torch.Generator, report: Progress, _: list[str]
) -> Rendered:
    """Renders along both ends, and who carries these."""
    probes, lengths, objective = [], [], at.objective
    pairs = (ends.largest, ends.smallest)
    for pair in pairs:
        value = float(pair.values[0])
        # root mean square of d . v over random signs of d: the root of the sum of v_i^2 d_i^2
        step = float(torch.linalg.vector_norm((pair.vectors[:, 0] * steps).double()))
        reach = curvature_reach(value, RISE * at.value) if value and at.value > 0 else step
        doublings = min(max(ceil(log2(reach / step)), 1), MOST_DOUBLINGS) if step else 0
        along = [step * 2.0**k for k in range(-HALVINGS, doublings + 1)]
        flat, vector = objective.active.flat, pair.vectors[:, 0]
        probe = partial(finite_probe, objective.evaluate, flat, vector, at.operator, along, report, FEW_POINTS)
        nearby = loss_nearby(objective, vector[:, None], [flat + end * vector for end in (-along[-1], along[-1])])
        probes.append(probe(nearby) if value and step else None)
        lengths.append(step)
    vectors = [pair.vectors[:, 0] for pair in pairs]
    kinks = [kink_curvature(objective, vector) for vector in vectors]
    carriers = heaviest(objective, vectors, generator)
    rises = step_rises(objective, steps, generator)
    return Rendered((probes[0], probes[1]), (lengths[0], lengths[1]), (kinks[0], kinks[1]), carriers, rises)


def _depth(at: _Point, accuracy: TraceSettings, generator: torch.Generator, report: Progress, _: list[str]) -> Depth:
    return measure_depth(at.objective, accuracy, at.settings.depth_steps, generator, report, at.exact_blocks)


def _plane(
    at: _Point, ends: EigenEnds, generator: torch.Generator, report: Progress, notes: list[str]
) -> PlaneSlice | None:
    center = at.objective.active.flat
    workers = thread_count() if backend_of(center) is CPU else 1
    loss = evaluation(at.objective.evaluate, workers)
    return plane_of(
        loss, center, at.value, at.gradient, ends, at.settings, workers, generator, report, notes, at.objective
    )


def plane_of(
    loss: Loss,
    center: Float[Tensor, " n"],
    value: float,
    gradient: Float[Tensor, " n"],
    ends: EigenEnds,
    settings: ProbeSettings,
    workers: int,
    generator: torch.Generator,
    report: Progress,
    notes: list[str],
    objective: SceneObjective | None = None,
) -> PlaneSlice | None:
    """The loss over the plane of the first two eigenvectors; None where a note says why.  value, gradient: at center.

    objective: where the loss is that of one, so that it may be rendered in parts of its views (`loss_nearby`).
    """
    loss_scale, curvatures = settings.slice_rise * value, ends.largest.values[:2]
    if loss_scale <= 0 or not curvatures.all():
        notes.append("the slice was left out: the loss or one of the two largest curvatures is exactly 0")
        return None
    first, second = (curvature_reach(float(curvature), loss_scale) for curvature in curvatures)
    axes = [symmetric_axis(settings.slice_radius * unit, settings.slice_points) for unit in (first, second)]
    vectors = ends.largest.vectors[:, :2]
    most = inf if settings.slice_plane else 1  # 1: the two axes alone
    accuracy = SliceSettings(settings.slice_tolerance, workers=workers, max_evaluations=most)
    nearby = None
    if objective is not None and settings.slice_plane:
        corners = [center.new_tensor([x, y]) for x in axes[0][[0, -1]] for y in axes[1][[0, -1]]]
        nearby = loss_nearby(objective, vectors, [center + vectors @ corner for corner in corners])
    # E^T H E of Ritz vectors E is diagonal: no product is needed
    plane = evaluate_slice(
        loss, center, vectors, axes, gradient, curvatures.diag(), accuracy, generator, progress=report,
        control=nearby and nearby._replace(loss=evaluation(nearby.loss, workers)),
    )  # fmt: skip
    return PlaneSlice(plane, loss_scale, (first, second))


def evaluation(loss: Loss, workers: int) -> Loss:
    """The loss as a function for this number of threads; called from one alone, its kernels use all processors."""
    return loss if workers == 1 else single_threaded()(loss)
