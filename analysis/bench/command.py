"""`landscape bench`: speed and memory of the kernels (`bench_kernels`) and of a scene's first and second order (`bench_scene`).

OUT/kernels.csv   a line a stage and size: milliseconds, and over the prototype's where one was measured
OUT/kernel_bounds.csv   products over gradients, from the same times
OUT/bench.csv     a line a time: what was timed (`stage`), why (`study`: stages, or what was scaled), on what, milliseconds
OUT/bounds.csv    the ratios that the project promises, measured, with their bounds
OUT/precision.csv what float32 costs at a scene or checkpoint, view by view (`precision`)
OUT/bench.png     the scaling, drawn by `figures.bench` from bench.csv
OUT/stress.csv    `landscape bench stress`: errors at the limits of the renderer (`stress`)
OUT/accuracy.csv  `landscape bench accuracy`: work against true error of every estimator, beside peers (`accuracy`)

On a GPU (--device cuda) scenes are measured by its kernels, beside gsplat's gradient; the other subjects are the CPU's.

Times are minima and medians of repetitions in turns (`timing`), by the clock of the device (`meters`); ratios are of minima.
Products are per vector.
"""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from analysis.bench.accuracy.command import run_accuracy
from analysis.bench.precision import precision
from analysis.bench.speed import kernels as bench_kernels
from analysis.bench.speed.meters import Meter, bandwidth, meter_of
from analysis.bench.speed.prototype import prototype_in
from analysis.bench.speed.reference import ReferenceCost, reference_cost
from analysis.bench.speed.scene import OPERATIONS, VECTORS, ViewBench, per_vector, scaling
from analysis.bench.stress.command import run_stress
from analysis.bench.workloads import Size, Workload, synthetic_workload, workload_of
from analysis.console.drawing import draw
from analysis.console.options import BenchOptions
from analysis.console.timing import Timing, interleaved
from analysis.records.provenance import machine
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import thread_count
from splat.backend.device import by_triton, device_named
from splat.training.checkpoint import write_atomically

SIZES = ("10k@504x378", "100k@504x378")
LARGEST = "500k@1600x1060"
HEADINGS = {
    "minimum_ms": "own",
    "median_ms": "median",
    "prototype_minimum_ms": "proto",
    "prototype_median_ms": "median ",
    "ratio_of_minima": "ratio",
    "ratio_of_medians": "of medians",
    "difference": "apart",
}
Ratio = tuple[str, str, float]
# of times: what, to what, at most
ON_BOTH: tuple[Ratio, ...] = (("block diagonal", "gradient", 3.0), ("linearize", "gradient", 4.0))
ON_CPU: tuple[Ratio, ...] = (("gradient", "rasterizer", 2.5), ("H v 1", "gradient", 1.6), ("H v 4", "gradient", 1.0))
ON_GPU: tuple[Ratio, ...] = (
    ("gradient, atomic", "gsplat", 1.2),
    ("gradient, autograd", "gsplat", 1.8),
    ("H v 1", "gradient", 2.0),
    ("H v 8", "gradient", 1.2),
)
PRECISION = 1e-5  # asked for, of H v and of traces, with decisions held equal
SCALING_SHARE = 3  # scaling is timed with this fraction of the repetitions


def run_bench(options: BenchOptions) -> int:
    """Measure, print tables, write them; returns the exit code."""
    if options.repetitions < 1:
        raise ValueError(f"expected at least 1 repetition, got {options.repetitions}")
    if options.prototype is not None and options.subject != "kernels":
        raise ValueError(
            "expected --prototype with the kernels it is compared with: landscape bench kernels --prototype ..."
        )
    if options.checkpoint is not None and options.subject != "accuracy":
        raise ValueError(
            f"expected one subject, got a second one, {options.checkpoint}; only accuracy takes a checkpoint"
        )
    if (options.quantity or options.case or options.scenes != 1) and options.subject != "accuracy":
        raise ValueError(
            "expected --quantity, --case and --scenes with what they confine: landscape bench accuracy ..."
        )
    if options.device == "cuda" and options.subject in ("kernels", "stress", "accuracy"):
        raise ValueError(
            f"expected a scene, a checkpoint or --sizes for the device cuda, got {options.subject}, which measures the CPU's "
            "kernels; leave out --device"
        )
    folder = options.subject is not None and Path(options.subject).is_dir()
    if (options.images is not None or options.downscale != 1) and not folder and options.checkpoint is None:
        raise ValueError("expected --images and --downscale with a scene's folder, whose images they choose, got none")
    if options.images is not None and not folder:
        raise ValueError("expected --images with a scene's folder; a checkpoint's images are those of its training")
    if options.subject == "stress":
        return run_stress(options)
    if options.subject == "accuracy":
        return run_accuracy(options)
    console = Console()
    if options.subject == "kernels":
        options.out.mkdir(parents=True, exist_ok=True)
        console.print(_about(torch.device("cpu")), highlight=False)
        _bench_kernels(options, console)
    else:
        device = device_named(options.device)
        options.out.mkdir(parents=True, exist_ok=True)
        console.print(_about(device), highlight=False)
        bench_scenes(options, meter_of(device), console)
    return 0


