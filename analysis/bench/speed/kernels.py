"""The compositing kernels by themselves, on random splats, beside a prototype of them where one is given.

A row is one stage as a view pays for it; arrays are allocated beforehand, and images are in each side's own layout:

    binning               sort by depth, tile lists, order of the tiles
    packing               parameters of the splats as the kernels read them
    forward
    slots                 numbering of the intersections that are reached
    backward + reduce     and the sum over each splat's intersections
    J u K
    tangent of backward K
    reduce K              the sum over each splat's intersections

The last three are per tangent.  A gradient is the first five rows; H u is the last three.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from analysis.bench.speed.prototype import Prototype
from analysis.bench.workloads import BACKGROUND, TANGENTS, Problem, Size, random_splats, splat_problem
from analysis.console.timing import Timing, interleaved
from splat.backend.cpu.planes import aligned
from splat.backend.cpu.threads import over_range, over_tiles, thread_count
from splat.model.settings import RenderSettings
from splat.projection.dispatch import coefficients_of, plain_gradient
from splat.raster.cpu import compositing, packing, tangents
from splat.raster.cpu.raster import CpuAdjoint, CpuRaster
from splat.raster.formulas import SPLAT

BOUNDS = (1.6, 1.1)  # of H u over a gradient, for each of TANGENTS
LISTS = ("binning", "packing", "slots")
COMPOSITING = ("forward", "backward + reduce")


@dataclass(frozen=True, eq=False)
class Stages:
    """What is timed, by row, and what the compositing rows leave, for a check that both sides compute the same."""

    calls: dict[str, Callable[[], object]]
    results: Callable[[], dict[str, np.ndarray]]
    raster: CpuRaster


def own_stages(p: Problem) -> Stages:
    """The stages of the project's kernels."""
    size, drawn = p.size, torch.ones(len(p.splats), dtype=torch.bool)
    splats, depths = torch.from_numpy(p.splats), torch.from_numpy(p.depths)
    raster = CpuRaster(splats, depths, drawn, torch.tensor(BACKGROUND), size.width, size.height, RenderSettings())
    cotangents = torch.from_numpy(p.cotangents)
    planes = raster.pad(torch.cat([cotangents, torch.zeros_like(cotangents[:, :1])], dim=1))
    adjoint = raster.backward(planes[0])
    lists, splat_start = raster.reached
    scalars = (raster.params, lists, raster.frame, raster.pixels)
    sums, moments = aligned((int(splat_start[-1]) * SPLAT,), raster.dtype), adjoint.moments.numpy()

    def backward():
        over_tiles(compositing.backward, *scalars, raster.flat(adjoint.cotangent), sums)
        over_range(len(splats), packing.reduce_sums, splat_start, sums, moments)

    calls: dict[str, Callable[[], object]] = {
        "binning": lambda: raster.bin(depths, drawn),
        "packing": raster.pack,
        "forward": raster.forward,
        "slots": raster.number_accumulators,
        "backward + reduce": backward,
    }
    results: dict[str, Callable[[], np.ndarray]] = {}
    for K in TANGENTS:
        calls |= _own_tangent_stages(p, raster, adjoint, planes[1 : 1 + K], K, results)

    def finished() -> dict[str, np.ndarray]:
        gradient = plain_gradient(raster.splats, adjoint.moments).numpy()
        tangents = {name: result() for name, result in results.items()}
        return {"forward": raster.crop(raster.planes[:3]).numpy(), "backward + reduce": gradient, **tangents}

    return Stages(calls, finished, raster)


def _own_tangent_stages(
    p: Problem,
    raster: CpuRaster,
    adjoint: CpuAdjoint,
    cotangents: Tensor,
    K: int,
    results: dict[str, Callable[[], np.ndarray]],
) -> dict[str, Callable[[], object]]:
    dtype, size, (lists, splat_start) = raster.dtype, raster.frame.size, raster.reached
    n, directions = len(raster.splats), torch.from_numpy(p.directions[:, :K]).double()
    packed = torch.stack([coefficients_of(raster.splats, each.contiguous()) for each in directions.unbind(1)], dim=1)
    packed = np.ascontiguousarray(packed.numpy(), dtype)
    planes, transmittances = aligned((K * 4 * size,), dtype), aligned((K * size,), dtype)
    sums = aligned((int(splat_start[-1]) * K * SPLAT,), dtype)
    primal, v_planes, dv_planes = (
        (lists, raster.frame, raster.pixels),
        raster.flat(adjoint.cotangent),
        raster.flat(cotangents),
    )
    product, moments = np.empty_like(packed), adjoint.moments.numpy()
    results[f"J u {K}"] = lambda: raster.crop(torch.from_numpy(planes).view(K, 4, *raster.plane)[:, :3]).numpy()
    results[f"reduce {K}"] = lambda: np.stack(
        [plain_gradient(raster.splats, each.contiguous()).numpy() for each in torch.from_numpy(product).unbind(1)],
        axis=1,
    )
    return {
        f"J u {K}": lambda: over_tiles(
            tangents.tangent, raster.params, packed.reshape(-1), *primal, planes, transmittances
        ),
        f"tangent of backward {K}": lambda: over_tiles(
            tangents.backward_tangent, raster.params, packed.reshape(-1), *primal, v_planes, transmittances, dv_planes, sums
        ),
        f"reduce {K}": lambda: over_range(
            n, packing.reduce_tangents, packed, splat_start, sums, moments, product
        ),
    }  # fmt: skip


