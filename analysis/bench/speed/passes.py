"""The stages of compositing that a bench times one by one, on the CPU and on a GPU.

    bin                   sort by depth, tile lists, order of the tiles
    pack                  parameters of the splats as the kernels read them
    forward
    slots                 numbering of the (splat, tile) entries that are reached
    backward + reduce     and the sum over each splat's entries
    tangents K            packing of K tangents
    J u K                 the image's change along K tangents
    tangent of backward K
    reduce K              the sum over each splat's entries

A gradient is the first five, a product with the Hessian the last four.  Arrays are allocated beforehand.

pairs: the (pixel, Gaussian) pairs that a pass evaluates: on the CPU every lane of every row of every entry that is reached, on
a GPU every pixel of its tile.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from splat.backend.cpu.planes import aligned
from splat.backend.cpu.threads import over_range, over_tiles
from splat.model.camera import Camera
from splat.model.settings import RenderSettings
from splat.raster.cpu import binning, compositing, packing, tangents, tile
from splat.raster.cpu.raster import Adjoint, Raster

Calls = dict[str, Callable[[], object]]


def compositing_stages(
    projected: tuple[Any, ...], camera: Camera, settings: RenderSettings, raster: Any, adjoint: Any
) -> Calls:
    """The first five stages of a view by name.  projected: splats, depths, which are drawn; `raster` stays as it was."""
    size = camera.width, camera.height
    if isinstance(raster, Raster):
        splats, depths, drawn = (tensor.numpy() for tensor in projected)
        return cpu_stages(splats, depths, drawn, size, settings, raster, adjoint)
    from splat.raster.cuda.binning import bin_splats

    splats, depths, drawn = projected
    return {
        "bin": lambda: bin_splats(splats, depths, drawn, *size, raster.frame),
        "pack": raster.pack,
        "forward": raster.forward,
        "slots": raster.number_slots,
        "backward + reduce": lambda: raster.backward(adjoint.cotangent),
    }


def cpu_stages(
    splats: np.ndarray,
    depths: np.ndarray,
    drawn: np.ndarray,
    size: tuple[int, int],
    settings: RenderSettings,
    raster: Raster,
    adjoint: Adjoint,
) -> Calls:
    """The first five stages, which read these splats (n, 9) and write what `raster` and `adjoint` hold already."""
    n, cut = len(splats), np.log2(settings.alpha_min)
    lists = binning.bin_splats(splats, depths, drawn, *size, settings)  # also the entries that `slots` drops
    sums, params = aligned((int(raster.slot_start[-1]) * tile.SUMS,), raster.dtype), np.empty_like(raster.params)
    drawing = (raster.params, raster.lists, raster.frame, raster.pixels)

    def slots() -> np.ndarray:
        raster.lists, raster._slot_start = lists, None
        return raster.slot_start

    def backward() -> None:
        over_tiles(compositing.backward, *drawing, adjoint.cotangent, sums)
        over_range(n, packing.reduce_gradient, splats, raster.slot_start, sums, adjoint.moments, adjoint.gradient)

    return {
        "bin": lambda: binning.bin_splats(splats, depths, drawn, *size, settings),
        "pack": lambda: over_range(n, packing.pack_splats, splats, cut, np.inf, params),
        "forward": lambda: over_tiles(compositing.forward, raster.params, lists, raster.frame, raster.pixels),
        "slots": slots,
        "backward + reduce": backward,
    }


def tangent_stages(
    raster: Raster, adjoint: Adjoint, directions: np.ndarray, cotangents: np.ndarray
) -> tuple[Calls, np.ndarray, np.ndarray]:
    """The last four stages for directions (n, K, 9) and tangents of the cotangent (K, 4, plane); the arrays that they leave:
    the image's changes (K, 3, h, w) and the products (n, K, 9)."""
    splats, dtype, size, slot_start = raster.splats, raster.dtype, raster.frame.size, raster.slot_start
    n, K, _ = directions.shape
    directions, cotangents = np.ascontiguousarray(directions, np.float64), np.ascontiguousarray(cotangents).reshape(-1)
    packed = aligned((n * K * tile.TANGENTS,), dtype)
    planes, transmittances = aligned((K * 4 * size,), dtype), aligned((K * size,), dtype)
    sums = aligned((int(slot_start[-1]) * K * tile.SUMS,), dtype)
    primal, products = (raster.lists, raster.frame, raster.pixels), np.empty_like(directions)
    calls: Calls = {
        f"tangents {K}": lambda: over_range(n, packing.pack_tangents, splats, directions, packed),
        f"J u {K}": lambda: over_tiles(
            tangents.tangent, raster.params, packed, *primal, planes, transmittances
        ),
        f"tangent of backward {K}": lambda: over_tiles(
            tangents.curvature, raster.params, packed, *primal, adjoint.cotangent, transmittances, cotangents, sums
        ),
        f"reduce {K}": lambda: over_range(
            n, packing.reduce_curvature, splats, directions, slot_start, sums, adjoint.moments, products
        ),
    }  # fmt: skip
    return calls, raster.crop(planes.reshape(K, 4, *raster.plane)[:, :3]), products


def pairs_of(raster: Any) -> int:
    """(pixel, Gaussian) pairs that a pass evaluates."""
    if not isinstance(raster, Raster):
        from splat.raster.cuda.binning import HEIGHT, WIDTH

        return raster.entries_reached * WIDTH * HEIGHT
    _ = raster.slot_start  # drops the entries that are not reached
    rows = ((raster.lists.rows >> 8) & 255) - (raster.lists.rows & 255) + 1
    return int(rows.sum()) * raster.plane[1] // raster.frame.columns
