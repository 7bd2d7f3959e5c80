"""`landscape probe FILE.py:FACTORY`: the landscape of somebody else's renderer, the `RendererHessian` that FACTORY() returns.

The file is run because it was named; nothing is put on Python's path.  FACTORY-probe beside it holds what a scene's probe does,
less what needs Gaussians.  Three numbers a row named "means" are positions: a picture shows where these are steep.
"""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from runpy import run_path
from time import perf_counter
from types import ModuleType

import torch
from rich.console import Console

from analysis.console.drawing import Draw
from analysis.console.plain import say
from analysis.console.recording import write_with_pictures
from analysis.console.stages import Stages
from analysis.probe import record
from analysis.probe.command import CHECK_FAILED, conclude, probe_settings, run_probe
from analysis.probe.measurement import RISE, plane_of
from analysis.probe.options import ProbeOptions
from analysis.records import schema
from analysis.records.page.report import write_report
from analysis.records.provenance import Provenance, provenance, require_seed
from analysis.records.records import Arrays, Check, Counts, ProbeRecord, record_folder
from landscape import RendererHessian, check_renderer, gauss_newton_traces, renderer_eigenpairs, spectral_density
from landscape.errors import InputError
from landscape.operators.checks import UNRESOLVED, WRONG
from landscape.slices.finite_probe import finite_probe
from landscape.slices.slices import curvature_reach
from landscape.traces.pixels import gauss_newton_blocks

USED = {"checkpoint", "out", "seed", "strict", "quick", "density_products", "end_products", "slice_points"}
POSITIONS, HALVINGS = "means", 7  # of the step along an eigenvector that changes the loss by RISE


def run_any_probe(options: ProbeOptions, command: Sequence[str] = (), drawn: Draw | None = None) -> int:
    """Probe a checkpoint, or a renderer where a factory is named; returns the exit code."""
    file, _, name = str(options.checkpoint).rpartition(":")
    if not file.endswith(".py"):
        return run_probe(options, command, drawn)
    require_seed(options.seed)
    for option, usual in vars(ProbeOptions(options.checkpoint)).items():
        if option not in USED and getattr(options, option) != usual:
            raise InputError(f"expected of a renderer no --{option.replace('_', '-')}, got one; leave it out")
    start, path, stages = perf_counter(), Path(file), Stages(Console(stderr=True))
    H, out, scene = made_by(path, name), options.out or path.parent / f"{name}-probe", f"{name}() of {path.name}"
    made = provenance(options.seed, command=shlex.join(command), scene=scene, checkpoint=str(options.checkpoint))
    with record_folder(out) as folder, stages:
        data, arrays = _probed(H, options, made, stages)
        write_with_pictures(folder, data, arrays, stages, start, drawn)
        write_report(folder)
    conclude(data, out, [])
    return CHECK_FAILED if options.strict and not all(check.passed for check in data.checks.values()) else 0


def made_by(path: Path, name: str) -> RendererHessian:
    """What the function of this name in this file returns.  InputError unless it is a `RendererHessian`."""
    module = ModuleType(name)
    try:
        vars(module).update(run_path(str(path), run_name=path.name))
        found = getattr(module, name)()
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
        raise InputError(f"expected a file with the function {name} that returns at {path}, got {said}") from error
    if not isinstance(found, RendererHessian):
        raise InputError(f"expected a landscape.RendererHessian from {name}() of {path}, got {type(found).__name__}")
    return found


def _probed(H: RendererHessian, options: ProbeOptions, made: Provenance, stages: Stages) -> tuple[ProbeRecord, Arrays]:
    """The record and its arrays; says the work first."""
    settings, (forth, back), size = probe_settings(options, len(H.views)), H.passes(vectors=1), H.dim
    most = options.end_products or (60 if options.quick else 300)
    say(
        f"{len(H.views)} views, {size:,} parameters; H v takes {forth} renders and {back} backward passes, "
        f"and there are at most {most + settings.density_matvecs + 4 * len(H.blocks) + 12} of them"
    )
    generator, notes, density = torch.Generator(H.point.device).manual_seed(options.seed), [], None
    with stages.stage("checks"):
        check = check_renderer(H, generator)
    with stages.stage("traces"):
        traces = gauss_newton_traces(H, generator, 8 if options.quick else 32)
    with stages.stage("eigenvalues") as report:
        ends = renderer_eigenpairs(H, generator, replace(settings.eigen, max_matvecs=most, further=0), progress=report)
    found = [(ends.largest, 0), (ends.largest, 1), (ends.smallest, 0)]
    first, second, last = (record.eigenvalue_record(ends, pairs, index, H.blocks) for pairs, index in found)
    with stages.stage("renders"):  # to the step at which the curvature changes the loss by RISE
        for row, pairs in ((first, ends.largest), (last, ends.smallest)):
            if (value := float(pairs.values[0])) and H.value > 0:
                reach = curvature_reach(value, RISE * H.value)
                steps = [reach / 2**k for k in range(HALVINGS, -1, -1)]
                row.renders = record.renders_record(finite_probe(H.loss_at, H.point, pairs.vectors[:, 0], H, steps))
    with stages.stage("slice") as report:
        plane = plane_of(H.loss_at, H.point, H.value, H.gradient, ends, settings, 1, generator, report, notes)
    if settings.density_matvecs:
        with stages.stage("density") as report:
            density = spectral_density(H, generator, settings.density_matvecs, ends=ends, progress=report)
    arrays = record.probe_arrays(traces, ends, density, plane)
    if POSITIONS in H.blocks and H.parameters.tensors[0].shape[1:] == (3,):
        groups = torch.arange(size, device=H.point.device)[H.blocks[POSITIONS]].reshape(-1, 3)
        largest = torch.linalg.eigvalsh(gauss_newton_blocks(H, generator, groups).values)[:, -1]
        arrays["places"] = {"positions": H.point[groups].double().cpu().numpy(), "curvature": largest.cpu().numpy()}
    off = max((abs(ratio) - 2 * spread for ratio, spread in check.gradients.values()), default=0.0)
    bounded = {"gradient": (off, WRONG), "products": (check.error, UNRESOLVED)}
    none = dict.fromkeys(("gaussians", "visible_gaussians", "sh_degree_stored", "sh_degree_active"), 0)
    return ProbeRecord(
        objective=schema.Objective(value=H.value, gradient_norm=float(H.gradient.norm())),
        traces={name: record.trace_record(trace) for name, trace in traces.items()},
        eigenvalues=schema.Eigenvalues(max=first, second=second, min=last),
        anisotropy=record.anisotropy_record(ends, density),
        concentration=record.concentration_record(density),
        slice=plane and record.slice_record(plane, ends.largest),
        counts=Counts(**none, parameters=size, active_parameters=size, views=len(H.views), products=ends.matvecs),
        checks={name: Check(value=value, bound=most, passed=value < most) for name, (value, most) in bounded.items()},
        notes=[*notes, *check.sentences, "traces are those of Gauss-Newton"],
        provenance=made,
        timing=stages.timing,
    ), arrays  # fmt: skip
