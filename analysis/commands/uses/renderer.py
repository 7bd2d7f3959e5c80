"""`landscape probe FILE.py:FACTORY`: the landscape of somebody else's renderer, the `RendererHessian` that FACTORY() returns.

The file is run because it was named, from that path alone; nothing is put on Python's path.  Record, pictures and page are
those of a scene's probe, less what needs Gaussians, in FACTORY-probe beside the file.  Traces are those of Gauss-Newton; errors
of eigenvalues have those of products in them.  Three numbers a row named "means" are positions: a picture shows where these
are steep.
"""

import re
import shlex
from collections.abc import Sequence
from dataclasses import fields, replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from msgspec import UNSET
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
from analysis.records.provenance import provenance, require_seed
from analysis.records.records import Arrays, Check, Counts, ProbeRecord, record_folder
from landscape import RendererHessian, check_renderer, gauss_newton_traces, renderer_eigenpairs, spectral_density
from landscape.eigen.pairs import Eigenpairs
from landscape.errors import InputError
from landscape.operators.renderer.check import UNRESOLVED, WRONG
from landscape.slices.finite_probe import finite_probe
from landscape.slices.slices import curvature_reach
from landscape.traces.pixels import gauss_newton_blocks

NAMED = re.compile(r"(.+\.py):([^\W\d]\w*)")
USED = {"checkpoint", "out", "seed", "strict", "quick", "density_products", "end_products", "slice_points"}
POSITIONS, HALVINGS = "means", 7  # of the step along an end that changes the loss by RISE


def run_any_probe(options: ProbeOptions, command: Sequence[str] = (), drawn: Draw | None = None) -> int:
    """Probe a checkpoint, or a renderer where a factory is named; returns the exit code."""
    if not (found := NAMED.fullmatch(str(options.checkpoint))):
        return run_probe(options, command, drawn)
    require_seed(options.seed)
    default = ProbeOptions(options.checkpoint)
    for name in (field.name for field in fields(options) if field.name not in USED):
        if getattr(options, name) != getattr(default, name):
            raise InputError(f"expected of a renderer no --{name.replace('_', '-')}, got one; leave it out")
    start, path, name = perf_counter(), Path(found[1]), found[2]
    hessian, stages = made_by(path, name), Stages(Console(stderr=True))
    out = options.out or path.parent / f"{name}-probe"
    with record_folder(out) as folder, stages:
        data, arrays = _measured(hessian, options, stages)
        data.provenance = provenance(
            options.seed,
            command=shlex.join(command),
            scene=f"{name}() of {path.name}",
            checkpoint=str(options.checkpoint),
        )
        write_with_pictures(folder, data, arrays, stages, start, drawn)
        write_report(folder)
    conclude(data, out, [])
    return CHECK_FAILED if options.strict and not all(check.passed for check in data.checks.values()) else 0


def made_by(path: Path, name: str) -> RendererHessian:
    """What the function of this name in this file returns.  InputError unless it is a `RendererHessian`."""
    spec = spec_from_file_location(path.stem, path.resolve())
    if not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"expected a file with the function {name}, found none at {path}")
    module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        found = getattr(module, name)()
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"expected {name}() of {path} to return, got {type(error).__name__}: {error}") from error
    if not isinstance(found, RendererHessian):
        raise InputError(
            f"expected a landscape.RendererHessian from {name}() of {path}, got {type(found).__name__}; return one"
        )
    return found


