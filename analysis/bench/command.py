"""`landscape bench`: time and memory of a scene's first and second order, and the way to `accuracy` and `stress`.

OUT/bench.csv     a line a time: scene, stage (`scene`), milliseconds; products per vector
OUT/bounds.csv    the ratios that the project promises, measured, with their bounds and whether they hold

Times are minima and medians of repetitions in turns, by the clock of the device (`timing`); ratios are of minima.  On a GPU
(--device cuda) scenes are measured by its kernels.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console

from analysis.bench.accuracy.command import run_accuracy
from analysis.bench.options import BenchOptions
from analysis.bench.stress import run_stress
from analysis.bench.tables import rich_table, write_table
from analysis.bench.timing import Meter, Timing, interleaved, meter_of
from analysis.bench.workloads import VECTORS, Size, ViewBench, Workload, per_vector, synthetic_workload, workload_of
from analysis.console.plain import say
from analysis.records.provenance import machine
from landscape.errors import InputError
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import thread_count
from splat.backend.device import device_named
from splat.render.backend import CPU

SIZES = ("10k@504x378", "100k@504x378")
# what the project promises of times: what, to what, at most
ON_BOTH = (("block diagonal", "gradient", 3.0), ("linearize", "gradient", 4.0))
ON_CPU = (("gradient", "rasterizer", 2.5), ("H v 1", "gradient", 1.6), ("H v 4", "gradient", 1.0))
ON_GPU = (("H v 1", "gradient", 2.0), ("H v 8", "gradient", 1.2))
# and of bytes: kept by a linearisation, for a visible Gaussian, a pixel and a tile entry; the same for the workspace of each
# vector of a product.  10,000 Gaussians at 504 x 378 take 0.55 of the first and 0.74 of the second in single precision.
# A GPU differentiates SSIM of whole planes at once: on an H100 the scenes of SIZES took 0.9 and 0.8 of its allowance.
KEPT, WORKSPACE, GPU_WORKSPACE = (1000, 200, 24), (500, 28, 40), (100, 145, 40)


def run_bench(options: BenchOptions) -> int:
    """Measure, print tables, write them; returns the exit code."""
    require(options)
    if options.subject == "stress":
        return run_stress(options.out)
    if options.checkpoint is not None:
        return run_accuracy(options.checkpoint, options.out, options.repetitions)
    bench_scenes(options, meter_of(device_named(options.device)), Console())
    return 0


def require(options: BenchOptions) -> None:
    """InputError where options do not go together."""
    if options.repetitions < 1:
        raise InputError(f"expected at least 1 repetition, got {options.repetitions}")
    if (options.subject == "accuracy") != (options.checkpoint is not None):
        given = f"{options.subject} and {options.checkpoint or 'no run'}"
        raise InputError(f"expected bench accuracy RUN, or one subject alone, got {given}")
    if options.device == "cuda" and options.subject in ("stress", "accuracy"):
        raise InputError(
            "expected a run, a scene or --sizes for the device cuda, as accuracy and stress are the CPU's; leave out --device"
        )


def bench_scenes(options: BenchOptions, meter: Meter, console: Console) -> None:
    """Scenes on the meter's device."""
    say(_about(meter.device), console=console)
    workloads = [] if options.subject is None else [workload_of(Path(options.subject))]
    sizes = [Size.parse(text) for text in options.sizes or (() if workloads else SIZES)]
    options.out.mkdir(parents=True, exist_ok=True)
    times, bounds = [], []
    for workload in [*workloads, *map(synthetic_workload, sizes)]:
        bench = ViewBench(workload.to(meter.device))
        view, camera = bench.linearized, bench.view.camera
        measured = interleaved(bench.calls(), options.repetitions, clock=meter.seconds)
        lines = [
            {"scene": workload.name, "stage": name, "minimum_ms": 1e3 * time.minimum, "median_ms": 1e3 * time.median}
            for name, time in per_vector(measured).items()
        ]
        workspaces = {K: bench.workspace(K, meter) for K in VECTORS}
        found = [*ratios(measured, bench.backend is not CPU), *memory(workload, bench, workspaces)]
        times.append(pd.DataFrame(lines))
        bounds.append(pd.DataFrame({"scene": workload.name, **line} for line in found))
        about = f"{len(workload.gaussians)} Gaussians, {camera.width} x {camera.height} px, {view.touched} visible"
        title = f"{workload.name}: {about}; one view, ms, products per vector"
        console.print(rich_table(times[-1].drop(columns="scene"), title))
        taken = f"{view.bytes / 1e6:.1f} MB kept, {workspaces[1] / 1e6:.1f} MB more for a product"
        say(f"memory: {taken}", console=console)
        for tables, name in ((times, "bench.csv"), (bounds, "bounds.csv")):  # what comes next may fail
            write_table(pd.concat(tables, ignore_index=True), options.out / name)
    say(f"{options.out / 'bench.csv'}, {options.out / 'bounds.csv'}", console=console)


def _about(device: torch.device) -> str:
    about = machine(lanes_of(np.float32))
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, beside {about.cpu}"
    return f"{about.cpu}, {thread_count()} threads, {about.lanes} lanes of float32"


def memory(workload: Workload, bench: ViewBench, workspaces: dict[int, int]) -> list[dict]:
    """Bytes that the linearisation keeps and products take, over what the view's size allows."""
    view = bench.linearized
    sizes, kept = (view.touched, workload.pixels, view.intersections), view.bytes
    allowed = sum(each * size for each, size in zip(KEPT, sizes, strict=True))
    room = WORKSPACE if bench.backend is CPU else GPU_WORKSPACE
    lines = [_line(f"kept linearisation ({kept / 1e6:.1f} MB) / allowance", kept / allowed, 1.0)]
    for K, used in workspaces.items():
        allowed = K * sum(each * size for each, size in zip(room, sizes, strict=True))
        lines.append(_line(f"workspace of K = {K} ({used / 1e6:.1f} MB) / allowance", used / allowed, 1.0))
    return lines


def ratios(times: dict[str, Timing], on_gpu: bool) -> list[dict]:
    """Ratios of times; nan where there was nothing to compare with."""
    each = per_vector(times)
    nothing, lines = Timing((np.nan,)), []
    for stage, unit, bound in (*(ON_GPU if on_gpu else ON_CPU), *ON_BOTH):
        if stage in each:
            over = each.get(unit, nothing)
            line = _line(f"{stage} / {unit}", each[stage].minimum / over.minimum, bound)
            lines.append({**line, "of_medians": each[stage].median / over.median})
    return lines


def _line(name: str, measured: float, bound: float) -> dict:
    holds: bool | str = bool(measured <= bound)
    if np.isnan(measured):
        holds = "not measured"
    return {"what": name, "measured": measured, "asked": f"≤ {bound:g}", "holds": holds}
