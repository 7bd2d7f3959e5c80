"""`landscape probe FILE.py:FACTORY`: the landscape of somebody else's renderer, the `RendererHessian` that FACTORY() returns.

The file is run because it was named, from that path alone; nothing is put on Python's path.

OUT/renderer.json, by default in FACTORY-probe beside the file: the check of the renderer, passes of a product, traces of
Gauss-Newton, both ends of the spectrum with the errors of products, and renders along the steepest direction.
"""

import re
from collections.abc import Sequence
from dataclasses import fields
from importlib.util import module_from_spec, spec_from_file_location
from math import sqrt
from pathlib import Path
from typing import Any

import msgspec
import torch

from analysis.console.drawing import Draw
from analysis.console.plain import say
from analysis.probe.command import CHECK_FAILED, run_probe
from analysis.probe.options import ProbeOptions
from analysis.records.json_files import json_text
from analysis.records.provenance import provenance, require_seed
from analysis.records.records import record_folder
from landscape import EigenSettings, RendererHessian, check_renderer, gauss_newton_traces, renderer_eigenpairs
from landscape.eigen.pairs import Eigenpairs
from landscape.errors import InputError

FILE = "renderer.json"
NAMED = re.compile(r"(.+\.py):([^\W\d]\w*)")
USED = {"checkpoint", "out", "seed", "strict", "quick", "end_products", "slice_rise"}
STEPS = (-3, -2, -1, 1, 2, 3)  # in curvature units


def run_any_probe(options: ProbeOptions, command: Sequence[str] = (), drawn: Draw | None = None) -> int:
    """Probe a checkpoint, or a renderer where a factory is named; returns the exit code."""
    if not (found := NAMED.fullmatch(str(options.checkpoint))):
        return run_probe(options, command, drawn)
    require_seed(options.seed)
    default = ProbeOptions(options.checkpoint)
    for name in (field.name for field in fields(options) if field.name not in USED):
        if getattr(options, name) != getattr(default, name):
            raise InputError(f"expected of a renderer no --{name.replace('_', '-')}, got one; leave it out")
    path, name = Path(found[1]), found[2]
    hessian = made_by(path, name)
    with record_folder(options.out or path.parent / f"{name}-probe", FILE) as folder:
        data = {"provenance": msgspec.to_builtins(provenance(options.seed, command=" ".join(command)))}
        data |= _measured(hessian, options)
        (folder / FILE).write_text(json_text(data), encoding="utf-8")
    failed = [*data["check"]["sentences"]]
    say(*_summary(data), *failed)
    return CHECK_FAILED if options.strict and failed else 0


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


def _measured(hessian: RendererHessian, options: ProbeOptions) -> dict[str, Any]:
    """The record; says the work first."""
    samples, rtol, most = (8, 0.1, 60) if options.quick else (32, 0.01, 300)
    settings = EigenSettings(rtol=rtol, max_matvecs=options.end_products or most)
    renders, backwards = hessian.passes(vectors=1)
    say(
        f"{len(hessian.views)} views, {hessian.dim:,} parameters; H v takes {renders} renders and {backwards} backward passes, "
        f"and there are {4 * len(hessian.blocks) + 8} to {settings.max_matvecs + 4 * len(hessian.blocks) + 8} of them"
    )
    generator = torch.Generator(hessian.parameters.device).manual_seed(options.seed)
    check = check_renderer(hessian, generator)
    traces = gauss_newton_traces(hessian, generator, samples)
    ends = renderer_eigenpairs(hessian, generator, settings)
    return {
        "value": hessian.value,
        "gradient_norm": float(torch.linalg.vector_norm(hessian.gradient.double())),
        "passes": {"renders": renders, "backward": backwards},
        "check": check.record() | {"sentences": check.sentences},
        "traces": {name: trace.record() for name, trace in traces.items()},
        "eigenvalues": {name: _end(getattr(ends, name)) for name in ("largest", "smallest")},
        "slice": _slice(hessian, ends.largest, options.slice_rise),
    }


def _end(pairs: Eigenpairs) -> dict[str, Any]:
    return {"value": float(pairs.values[0]), "error": float(pairs.residuals[0]), "reason": pairs.reason}


def _slice(hessian: RendererHessian, largest: Eigenpairs, rise: float) -> list[dict[str, float]]:
    """Losses along the steepest direction, beside those of the quadratic; a unit raises the loss by this share."""
    curvature, v = float(largest.values[0]), largest.vectors[:, 0]
    if curvature <= 0:
        return []
    unit, slope = sqrt(2 * rise * hessian.value / curvature), float(hessian.gradient.double() @ v.double())
    return [
        {
            "step": step * unit,
            "loss": float(hessian.loss_at(hessian.point + step * unit * v)),
            "quadratic": hessian.value + step * unit * slope + curvature * (step * unit) ** 2 / 2,
        }
        for step in STEPS
    ]


def _summary(data: dict[str, Any]) -> list[str]:
    ends, check = data["eigenvalues"], data["check"]
    lines = [f"{name:<9} {end['value']:.2g} +- {end['error']:.1g} ({end['reason']})" for name, end in ends.items()]
    lines += [
        f"trace     of Gauss-Newton in {name}: {trace['value']:.2g} ({trace['low']:.2g} to {trace['high']:.2g})"
        for name, trace in data["traces"].items()
    ]
    return [*lines, f"checks    {'all passed' if check['passed'] else 'failed:'}"]
