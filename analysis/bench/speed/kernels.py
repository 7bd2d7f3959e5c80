"""The compositing kernels by themselves, on random splats, beside a prototype of them where one is given.

A row is one stage as a view pays for it; arrays are allocated beforehand, and images are in each side's own layout:

    binning               sort by depth, tile lists, order of the tiles
    packing               parameters of the splats as the kernels read them
    forward
    slots                 numbering of the entries that are reached
    backward + reduce     and the sum over each splat's entries
    tangents K            packing of K tangents
    J u K
    tangent of backward K
    reduce K              the sum over each splat's entries

The last four are per tangent.  A gradient is the first five rows; H u is the last four.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.bench.speed.prototype import Prototype
from analysis.bench.workloads import BACKGROUND, TANGENTS, Problem, Size, random_splats, splat_problem
from analysis.console.timing import Timing, interleaved
from splat.backend.cpu.planes import aligned
from splat.backend.cpu.threads import over_range, over_tiles, thread_count
from splat.model.settings import RenderSettings
from splat.raster.cpu import binning, compositing, packing, tangents, tile
from splat.raster.cpu.raster import Adjoint, Raster

BOUNDS = (1.6, 1.1)  # of H u over a gradient, for each of TANGENTS
LISTS = ("binning", "packing", "slots")
COMPOSITING = ("forward", "backward + reduce")


@dataclass(frozen=True, eq=False)
class Stages:
    """What is timed, by row, and what the compositing rows leave, for a check that both sides compute the same."""

    calls: dict[str, Callable[[], object]]
    results: Callable[[], dict[str, np.ndarray]]
    raster: Raster


def own_stages(p: Problem) -> Stages:
    """The stages of the project's kernels."""
    settings, drawn = RenderSettings(), np.ones(len(p.splats), np.bool_)
    size = p.size
    raster = Raster(p.splats, p.depths, drawn, np.array(BACKGROUND), size.width, size.height, settings)
    by_entries = raster.lists
    planes = raster.pad(np.concatenate([p.cotangents, np.zeros_like(p.cotangents[:, :1])], axis=1))
    adjoint = raster.backward(planes[0])
    slot_start, splats = raster.slot_start, raster.splats
    n = len(splats)
    entries, scalars = int(slot_start[-1]), (raster.params, raster.lists, raster.frame, raster.pixels)
    sums = aligned((entries * tile.SUMS,), p.splats.dtype)
    cut = np.log2(settings.alpha_min)

    def slots():
        raster.lists, raster._slot_start = by_entries, None
        return raster.slot_start

    def backward():
        over_tiles(compositing.backward, *scalars, adjoint.cotangent, sums)
        over_range(n, packing.reduce_gradient, splats, slot_start, sums, adjoint.moments, adjoint.gradient)

    calls: dict[str, Callable[[], object]] = {
        "binning": lambda: binning.bin_splats(splats, p.depths, drawn, size.width, size.height, settings),
        "packing": lambda: over_range(n, packing.pack_splats, splats, cut, np.inf, raster.params),
        "forward": lambda: over_tiles(compositing.forward, raster.params, by_entries, raster.frame, raster.pixels),
        "slots": slots,
        "backward + reduce": backward,
    }
    results: dict[str, np.ndarray] = {}
    for K in TANGENTS:
        calls |= _own_tangent_stages(p, raster, adjoint, planes[1 : 1 + K], K, results)

    def finished() -> dict[str, np.ndarray]:
        return {"forward": raster.crop(raster.planes[:3]), "backward + reduce": adjoint.gradient, **results}

    return Stages(calls, finished, raster)


def _own_tangent_stages(
    p: Problem, raster: Raster, adjoint: Adjoint, cotangents: np.ndarray, K: int, results: dict[str, np.ndarray]
) -> dict[str, Callable[[], object]]:
    splats, dtype, size, slot_start = raster.splats, raster.dtype, raster.frame.size, raster.slot_start
    n, directions = len(splats), np.ascontiguousarray(p.directions[:, :K], np.float64)
    packed = aligned((n * K * tile.TANGENTS,), dtype)
    planes, transmittances = aligned((K * 4 * size,), dtype), aligned((K * size,), dtype)
    sums = aligned((int(slot_start[-1]) * K * tile.SUMS,), dtype)
    primal, cotangents = (raster.lists, raster.frame, raster.pixels), np.ascontiguousarray(cotangents).reshape(-1)
    product = np.empty_like(directions)
    results[f"J u {K}"] = raster.crop(planes.reshape(K, 4, *raster.plane)[:, :3])
    results[f"reduce {K}"] = product
    return {
        f"tangents {K}": lambda: over_range(n, packing.pack_tangents, splats, directions, packed),
        f"J u {K}": lambda: over_tiles(
            tangents.tangent, raster.params, packed, *primal, planes, transmittances
        ),
        f"tangent of backward {K}": lambda: over_tiles(
            tangents.curvature, raster.params, packed, *primal, adjoint.cotangent, transmittances, cotangents, sums
        ),
        f"reduce {K}": lambda: over_range(
            n, packing.reduce_curvature, splats, directions, slot_start, sums, adjoint.moments, product
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
        sums |= {f"H u {K}": (f"tangents {K}", *kernels, f"reduce {K}"), f"H u {K}, compositing": kernels}
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
