"""`landscape bench`: time and memory of a scene's first and second order, and the way to `accuracy` and `stress`.

OUT/bench.csv     a line a time: scene, stage (`scene`), milliseconds; products per vector

Times are minima and medians of repetitions in turns, by the clock of the device (`timing`).  On a GPU (--device cuda) scenes
are measured by its kernels.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console

from analysis.bench.accuracy.command import run_accuracy
from analysis.bench.options import BenchOptions
from analysis.bench.scene import ViewBench, per_vector
from analysis.bench.stress import run_stress
from analysis.bench.tables import rich_table, write_table
from analysis.bench.timing import Meter, interleaved, meter_of
from analysis.bench.workloads import Size, synthetic_workload, workload_of
from analysis.console.plain import say
from analysis.records.provenance import machine
from landscape.errors import InputError
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import thread_count
from splat.backend.device import device_named

SIZES = ("10k@504x378", "100k@504x378")


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
    refusals = {
        f"expected at least 1 repetition, got {options.repetitions}": options.repetitions < 1,
        f"expected bench accuracy RUN, or one subject alone, got {options.subject} and {options.checkpoint or 'no run'}": (
            (options.subject == "accuracy") != (options.checkpoint is not None)
        ),
        "expected a run, a scene or --sizes for the device cuda, as accuracy and stress are the CPU's; leave out --device": (
            options.device == "cuda" and options.subject in ("stress", "accuracy")
        ),
    }
    for sentence, wrong in refusals.items():
        if wrong:
            raise InputError(sentence)


def bench_scenes(options: BenchOptions, meter: Meter, console: Console) -> None:
    """Scenes on the meter's device."""
    say(_about(meter.device), console=console)
    workloads = [] if options.subject is None else [workload_of(Path(options.subject))]
    sizes = [Size.parse(text) for text in options.sizes or (() if workloads else SIZES)]
    options.out.mkdir(parents=True, exist_ok=True)
    times = []
    for workload in [*workloads, *map(synthetic_workload, sizes)]:
        bench = ViewBench(workload.to(meter.device))
        view, camera = bench.linearized, bench.view.camera
        measured = interleaved(bench.calls(), options.repetitions, clock=meter.seconds)
        lines = [
            {"scene": workload.name, "stage": name, "minimum_ms": 1e3 * time.minimum, "median_ms": 1e3 * time.median}
            for name, time in per_vector(measured).items()
        ]
        times.append(pd.DataFrame(lines))
        about = f"{len(workload.gaussians)} Gaussians, {camera.width} x {camera.height} px, {view.touched} visible"
        title = f"{workload.name}: {about}; one view, ms, products per vector"
        console.print(rich_table(times[-1].drop(columns="scene"), title))
        taken = f"{view.bytes / 1e6:.1f} MB kept, {bench.workspace(1, meter) / 1e6:.1f} MB more for a product"
        say(f"memory: {taken}", console=console)
        write_table(pd.concat(times, ignore_index=True), options.out / "bench.csv")  # what comes next may fail
    say(f"{options.out / 'bench.csv'}", console=console)


def _about(device: torch.device) -> str:
    about = machine(lanes_of(np.float32))
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, beside {about.cpu}"
    return f"{about.cpu}, {thread_count()} threads, {about.lanes} lanes of float32"
