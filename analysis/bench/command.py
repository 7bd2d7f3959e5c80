"""`landscape bench`: time and memory of a scene's first and second order, and the way to the other studies.

OUT/bench.csv     a line a time: what was timed (`stage`), why (`study`: stages, or what was scaled), on what, milliseconds
OUT/bounds.csv    the ratios that the project promises, measured, with their bounds
OUT/precision.csv what float32 costs at a scene or checkpoint, view by view (`precision`)
OUT/bench.png     the scaling, drawn by `figures.bench` from bench.csv

`bench kernels`, `bench stress` and `bench accuracy` have tables of their own: see `speed.kernels`, `stress.command` and
`accuracy.command`.  On a GPU (--device cuda) scenes are measured by its kernels, beside gsplat's gradient; the other studies
are the CPU's.

Times are minima and medians of repetitions in turns (`speed.timing`), by the clock of the device (`meters`); ratios are of
minima.  Products are per vector.
"""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from analysis.bench.accuracy.command import run_accuracy
from analysis.bench.options import BenchOptions
from analysis.bench.precision import precision
from analysis.bench.speed.kernels import run_kernels
from analysis.bench.speed.meters import Meter, bandwidth, fma_peak, meter_of
from analysis.bench.speed.reference import ReferenceCost, reference_cost
from analysis.bench.speed.scene import OPERATIONS, VECTORS, ViewBench, per_vector, scaling
from analysis.bench.speed.timing import Timing, interleaved, time_lines
from analysis.bench.stress.command import run_stress
from analysis.bench.tables import rich_table, write_table
from analysis.bench.workloads import Size, Workload, synthetic_workload, workload_of
from analysis.console.drawing import draw
from analysis.console.plain import say
from analysis.records.provenance import machine
from landscape.errors import InputError
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import thread_count
from splat.backend.device import device_named
from splat.render.backend import CPU, backend_of

SIZES = ("10k@504x378", "100k@504x378")
LARGEST = "500k@1600x1060"
# what the project promises of times: what, to what, at most
ON_BOTH = (("block diagonal", "gradient", 3.0), ("linearize", "gradient", 4.0))
ON_CPU = (("gradient", "rasterizer", 2.5), ("H v 1", "gradient", 1.6), ("H v 4", "gradient", 1.0))
ON_GPU = (
    ("gradient, atomic", "gsplat", 1.2),
    ("gradient, autograd", "gsplat", 1.8),
    ("H v 1", "gradient", 2.0),
    ("H v 8", "gradient", 1.2),
)
# and of bytes: of what a linearisation keeps, for a visible Gaussian, a pixel and a tile entry; the same of the workspace for
# each vector of a product.  10,000 Gaussians at 504 x 378 take 0.55 of the first and 0.74 of the second in single precision
KEPT, WORKSPACE = (1000, 200, 24), (500, 28, 40)
REFERENCE_SECONDS, REFERENCE_MEMORY = 300, 50  # at least, of the reference's double backward over a product's
PRECISION = 1e-5  # asked for, of H v and of traces, with decisions held equal
SCALING_SHARE = 3  # scaling is timed with this fraction of the repetitions


def run_bench(options: BenchOptions) -> int:
    """Measure, print tables, write them; returns the exit code."""
    _require(options)
    if options.subject == "stress":
        return run_stress(options)
    if options.subject == "accuracy":
        return run_accuracy(options)
    console, device = Console(), torch.device("cpu") if options.subject == "kernels" else device_named(options.device)
    sizes = [Size.parse(text) for text in options.sizes]
    options.out.mkdir(parents=True, exist_ok=True)
    say(_about(device), console=console)
    if options.subject == "kernels":
        run_kernels(
            sizes or [Size.parse(text) for text in (*SIZES, LARGEST)], options.repetitions, options.out, console
        )
    else:
        bench_scenes(options, meter_of(device), console)
    return 0


