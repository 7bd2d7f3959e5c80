"""`landscape probe`: from a checkpoint to a record folder (`analysis.records.records`) and a summary on the terminal.

The operator is the exact Hessian of the training loss over the training views, in the checkpoint's precision.  Results of
finished stages are kept in `.NAME.unfinished` beside the record until it is complete: after any interruption the same command
continues from them.
"""

import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import torch
from rich.console import Console

from analysis.console.drawing import Draw
from analysis.console.kept import kept_stages
from analysis.console.plain import say
from analysis.console.recording import write_with_pictures
from analysis.console.stages import Stages
from analysis.measures.memory import expected_peak, size_of
from analysis.measures.units import optimiser_units, step_lengths
from analysis.probe.measurement import measure
from analysis.probe.options import ProbeOptions
from analysis.probe.plan import MEASURES, expected_seconds, seconds_of_render
from analysis.probe.record import probe_arrays, probe_record
from analysis.probe.settings import ProbeSettings
from analysis.probe.views import write_views
from analysis.records.page.report import FILE as REPORT
from analysis.records.page.report import write_report
from analysis.records.page.summary import guess, remarks, steps_made, summary
from analysis.records.provenance import provenance_of, require_seed
from analysis.records.records import ProbeRecord, record_folder, require_replaceable
from analysis.records.tables import family_table
from landscape.errors import InputError
from landscape.operators.distributed import ALONE, Ranks, torchrun_ranks
from landscape.probes import spawn
from splat.backend.device import device_named
from splat.backend.memory import staying_within
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.scenes.scene import Scene
from splat.training.checkpoint import open_subject
from splat.training.origin.fingerprint import Fingerprint
from splat.training.origin.subject import Checkpoint

if TYPE_CHECKING:
    from analysis.measures.per_attribute import PerAttributeOptions

CHECK_FAILED = 1
MANY_VIEWS, FEWER_POINTS = 10, 21


def run_probe(options: ProbeOptions, command: Sequence[str] = (), drawn: Draw | None = None) -> int:
    """Probe the checkpoint; returns the exit code.  command: as typed, for the record; drawn: see `write_with_pictures`.

    Started by torchrun, the processes share each product's views, and the first one writes.
    """
    require_seed(options.seed)
    device = device_named(options.device)
    with torchrun_ranks(device) as ranks, staying_within(size_of(options.memory)):
        return _run(options, command, drawn, device, ranks)


def _run(
    options: ProbeOptions, command: Sequence[str], drawn: Draw | None, device: torch.device, ranks: Ranks | None
) -> int:
    """The probe in this process.  ranks: of the processes that share the views, where there are several."""
    start = perf_counter()
    out = options.out or options.checkpoint.parent / ("probe-quick" if options.quick else "probe")
    settings, families = probe_settings(options, views=1), _family_options(options)  # before anything is loaded
    if ranks is not None and families is not None:
        raise InputError(
            "expected no --per-attribute, --split-control or --metric under torchrun, got one; run it in one process"
        )
    writes = ranks is None or ranks.rank == 0
    console, unfinished = Console(stderr=True, quiet=not writes), out.with_name(f".{out.name}.unfinished")
    require_replaceable(out)
    stages = Stages(console)
    with stages.stage("load"):  # shown from when nothing about the input can be wrong any more
        subject = open_subject(options.checkpoint, options.foreign, out)
        checkpoint, scene = subject.checkpoint, subject.scene
        checkpoint.training.move(device)
        objective = subject.objective(loss=LossSettings() if options.loss == "3dgs" else None)
    settings, guessed = probe_settings(options, len(checkpoint.scene.train)), guess(checkpoint.origin)
    say(*guessed, _introduction(scene, checkpoint, objective), console=console)
    say(
        _expected(objective, settings, (families.products if families else 0.0) + MEASURES * options.measures),
        console=console,
    )
    made = asked(options, checkpoint)
    identity = f"{made.but('settings.per_attribute').digest} {device}"  # families are measured after what is kept
    # the folder is opened first, so that one that cannot be written is refused before anything is measured
    with record_folder(out) if writes else nullcontext() as folder, stages, _kept(unfinished, command, console):
        generator = torch.Generator(device).manual_seed(options.seed)
        rates = checkpoint.training.config.rates, checkpoint.training.extent
        found = measure(
            objective, settings, optimiser_units(objective, *rates), generator, stages, None if ranks else unfinished, identity,
            population=checkpoint.all_views, ranks=ranks or ALONE,
        )  # fmt: skip
        origin = provenance_of(made, subject, command)
        data = probe_record(found, objective, origin, stages.timing)
        arrays = probe_arrays(found.traces, found.ends, found.density, found.plane)
        data.steps = step_lengths(*rates)
        if families is not None:
            from analysis.measures.per_attribute import measure_per_attribute  # slow to import

            stream = spawn(generator)
            measured = measure_per_attribute(objective, checkpoint.training, families, stream, stages.stage, found.ends)
            data = measured.added_to(data)
        data.notes += checkpoint.assumptions
        if options.measures and folder is not None:
            from analysis.probe.measures import measures  # slow to import

            with stages.stage("measures") as report:
                data.measures = measures(subject, objective, options.seed, report)
        if folder is not None:
            objective.release()  # for the memory of the processes that draw
            ends = data.eigenvalues.max, data.eigenvalues.min
            write_views(folder, objective, [end.carrier.view for end in ends if end.carrier])
            write_with_pictures(folder, data, arrays, stages, start, drawn)
            write_report(folder)
    if writes:
        shutil.rmtree(unfinished, ignore_errors=True)
        conclude(data, out, guessed)
        say(f"next: open the report in a browser; {origin.other_command('map')}")
    failed = any(check.passed is False for check in data.checks.values())
    return CHECK_FAILED if options.strict and failed else 0