def _about(device: torch.device) -> str:
    about = machine(lanes_of(np.float32))
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, beside {about['cpu']}"
    return f"{about['cpu']}, {thread_count()} threads, {about['lanes']} lanes of float32"


# --- kernels ----------------------------------------------------------------------------------------------------------


def _bench_kernels(options: BenchOptions, console: Console) -> None:
    sizes = [Size.parse(text) for text in options.sizes or (*SIZES, LARGEST)]
    rows: list[bench_kernels.Row] = []
    with ExitStack() as stack:
        prototype = stack.enter_context(prototype_in(options.prototype)) if options.prototype else None
        progress = stack.enter_context(Progress(console=Console(stderr=True), transient=True))
        for size in sizes:
            bar = progress.add_task(f"{size} (first compiling)", total=options.repetitions)
            measured = bench_kernels.measure(size, prototype, options.repetitions, lambda: progress.advance(bar))  # noqa: B023
            rows += bench_kernels.with_totals(measured)
            progress.remove_task(bar)
    table, ratios = bench_kernels.table(rows), bench_kernels.products_over_gradients(rows)
    for size in sizes:
        shown = bench_kernels.table([row for row in rows if row.size == size])
        shown = shown.drop(columns=["gaussians", "width", "height", "threads"]).rename(columns=HEADINGS)
        console.print(_rich(shown, f"{size}: ms, per tangent"))
    console.print(_rich(ratios, "products over gradients"))
    _write(table, options.out / "kernels.csv", console)
    _write(ratios, options.out / "kernel_bounds.csv", console)


# --- scenes -----------------------------------------------------------------------------------------------------------