def _require(options: BenchOptions) -> None:
    """InputError where options do not go together."""
    subject, folder = options.subject, options.subject is not None and Path(options.subject).is_dir()
    accuracy = subject == "accuracy"
    refusals = {
        f"expected at least 1 repetition, got {options.repetitions}": options.repetitions < 1,
        f"expected one subject, got a second one, {options.checkpoint}; only accuracy takes a checkpoint": (
            options.checkpoint is not None and not accuracy
        ),
        "expected --quantity, --case and --scenes with what they confine: landscape bench accuracy ...": (
            bool(options.quantity or options.case or options.scenes != 1) and not accuracy
        ),
        f"expected a scene, a checkpoint or --sizes for the device cuda, got {subject}, which measures the CPU's kernels; "
        "leave out --device": options.device == "cuda" and subject in ("kernels", "stress", "accuracy"),
        "expected --images and --downscale with a scene's folder, whose images they choose, got none": (
            (options.images is not None or options.downscale != 1) and not folder and options.checkpoint is None
        ),
        "expected --images with a scene's folder; a checkpoint's images are those of its training": (
            options.images is not None and not folder
        ),
    }
    for sentence, wrong in refusals.items():
        if wrong:
            raise InputError(sentence)


def _about(device: torch.device) -> str:
    about = machine(lanes_of(np.float32))
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, beside {about.cpu}"
    return f"{about.cpu}, {thread_count()} threads, {about.lanes} lanes of float32"


