"""`landscape slice`: the loss of a checkpoint along a line or over a plane, as a record with pictures.

    load            the checkpoint, its scene, the other checkpoints of a line or a plane
    linearise       derivatives of every view
    directions      eigenvectors from the probe beside the checkpoint or by Lanczos, and their curvatures
    slice           renders in parallel; of a plane where needed, interpolated elsewhere (`landscape.slices.refinement`)
    finite steps    along a line: second differences at steps over four decades, beside the infinitesimal curvature

Eigenvectors and renders are kept in `.NAME.unfinished` beside the record until it is complete: after any interruption the same
command continues from them.  A line moves all Gaussians, also those that are in sight at one of its ends only.
"""

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from analysis.console.kept import Kept
from analysis.console.plain import say
from analysis.console.recording import write_with_pictures
from analysis.console.stages import Stages
from analysis.measures.memory import expected_peak, size_of
from analysis.measures.units import RISE
from analysis.probe.measurement import evaluation
from analysis.records.findings import of_slice, resolved
from analysis.records.provenance import provenance_of, require_seed
from analysis.records.quantities import apart, measured, quantity
from analysis.records.records import (
    ProbeRecord,
    Record,
    SliceRecord,
    record_folder,
    recorded_probe,
    require_replaceable,
)
from analysis.records.schema import FiniteProbe
from analysis.slice.directions import Direction, Shape, axis_of, find_directions
from analysis.slice.options import SliceOptions
from analysis.slice.record import Found, slice_arrays, slice_record
from landscape import CountingOperator, SliceSettings, evaluate_slice, finite_probe
from landscape.errors import InputError
from landscape.slices.grid_evaluations import Evaluation, Loss, slice_digest
from splat.backend.device import device_named
from splat.backend.memory import staying_within
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.model.files.read import is_foreign, read_splats
from splat.model.untrusted import KeptArrays
from splat.training.checkpoint import load_checkpoint, open_subject
from splat.training.origin.fingerprint import state_of
from splat.training.origin.subject import Checkpoint

STREAMS = ("eigenvectors", "random", "holdout", "directions")  # of random numbers; "directions" draws none itself
DECADES = [10.0 ** (k / 2) for k in range(-8, 1)]  # finite steps, in radii


def run_slice(options: SliceOptions, command: Sequence[str]) -> int:
    """Slice the checkpoint's loss; returns the exit code.  command: as typed, for the record."""
    with staying_within(size_of(options.memory)):
        return _run(options, command)


def _run(options: SliceOptions, command: Sequence[str]) -> int:
    require_seed(options.seed)
    shape = Shape.of(options.along, options.dimension, options.radius, options.points, len(options.others))
    device = device_named(options.device)
    # a thread for each render on a CPU, one render at a time on a GPU
    workers = torch.get_num_threads() if device.type == "cpu" else 1
    settings = SliceSettings(None if options.all_points else options.tolerance, workers=workers)
    out = options.out or options.checkpoint.parent / f"slice-{shape.name}"
    unfinished, console, start = out.with_name(f".{out.name}.unfinished"), Console(stderr=True), perf_counter()
    require_replaceable(out, SliceRecord.FILE)
    stages = Stages(console)
    with stages.stage("load"):  # shown from when nothing about the input can be wrong any more
        subject = open_subject(options.checkpoint, options.foreign, out)
        checkpoint = subject.checkpoint
        checkpoint.training.move(device)
        others = [_other_end(checkpoint, path) for path in options.others]
        objective = subject.objective(keep_unseen=bool(others))
        expected_peak(objective)  # raises MemoryError where it cannot fit
        ends = [state_of(checkpoint.training.gaussians.with_flat(other), 0) for other in others]
        made = checkpoint.fingerprint(_asked(options, settings) | {"others": ends}, options.seed)
    # the folder is opened first, so that one that cannot be written is refused before anything is rendered
    with record_folder(out, SliceRecord.FILE) as folder, stages:
        notes: list[str] = []
        seed, recorded = torch.Generator(device).manual_seed(options.seed), options.checkpoint.parent / "probe"
        kept = Kept(stages, seed, STREAMS, folder=unfinished, identity=f"{made.digest} {device}")
        known = recorded_probe(recorded, made, notes)
        try:
            found = _measure(objective, shape, others, known, settings, options, kept, checkpoint.all_views)
        except BaseException:
            if unfinished.is_dir():
                say(f"what was rendered is kept; to continue: {shlex.join(command)}", console=console)
            raise
        origin = provenance_of(made, subject, command)
        origin.other = ", ".join(map(str, options.others)) or None
        data = slice_record(found, objective, notes + checkpoint.assumptions, origin)
        objective.release()  # for the memory of the processes that draw
        write_with_pictures(folder, data, slice_arrays(found), stages, start)
    shutil.rmtree(unfinished, ignore_errors=True)
    _conclude(data, out)
    return 0


def _asked(options: SliceOptions, settings: SliceSettings) -> dict[str, Any]:
    """What changes the numbers; how many renders are made at a time does not."""
    amounts = {name: value for name, value in asdict(settings).items() if name != "workers"}
    return amounts | {name: getattr(options, name) for name in ("along", "dimension", "radius", "points")}


