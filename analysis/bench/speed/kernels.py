"""`landscape bench kernels`: the stages of compositing on the CPU (`passes`) by themselves, on random splats.

OUT/kernels.csv         a line a stage and size: milliseconds, per tangent; and sums of stages, `gradient` and `H u K`, each
                        also without what is not compositing
OUT/kernel_bounds.csv   products over gradients, from the same times
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from rich.progress import Progress

from analysis.bench.speed.passes import Calls, compositing_kernels, compositing_stages, tangent_stages
from analysis.bench.tables import rich_table, write_table
from analysis.bench.workloads import Size
from analysis.console.timing import Timing, interleaved
from splat.backend.cpu.threads import thread_count
from splat.model.settings import RenderSettings
from splat.projection.dispatch import plain_gradient
from splat.raster.cpu.raster import CpuRaster

BACKGROUND = (0.1, 0.2, 0.3)
BOUNDS = {1: 1.6, 4: 1.1}  # at most of H u K per tangent over a gradient, by K: what the project promises
NAMES = {"bin": "binning", "pack": "packing"}  # of stages, in the tables
COMPOSITING = ("forward", "backward + reduce")
Times = Mapping[str, Timing]


@dataclass(frozen=True, eq=False)
class Problem:
    """Random splats (n, 9) with their depths, cotangents (1 + K, 3, h, w) and directions (n, K, 9), K the most tangents."""

    size: Size
    splats: np.ndarray
    depths: np.ndarray
    cotangents: np.ndarray
    directions: np.ndarray


def random_splats(size: Size, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Splats (n, 9) and depths: spread evenly, the smaller standard deviation about 2.5 px, three in a hundred large."""
    n = size.count
    means = rng.uniform(-5, [size.width + 5, size.height + 5], (n, 2))
    large = rng.random(n) < 0.03
    minor = np.where(large, rng.uniform(15, 30, n), rng.lognormal(np.log(2.5), 0.5, n))
    major = np.clip(minor * rng.lognormal(0, 0.5, n), np.where(large, 8, 0.3), np.where(large, 35, 40))
    minor, angle = np.clip(minor, 0.3, 40), rng.uniform(0, np.pi, n)
    cos, sin = np.cos(angle), np.sin(angle)
    xx, yy = cos**2 * minor**2 + sin**2 * major**2 + 0.3, sin**2 * minor**2 + cos**2 * major**2 + 0.3
    xy = cos * sin * (minor**2 - major**2)
    conics = np.stack([yy, -xy, xx], axis=1) / (xx * yy - xy**2)[:, None]
    rest = [rng.uniform(0.05, 0.95, (n, 1)), rng.random((n, 3))]
    return np.concatenate([means, conics, *rest], axis=1).astype(np.float32), rng.uniform(1, 10, n).astype(np.float32)


def splat_problem(size: Size, rng: np.random.Generator) -> Problem:
    """Random splats, cotangents and directions; a direction's parts have the scale of what they move."""
    splats, depths = random_splats(size, rng)
    K = max(BOUNDS)
    cotangents = rng.standard_normal((1 + K, 3, size.height, size.width), np.float32)
    scales = np.array([1, 1, 0.01, 0.01, 0.01, 0.1, 0.3, 0.3, 0.3], np.float32)
    return Problem(size, splats, depths, cotangents, scales * rng.standard_normal((len(splats), K, 9), np.float32))