@contextmanager
def _kept(folder: Path, command: Sequence[str], console: Console) -> Iterator[None]:
    """Say how to continue, where the block is interrupted.  folder: of the stages that are kept."""
    try:
        yield
    except KeyboardInterrupt:
        if stages := ", ".join(kept_stages(folder)):
            words = f"kept: {stages}; the same command continues from there: {shlex.join(command)}"
            say(words, console=console)
        raise


def asked(options: ProbeOptions, checkpoint: Checkpoint) -> Fingerprint:
    """What the numbers of a probe with these options are about.  checkpoint: thinned as they say."""
    settings, families = probe_settings(options, len(checkpoint.scene.train)), _family_options(options)
    numbers = asdict(settings) | ({} if families is None else {"per_attribute": asdict(families)})
    return checkpoint.fingerprint(numbers, options.seed, LossSettings() if options.loss == "3dgs" else None)


def probe_settings(options: ProbeOptions, views: int) -> ProbeSettings:
    """Settings of a probe of so many views: each point of the slice renders them all."""
    settings = ProbeSettings.quick() if options.quick else ProbeSettings()
    points = options.slice_points or (FEWER_POINTS if views >= MANY_VIEWS else None)
    changes: dict[str, Any] = {"slice_points": points, "density_matvecs": options.density_products}
    if options.end_products is not None:
        changes["eigen"] = replace(settings.eigen, max_matvecs=options.end_products)
    changes = {name: value for name, value in changes.items() if value is not None}
    return replace(settings, **changes)


def _family_options(options: ProbeOptions) -> "PerAttributeOptions | None":
    """Options of the families; None without --per-attribute, --split-control and --metric."""
    if not (options.per_attribute or options.split_control or options.metric != "parameters"):
        return None
    from analysis.measures.per_attribute import PerAttributeOptions  # slow to import

    return PerAttributeOptions(options.metric, options.split_control)


def _introduction(scene: Scene, checkpoint: Checkpoint, objective: SceneObjective) -> str:
    counts, training, camera = objective.counts, checkpoint.training, objective.views[0].camera
    views = f"{counts.views} of {checkpoint.all_views}" if checkpoint.all_views else f"{counts.views}"
    return (
        f"{scene.name}, {steps_made(training.step, bool(checkpoint.origin))}: "
        f"{views} views of {camera.width} x {camera.height} px, "
        f"{counts.visible_gaussians:,} of {counts.gaussians:,} Gaussians in sight, "
        f"{counts.active_parameters:,} active parameters"
    )


def _expected(objective: SceneObjective, settings: ProbeSettings, further: float) -> str:
    """Expected time and memory, from a render and from the views' sizes.  Raises MemoryError where it cannot fit."""
    peak = expected_peak(objective)
    objective.loss(objective.active.flat)  # untimed, as the kernels may compile
    seconds = expected_seconds(settings, seconds_of_render(objective), further)
    return f"about {seconds:,.0f} s, roughly, and {peak / 1e9:.1f} GB of memory"


def conclude(data: ProbeRecord, out: Path, guessed: Sequence[str]) -> None:
    """Print the summary, what failed and what is not known, with remedies."""
    console = Console()
    if data.per_attribute:
        console.print(family_table(data))
    for line in remarks(data):
        console.print(line.text, style="red" if line.level == "failure" else "yellow", highlight=False, markup=False)
    say(*summary(data, out / REPORT), *guessed, console=console)