def bench_scenes(options: BenchOptions, meter: Meter, console: Console) -> None:
    """Scenes on the meter's device."""
    workloads = []
    if options.subject is not None:
        workloads = [workload_of(Path(options.subject), options.images, options.downscale)]
    sizes = options.sizes or (() if workloads else SIZES)
    workloads += [synthetic_workload(Size.parse(text)) for text in sizes]
    workloads = [workload.to(meter.device) for workload in workloads]
    ceilings = fma_peak(meter), bandwidth(meter)
    times, bounds = [], []
    for workload in workloads:
        bench = ViewBench(workload)
        say(
            f"{workload.name}: {len(workload.gaussians)} Gaussians, {bench.view.camera.width} x "
            f"{bench.view.camera.height} px, {bench.linearized.touched} visible, {bench.linearized.intersections} tile entries",
            style="bold",
            console=console,
        )
        calls = {**bench.stages(), **bench.wholes(), **bench.peers()}
        measured = interleaved(calls, options.repetitions, clock=meter.seconds)
        lines = pd.DataFrame(_lines("stages", workload, measured))
        console.print(
            rich_table(lines.filter(["stage", "minimum_ms", "median_ms"]), "times of one view; ms, products per vector")
        )
        console.print(_roofline(bench, measured, *ceilings))
        cost = reference_cost(workload) if options.reference else None
        held = _bounds(workload, bench, measured, cost, meter)
        console.print(rich_table(held.drop(columns="scene"), "asked for"))
        if bench.lack:
            say(f"no gradient to compare with: {bench.lack}", console=console)
        times.append(lines)
        bounds.append(held)
        for tables, name in ((times, "bench.csv"), (bounds, "bounds.csv")):  # what comes next may fail
            write_table(pd.concat(tables, ignore_index=True), options.out / name)
    if options.subject is not None:
        _precision(workloads[0], options.out / "precision.csv", console)
    times.append(pd.DataFrame(_scaling(workloads[0], max(1, options.repetitions // SCALING_SHARE), meter)))
    write_table(pd.concat(times, ignore_index=True), options.out / "bench.csv", console)
    write_table(pd.concat(bounds, ignore_index=True), options.out / "bounds.csv", console)
    say(*draw("bench", options.out / "bench.csv"), str(options.out / "bench.png"), console=console)


def _precision(workload: Workload, path: Path, console: Console) -> None:
    """The worst error of any view, quantity by quantity."""
    table = pd.DataFrame([asdict(line) for line in precision(workload)])
    known = table.fillna({"error": -np.inf})  # a row without any error stays
    worst = known.pivot_table("error", ["quantity", "scale"], "decisions", aggfunc="max", sort=False).reset_index()
    worst = worst.replace(-np.inf, np.nan)
    bounds = [PRECISION if name.startswith(("H v", "trace")) else np.nan for name in worst["quantity"]]
    worst["at_most"] = bounds
    worst["holds"] = [not error > bound for error, bound in zip(worst["held equal"], bounds, strict=True)]
    console.print(rich_table(worst, "float32 against float64, the worst view: error over the scale"))
    write_table(table, path, console)


def _lines(study: str, workload: Workload, times: dict[str, Timing], value: int = 0) -> list[dict]:
    """Lines of bench.csv; value: how much of what the study scales."""
    camera = workload.views[0].camera
    about = {
        "study": study,
        "scene": workload.name,
        "gaussians": len(workload.gaussians),
        "pixels": camera.width * camera.height,
        "views": 1,
        "device": workload.gaussians.flat.device.type,
        "threads": thread_count(),
    }
    if study in about:
        about[study] = value
    return time_lines(about, per_vector(times))


def _scaling(workload: Workload, repetitions: int, meter: Meter) -> list[dict]:
    lines = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task("scaling", total=None)
        for study, value, times in scaling(workload, repetitions, meter):
            lines += _lines(study, workload, times, value)
            progress.advance(bar)
    return lines


def _roofline(bench: ViewBench, times: dict[str, Timing], peak: float, bandwidth: float) -> Table:
    """Table of the pairs a second that the passes evaluate, and of their arithmetic and bytes as shares of the ceilings."""
    pairs = bench.raster.pairs
    table = pd.DataFrame(
        {
            "pass": name,
            "pairs_per_second_1e9": pairs / times[name].minimum / 1e9,
            "share_of_peak": pairs * OPERATIONS[name] / times[name].minimum / peak,
            "share_of_bandwidth": bench.bytes_of(name) / times[name].minimum / bandwidth,
        }
        for name in OPERATIONS
    )
    ceilings = f"peak {peak / 1e9:.0f} GFMA/s, {bandwidth / 1e9:.0f} GB/s"
    return rich_table(table, f"{pairs / 1e6:.1f} million (pixel, Gaussian) pairs; {ceilings}")


def _bounds(
    workload: Workload, bench: ViewBench, times: dict[str, Timing], reference: ReferenceCost | None, meter: Meter
) -> pd.DataFrame:
    """Ratios that the project promises: of times, and of bytes over what the view's size allows."""
    view, lines = bench.linearized, ratios(times, backend_of(workload.gaussians.flat) is not CPU)
    kept, sizes = bench.kept(), (view.touched, workload.pixels, view.intersections)
    allowed = sum(each * size for each, size in zip(KEPT, sizes, strict=True))
    lines.append(_line(f"kept linearisation ({kept / 1e6:.1f} MB) / allowance", kept / allowed, 1.0))
    workspaces = {K: bench.workspace(K, meter) for K in VECTORS}
    for K, used in workspaces.items():
        allowed = K * sum(each * size for each, size in zip(WORKSPACE, sizes, strict=True))
        lines.append(_line(f"workspace of K = {K} ({used / 1e6:.1f} MB) / allowance", used / allowed, 1.0))
    if reference:
        seconds, work = times["H v 1"].minimum, workspaces[1]
        name = f"reference's double backward ({reference.product:.1f} s) / H v 1"
        lines.append(_line(name, reference.product / seconds, REFERENCE_SECONDS, least=True))
        name, least = f"its memory ({reference.peak / 1e9:.2f} GB) / ", REFERENCE_MEMORY
        lines.append(_line(name + "workspace of K = 1", reference.peak / work, least, least=True))
        lines.append(_line(name + "workspace + kept", reference.peak / (work + kept), least, least=True))
    return pd.DataFrame({"scene": workload.name, **line} for line in lines)


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


def _line(name: str, measured: float, bound: float, least: bool = False) -> dict:
    holds: bool | str = bool(measured >= bound if least else measured <= bound)
    if np.isnan(measured):
        holds = "not measured"
    return {"what": name, "measured": measured, "asked": f"{'≥' if least else '≤'} {bound:g}", "holds": holds}