def _measured(hessian: RendererHessian, options: ProbeOptions, stages: Stages) -> tuple[ProbeRecord, Arrays]:
    """The record without its provenance, and its arrays; says the work first."""
    settings, (renders, backwards) = probe_settings(options), hessian.passes(vectors=1)
    most = options.end_products or (60 if options.quick else 300)
    eigen = replace(settings.eigen, max_matvecs=most, further=0)
    say(
        f"{len(hessian.views)} views, {hessian.dim:,} parameters; H v takes {renders} renders and {backwards} backward passes, "
        f"and there are at most {most + settings.density_matvecs + 4 * len(hessian.blocks) + 12} of them"
    )
    generator, notes = torch.Generator(hessian.parameters.device).manual_seed(options.seed), []
    with stages.stage("checks"):
        check = check_renderer(hessian, generator)
    with stages.stage("traces"):
        traces = gauss_newton_traces(hessian, generator, 8 if options.quick else 32)
    with stages.stage("eigenvalues") as report:
        ends = renderer_eigenpairs(hessian, generator, eigen, progress=report)
    with stages.stage("renders"):
        probes = [_along(hessian, pairs) for pairs in (ends.largest, ends.smallest)]
    with stages.stage("slice") as report:
        at = hessian.loss_at, hessian.point, hessian.value, hessian.gradient, ends, settings
        plane = plane_of(*at, 1, generator, report, notes)
    density = None
    if settings.density_matvecs:
        with stages.stage("density") as report:
            density = spectral_density(hessian, generator, settings.density_matvecs, ends=ends, progress=report)
    arrays = record.probe_arrays(traces, ends, density, plane)
    if POSITIONS in hessian.blocks and hessian.parameters.tensors[0].shape[1:] == (3,):
        arrays["places"] = _places(hessian, generator)
    found = [(ends.largest, 0), (ends.largest, 1), (ends.smallest, 0)]
    rows = [record.eigenvalue_record(ends, pairs, index, hessian.blocks) for pairs, index in found]
    for row, probe in zip((rows[0], rows[2]), probes, strict=True):
        row.renders = UNSET if probe is None else record.renders_record(probe)
    off = max((abs(ratio) - 2 * spread for ratio, spread in check.gradients.values()), default=0.0)
    return ProbeRecord(
        objective=schema.Objective(value=hessian.value, gradient_norm=float(hessian.gradient.norm())),
        traces={name: record.trace_record(trace) for name, trace in traces.items()},
        eigenvalues=schema.Eigenvalues(max=rows[0], second=rows[1], min=rows[2]),
        anisotropy=record.anisotropy_record(ends, density),
        concentration=record.concentration_record(density),
        slice=plane and record.slice_record(plane, ends.largest),
        counts=Counts(
            gaussians=0, visible_gaussians=0, parameters=hessian.dim, active_parameters=hessian.dim, sh_degree_stored=0,
            sh_degree_active=0, views=len(hessian.views), products=ends.matvecs,
        ),
        checks={
            "gradient": Check(value=off, bound=WRONG, passed=off <= WRONG),
            "products": Check(value=check.error, bound=UNRESOLVED, passed=check.error < UNRESOLVED),
        },
        notes=[*notes, *check.sentences, "traces are those of Gauss-Newton"],
        provenance=provenance(options.seed),
        timing=stages.timing,
    ), arrays  # fmt: skip


def _along(hessian: RendererHessian, pairs: Eigenpairs) -> Any:
    """Losses along an eigenvector, to the step at which its curvature changes the loss by RISE; None of an eigenvalue 0."""
    if not (value := float(pairs.values[0])) or hessian.value <= 0:
        return None
    reach = curvature_reach(value, RISE * hessian.value)
    steps = [reach / 2**k for k in range(HALVINGS, -1, -1)]
    return finite_probe(hessian.loss_at, hessian.point, pairs.vectors[:, 0], hessian, steps)


def _places(hessian: RendererHessian, generator: torch.Generator) -> dict[str, np.ndarray]:
    """Positions, and the largest eigenvalue of each one's block of Gauss-Newton."""
    rows = hessian.blocks[POSITIONS]
    groups = torch.arange(rows.start, rows.stop, device=hessian.point.device).reshape(-1, 3)
    blocks = gauss_newton_blocks(hessian, generator, groups).values
    largest = torch.linalg.eigvalsh(blocks)[:, -1]
    return {"positions": hessian.point[groups].double().cpu().numpy(), "curvature": largest.cpu().numpy()}