def stages_of(p: Problem) -> tuple[Calls, Callable[[], dict[str, np.ndarray]], CpuRaster]:
    """Every stage by its name, what they leave in plain coordinates, and the raster that they work on."""
    settings, size = RenderSettings(), (p.size.width, p.size.height)
    splats, depths, drawn = (
        torch.from_numpy(p.splats),
        torch.from_numpy(p.depths),
        torch.ones(len(p.splats), dtype=torch.bool),
    )
    raster = CpuRaster(splats, depths, drawn, torch.tensor(BACKGROUND), *size, settings)
    cotangents = torch.from_numpy(p.cotangents)
    planes = raster.pad(torch.cat([cotangents, torch.zeros_like(cotangents[:, :1])], dim=1))
    adjoint = raster.backward(planes[0])
    first = compositing_stages((splats, depths, drawn), raster, adjoint)
    calls = {NAMES.get(name, name): call for name, call in first.items()}
    calls["backward + reduce"] = backward = compositing_kernels(raster, adjoint)
    left = {}
    for K in BOUNDS:
        more, left[K] = tangent_stages(raster, adjoint, torch.from_numpy(p.directions[:, :K]), planes[1 : 1 + K])
        calls |= more

    def results() -> dict[str, np.ndarray]:
        found = {"backward + reduce": plain_gradient(raster.splats, torch.from_numpy(backward())).numpy()}
        for K, arrays in left.items():
            found[f"J u {K}"], found[f"reduce {K}"] = arrays()
        return found

    return calls, results, raster


def measure(size: Size, repetitions: int, on_round: Callable[[], None]) -> dict[str, Timing]:
    """The times of every stage at a size, per tangent, and those of a gradient and of products, summed from them."""
    calls, _, _ = stages_of(splat_problem(size, np.random.default_rng(0)))
    times = {stage: time / _tangents(stage) for stage, time in interleaved(calls, repetitions, on_round).items()}
    sums = {"gradient": ("binning", "packing", "slots", *COMPOSITING), "gradient, compositing": COMPOSITING}
    for K in BOUNDS:
        kernels = (f"J u {K}", f"tangent of backward {K}")
        sums |= {f"H u {K}": (*kernels, f"reduce {K}"), f"H u {K}, compositing": kernels}
    return times | {name: reduce(add, (times[stage] for stage in stages)) for name, stages in sums.items()}


def _tangents(stage: str) -> int:
    last = stage.rsplit(" ", 1)[-1]
    return int(last) if last.isdigit() else 1


def run_kernels(sizes: Sequence[Size], repetitions: int, out: Path, console: Console) -> None:
    """Time the stages at every size; print and write the tables."""
    lines, ratios = [], []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for size in sizes:
            bar = progress.add_task(f"{size} (first compiling)", total=repetitions)
            times = measure(size, repetitions, lambda bar=bar: progress.advance(bar))
            about = {"gaussians": size.count, "width": size.width, "height": size.height, "threads": thread_count()}
            lines += [
                {**about, "stage": stage, "minimum_ms": 1e3 * time.minimum, "median_ms": 1e3 * time.median}
                for stage, time in times.items()
            ]
            ratios += [{"size": str(size), **line} for line in products_over_gradients(times)]
            progress.remove_task(bar)
    table, bounds = pd.DataFrame(lines), pd.DataFrame(ratios)
    for size in sizes:
        shown = table.query("gaussians == @size.count and width == @size.width and height == @size.height")
        console.print(rich_table(shown.filter(["stage", "minimum_ms", "median_ms"]), f"{size}: ms, per tangent"))
    console.print(rich_table(bounds, "products over gradients"))
    write_table(table, out / "kernels.csv", console)
    write_table(bounds, out / "kernel_bounds.csv", console)


def products_over_gradients(times: Times) -> list[dict]:
    """H u per tangent over a gradient, each as a whole and by its compositing alone, with what is asked of it."""
    lines = []
    for K, bound in BOUNDS.items():
        for part in ("", ", compositing"):
            product, gradient = times[f"H u {K}{part}"], times[f"gradient{part}"]
            ratio = product.minimum / gradient.minimum
            medians = {"of_minima": ratio, "of_medians": product.median / gradient.median}
            name = f"H u {K}{part} / gradient{part}"
            lines.append({"ratio": name, **medians, "at_most": bound, "holds": ratio <= bound})
    return lines
