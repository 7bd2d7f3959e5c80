"""`landscape bench kernels`: the stages of compositing on the CPU (`speed.scene`) by themselves, on synthetic scenes.

OUT/kernels.csv         a line a stage and size: milliseconds, per vector; and their sums `gradient` and `H u K`
OUT/kernel_bounds.csv   products over gradients, from the same times: over all stages, and over compositing alone
"""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from operator import add
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.progress import Progress

from analysis.bench.speed.scene import ViewBench, per_vector
from analysis.bench.speed.timing import Timing, interleaved, time_lines
from analysis.bench.tables import rich_table, write_table
from analysis.bench.workloads import Size, synthetic_workload
from splat.backend.cpu.threads import thread_count

BOUNDS = {1: 1.6, 4: 1.1}  # at most of H u K per vector over a gradient, by K: what the project promises
SUMS = {
    "gradient": ("bin", "pack", "slots", "forward", "backward + reduce"),
    "gradient, compositing": ("forward", "backward + reduce"),
    **{f"H u {K}": (f"J u {K}", f"tangent of backward {K}") for K in BOUNDS},
}
Times = Mapping[str, Timing]


def measure(size: Size, repetitions: int, on_round: Callable[[], None]) -> dict[str, Timing]:
    """The times of every stage at a size, per vector, and those of a gradient and of products, summed from them."""
    bench = ViewBench(synthetic_workload(size), vectors=tuple(BOUNDS))
    calls = bench.compositing()
    for K in BOUNDS:
        calls |= bench.product(K)
    times = per_vector(interleaved(calls, repetitions, on_round))
    return times | {name: reduce(add, (times[stage] for stage in stages)) for name, stages in SUMS.items()}


def run_kernels(sizes: Sequence[Size], repetitions: int, out: Path, console: Console) -> None:
    """Time the stages at every size; print and write the tables."""
    lines, ratios = [], []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for size in sizes:
            bar = progress.add_task(f"{size} (first compiling)", total=repetitions)
            times = measure(size, repetitions, lambda bar=bar: progress.advance(bar))
            about = {"gaussians": size.count, "width": size.width, "height": size.height, "threads": thread_count()}
            table = pd.DataFrame(time_lines(about, times))
            console.print(rich_table(table.filter(["stage", "minimum_ms", "median_ms"]), f"{size}: ms, per vector"))
            lines.append(table)
            ratios += [{"size": str(size), **line} for line in products_over_gradients(times)]
            progress.remove_task(bar)
    bounds = pd.DataFrame(ratios)
    console.print(rich_table(bounds, "products over gradients"))
    write_table(pd.concat(lines), out / "kernels.csv", console)
    write_table(bounds, out / "kernel_bounds.csv", console)


def products_over_gradients(times: Times) -> list[dict]:
    """H u per vector over a gradient, all stages of it and compositing alone, with what is asked of it."""
    lines = []
    for K, bound in BOUNDS.items():
        for part in ("gradient", "gradient, compositing"):
            product, gradient = times[f"H u {K}"], times[part]
            ratio = product.minimum / gradient.minimum
            medians = {"of_minima": ratio, "of_medians": product.median / gradient.median}
            lines.append({"ratio": f"H u {K} / {part}", **medians, "at_most": bound, "holds": ratio <= bound})
    return lines