def _other_end(checkpoint: Checkpoint, path: Path) -> Float[Tensor, " n"]:
    """Parameters of the other checkpoint, with the sign of each quaternion that is nearer to the first one's."""
    here = checkpoint.training.gaussians
    there = read_splats(path).gaussians if is_foreign(path) else load_checkpoint(path).training.gaussians
    if (len(here), here.sh_degree) != (len(there), there.sh_degree):
        raise InputError(
            f"expected a checkpoint of {len(here):,} Gaussians with SH degree {here.sh_degree} at the other end of the line, "
            f"got {len(there):,} with {there.sh_degree} in {path}; take two of one training after densification has ended"
        )
    there = there.with_flat(there.flat.to(here.flat))
    filters = [each.filter_widths for each in (here, there) if each.filter_widths is not None]
    if len(filters) == 1 or (filters and not torch.equal(*filters)):
        raise InputError(
            f"expected a checkpoint with the same 3-D filter at the other end of the line, got another in {path}; take two of "
            "one training between which it was not renewed"
        )
    return there.aligned_to(here).flat


def _measure(
    objective: SceneObjective,
    shape: Shape,
    others: list[Float[Tensor, " n"]],
    probe: Record[ProbeRecord] | None,
    settings: SliceSettings,
    options: SliceOptions,
    kept: Kept,
    population: int | None,
) -> Found:
    """Run the stages after `load`.  probe: of this checkpoint; population: training views, where the objective has fewer."""
    center, stages = objective.active.flat, kept.stages
    known = [torch.from_numpy(probe.arrays["eigenvectors"]["largest"]).to(center.device)] if probe else []
    with stages.stage("linearise") as report:
        report(0, 1, f"{len(objective.views)} views")
        gradient = objective.gradient
        report(1, 1, f"{len(objective.views)} views")
    operator = CountingOperator(SceneHessian(objective))
    hessian = SceneHessian(objective, keep_null=True)  # a line may have components in the null space
    true = CountingOperator(hessian)
    find = partial(find_directions, shape, objective, operator, others, known, kept.streams)
    directions = kept.run("directions", list[Direction], lambda _, report, __: find(report))
    vectors = torch.stack([direction.vector for direction in directions], dim=1)
    curvatures = (vectors.double() * true.apply(vectors).double()).sum(dim=0).tolist()
    loss_scale = RISE * objective.loss(center)
    axes = [
        axis_of(direction.kind, radius, options.points, curvature, loss_scale)
        for direction, radius, curvature in zip(directions, shape.radii, curvatures, strict=True)
    ]
    loss = _evaluation(objective, settings.workers)
    digest = slice_digest(center, vectors, torch.cat(axes))
    assert kept.folder is not None
    store = KeptArrays(kept.folder / f"{digest[:16]}.npz")
    with stages.stage("slice") as report:
        found = evaluate_slice(
            loss, center, vectors, axes, gradient, true, settings, kept.streams["holdout"], store, report
        )
    finite = None
    if shape.dimension == 1:
        reach = 1.0 if shape.kind == "line" else float(axes[0][-1])
        with stages.stage("finite steps") as report:
            steps = [reach * step for step in DECADES]
            finite = finite_probe(_evaluation(objective, 1), center, vectors[:, 0], true, steps, report)
    by_view = None if population is None else hessian.by_view(vectors)
    matvecs = operator.matvecs + true.matvecs
    return Found(found, finite, directions, vectors, loss_scale, matvecs, population, by_view)


def _evaluation(objective: SceneObjective, workers: int) -> Loss:
    """`evaluation`, whose InputError says that the step is too long."""
    inner = evaluation(objective.evaluate, workers)

    def evaluate(flat: Tensor) -> Evaluation:
        try:
            return inner(flat)
        except InputError as error:
            raise InputError(f"expected steps to where there is an image, got one that is too long ({error})") from None

    return evaluate


def _conclude(data: SliceRecord, out: Path) -> None:
    """Print the curvatures, the accuracy of the slice, and its files."""
    for direction in data.slice.directions:
        curvature = measured(direction.curvature, direction.residual or 0.0) + apart(direction.views_error)
        text = f"{direction.name}: curvature {curvature}, slope {quantity(direction.slope or 0.0)}"
        say(f"{text}; one curvature unit is a step of {quantity(direction.unit)}")
    if data.finite_probe:
        say(_finite_curvature(data.finite_probe))
    say(*(line.text for line in of_slice(data.slice, data.provenance)))
    say(*data.notes, style="yellow")
    say(f"{data.timing.get('total', 0.0):.1f} s, {data.counts.renders:,} renders of a view")
    pictures = ", ".join(path.name for path in sorted(out.glob("*.png"))) or "none"
    say(f"pictures: {pictures}; numbers: {data.FILE}, in {out}")


def _finite_curvature(probe: FiniteProbe) -> str:
    """Sentence on the range of the curvatures at the steps where round-off does not hide them."""
    sure, steps = np.array(resolved(probe)), np.array(probe.steps)
    if not sure.any():
        return f"at finite steps: round-off hides the curvature at all {len(sure)} steps"
    values = np.array(probe.curvatures, float)[sure]
    crossed = int((sure & np.array(probe.crossed or [False] * len(sure))).sum())
    across = f", {crossed} of them with another order of splats" if crossed else ""
    return (
        f"at finite steps: curvature from {quantity(values.min())} to {quantity(values.max())}, at the {sure.sum()} of "
        f"{len(sure)} steps that round-off does not hide (±{quantity(steps[sure].min())} to ±{quantity(steps[sure].max())})"
        f"{across}"
    )