def bench_scenes(options: BenchOptions, meter: Meter, console: Console) -> None:
    """Scenes on the meter's device."""
    workloads = []
    if options.subject is not None:
        workloads = [workload_of(Path(options.subject), options.images, options.downscale)]
    sizes = options.sizes or (() if workloads else SIZES)
    workloads += [synthetic_workload(Size.parse(text)) for text in sizes]
    workloads = [workload.to(meter.device) for workload in workloads]
    ceilings = meter.fma_peak(), bandwidth(meter)
    times, bounds = [], []
    for workload in workloads:
        bench = ViewBench(workload)
        console.print(
            f"[bold]{workload.name}[/]: {len(workload.gaussians)} Gaussians, {bench.view.camera.width} x "
            f"{bench.view.camera.height} px, {bench.linearized.touched} visible, {bench.linearized.entries} tile entries",
            highlight=False,
        )
        calls = {**bench.stages(), **bench.wholes(), **bench.peers()}
        measured = interleaved(calls, options.repetitions, clock=meter.seconds)
        lines = pd.DataFrame(_lines("stages", workload, measured))
        console.print(
            _rich(lines.filter(["stage", "minimum_ms", "median_ms"]), "times of one view; ms, products per vector")
        )
        console.print(_roofline(bench, measured, *ceilings))
        cost = reference_cost(workload) if options.reference else None
        held = _bounds(workload, bench, measured, cost, meter)
        console.print(_rich(held.drop(columns="scene"), "asked for"))
        if bench.lack:
            console.print(f"no gradient to compare with: {bench.lack}", soft_wrap=True, highlight=False)
        times.append(lines)
        bounds.append(held)
        for tables, name in ((times, "bench.csv"), (bounds, "bounds.csv")):  # what comes next may fail
            write_atomically(options.out / name, pd.concat(tables, ignore_index=True).to_csv(index=False).encode())
    if options.subject is not None:
        _precision(workloads[0], options.out / "precision.csv", console)
    times.append(pd.DataFrame(_scaling(workloads[0], max(1, options.repetitions // SCALING_SHARE), meter)))
    table = pd.concat(times, ignore_index=True)
    _write(table, options.out / "bench.csv", console)
    _write(pd.concat(bounds, ignore_index=True), options.out / "bounds.csv", console)
    draw("bench", options.out / "bench.csv")
    console.print(str(options.out / "bench.png"), soft_wrap=True, highlight=False)


def _precision(workload: Workload, path: Path, console: Console) -> None:
    """The worst error of any view, quantity by quantity."""
    table = pd.DataFrame([asdict(line) for line in precision(workload)])
    known = table.fillna({"error": -np.inf})  # a row without any error stays
    worst = known.pivot_table("error", ["quantity", "scale"], "decisions", aggfunc="max", sort=False).reset_index()
    worst = worst.replace(-np.inf, np.nan)
    bounds = [PRECISION if name.startswith(("H v", "trace")) else np.nan for name in worst["quantity"]]
    worst["at_most"] = bounds
    worst["holds"] = [not error > bound for error, bound in zip(worst["held equal"], bounds, strict=True)]
    console.print(_rich(worst, "float32 against float64, the worst view: error over the scale"))
    _write(table, path, console)


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
    return [
        {**about, "stage": name, "minimum_ms": 1e3 * time.minimum, "median_ms": 1e3 * time.median}
        for name, time in per_vector(times).items()
    ]


def _scaling(workload: Workload, repetitions: int, meter: Meter) -> list[dict]:
    lines = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task("scaling", total=None)
        for study, value, times in scaling(workload, repetitions, meter):
            lines += _lines(study, workload, times, value)
            progress.advance(bar)
    return lines


def _roofline(bench: ViewBench, times: dict[str, Timing], peak: float, bandwidth: float) -> Table:
    """How many pairs a second the passes evaluate, and which shares their arithmetic and bytes are of the ceilings."""
    pairs = bench.pairs
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
    return _rich(table, f"{pairs / 1e6:.1f} million (pixel, Gaussian) pairs; {ceilings}")


def _bounds(
    workload: Workload, bench: ViewBench, times: dict[str, Timing], reference: ReferenceCost | None, meter: Meter
) -> pd.DataFrame:
    """What is asked for as ratios: of times, and of bytes over what the view's size allows."""
    view, lines = bench.linearized, ratios(times, by_triton(workload.gaussians.flat))
    kept, allowed = bench.kept(), 1000 * view.touched + 200 * workload.pixels + 24 * view.entries
    lines.append(_line(f"kept linearisation ({kept / 1e6:.1f} MB) / allowance", kept / allowed, 1.0))
    workspaces = {K: bench.workspace(K, meter) for K in VECTORS}
    for K, used in workspaces.items():
        allowed = K * (40 * view.entries + 28 * workload.pixels + 500 * view.touched)
        lines.append(_line(f"workspace of K = {K} ({used / 1e6:.1f} MB) / allowance", used / allowed, 1.0))
    if reference:
        seconds, work = times["H v 1"].minimum, workspaces[1]
        name = f"reference's double backward ({reference.product:.1f} s) / H v 1"
        lines.append(_line(name, reference.product / seconds, 300, least=True))
        name = f"its memory ({reference.peak / 1e9:.2f} GB) / "
        lines.append(_line(name + "workspace of K = 1", reference.peak / work, 50, least=True))
        lines.append(_line(name + "workspace + kept", reference.peak / (work + kept), 50, least=True))
    return pd.DataFrame({"scene": workload.name, **line} for line in lines)


def ratios(times: dict[str, Timing], on_gpu: bool) -> list[dict]:
    """Those of times; nan where there was nothing to compare with."""
    each = per_vector(times)
    return [
        _ratio(f"{stage} / {unit}", each[stage], each.get(unit), bound)
        for stage, unit, bound in (*(ON_GPU if on_gpu else ON_CPU), *ON_BOTH)
        if stage in each
    ]


def _ratio(name: str, numerator: Timing, denominator: Timing | None, bound: float) -> dict:
    if denominator is None:
        return _line(name, np.nan, bound) | {"of_medians": np.nan}
    return _line(name, numerator.minimum / denominator.minimum, bound) | {
        "of_medians": numerator.median / denominator.median
    }


def _line(name: str, measured: float, bound: float, least: bool = False) -> dict:
    holds: bool | str = bool(measured >= bound if least else measured <= bound)
    if np.isnan(measured):
        holds = "not measured"
    return {"what": name, "measured": measured, "asked": f"{'≥' if least else '≤'} {bound:g}", "holds": holds}


# --- output -----------------------------------------------------------------------------------------------------------


def _rich(table: pd.DataFrame, title: str) -> Table:
    """The table for a terminal 80 characters wide: the first column keeps its line, the others' headings wrap."""
    result = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for place, column in enumerate(table):
        numeric = pd.api.types.is_numeric_dtype(table[column]) and not pd.api.types.is_bool_dtype(table[column])
        heading = str(column).replace("_", " ")
        result.add_column(heading, justify="right" if numeric else "left", no_wrap=place == 0)
    for row in table.itertuples(index=False):
        result.add_row(*map(_cell, row))
    return result


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "[bold]no[/]"
    if isinstance(value, float) and 0 < abs(value) < 1e-3:
        return f"{value:.0e}"
    if isinstance(value, float):
        return "" if pd.isna(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)


def _write(table: pd.DataFrame, path: Path, console: Console) -> None:
    write_atomically(path, table.to_csv(index=False).encode())
    console.print(path, soft_wrap=True, highlight=False)