# --- comparison -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """A stage at a size: own and prototype's times (None without one), per tangent, and how far the results are apart."""

    size: Size
    stage: str
    own: Timing
    prototype: Timing | None
    difference: float | None


def measure(size: Size, prototype: Prototype | None, repetitions: int, on_round: Callable[[], None]) -> list[Row]:
    """Time every stage at a size, own and prototype's in turns."""
    rng = np.random.default_rng(0)
    splats, depths = prototype.splats(*_numbers(size)) if prototype else random_splats(size, rng)
    p = splat_problem(size, splats, depths, rng)
    own = own_stages(p)
    calls, theirs = {("own", stage): call for stage, call in own.calls.items()}, None
    if prototype:
        their_calls, theirs = prototype.stages(p)
        calls |= {("prototype", stage): call for stage, call in their_calls.items()}
    ordered = {key: calls[key] for stage in own.calls for key in (("own", stage), ("prototype", stage)) if key in calls}
    times = interleaved(ordered, repetitions, on_round)
    apart = _differences(own.results(), theirs()) if theirs else {}
    rows = []
    for stage in own.calls:
        K = _tangents_of(stage)
        other = times[("prototype", stage)] / K if prototype else None
        rows.append(Row(size, stage, times[("own", stage)] / K, other, apart.get(stage)))
    return rows


def _numbers(size: Size) -> tuple[int, int, int]:
    return size.count, size.width, size.height


def _tangents_of(stage: str) -> int:
    last = stage.rsplit(" ", 1)[-1]
    return int(last) if last.isdigit() else 1


def _differences(own: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, float]:
    """|own - theirs| / |theirs|, root mean square."""
    return {name: float(np.linalg.norm(own[name] - x) / np.linalg.norm(x)) for name, x in theirs.items()}


def with_totals(rows: list[Row]) -> list[Row]:
    """The rows of a size and their sums: a gradient with and without the lists, H u with and without the stages around it."""
    of = {row.stage: row for row in rows}
    sums = {"gradient": (*LISTS, *COMPOSITING), "gradient, compositing": COMPOSITING}
    for K in TANGENTS:
        kernels = (f"J u {K}", f"tangent of backward {K}")
        sums |= {f"H u {K}": (*kernels, f"reduce {K}"), f"H u {K}, compositing": kernels}
    return [*rows, *(_total(name, [of[stage] for stage in stages]) for name, stages in sums.items())]


def _total(name: str, rows: list[Row]) -> Row:
    own, theirs = rows[0].own, rows[0].prototype
    for row in rows[1:]:
        own = own + row.own
        theirs = theirs + row.prototype if theirs and row.prototype else None
    return Row(rows[0].size, name, own, theirs, None)


def table(rows: list[Row]) -> pd.DataFrame:
    """One line a row: milliseconds (minimum, median) of both sides, and own over prototype."""
    lines = []
    for row in rows:
        line = {
            "gaussians": row.size.count,
            "width": row.size.width,
            "height": row.size.height,
            "threads": thread_count(),
            "stage": row.stage,
            "minimum_ms": 1e3 * row.own.minimum,
            "median_ms": 1e3 * row.own.median,
        }
        if row.prototype:
            line |= {
                "prototype_minimum_ms": 1e3 * row.prototype.minimum,
                "prototype_median_ms": 1e3 * row.prototype.median,
                "ratio_of_minima": row.own.minimum / row.prototype.minimum,
                "ratio_of_medians": row.own.median / row.prototype.median,
                "difference": row.difference,
            }
        lines.append(line)
    return pd.DataFrame(lines)


def products_over_gradients(rows: list[Row]) -> pd.DataFrame:
    """H u per tangent over a gradient, each as a whole and by its compositing alone, with what is asked of it."""
    lines = []
    for size in dict.fromkeys(row.size for row in rows):
        of = {row.stage: row.own for row in rows if row.size == size}
        for K, bound in zip(TANGENTS, BOUNDS, strict=True):
            for what in ("", ", compositing"):
                product, gradient = of[f"H u {K}{what}"], of[f"gradient{what}"]
                ratio = product.minimum / gradient.minimum
                lines.append(
                    {
                        "size": str(size),
                        "ratio": f"H u {K}{what} / gradient{what}",
                        "of_minima": ratio,
                        "of_medians": product.median / gradient.median,
                        "at_most": bound,
                        "holds": ratio <= bound,
                    }
                )
    return pd.DataFrame(lines)
