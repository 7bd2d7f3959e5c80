"""The stages of compositing that a bench times one by one, in the kernels' own parts, on the CPU and on a GPU.

    bin, pack, forward, slots, backward + reduce

pairs: the (pixel, Gaussian) pairs that a pass evaluates: on the CPU every lane of every row of every entry that is reached, on
a GPU every pixel of its tile.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from analysis.bench.workloads import Workload
from splat.backend.cpu.planes import aligned
from splat.backend.cpu.threads import over_range, over_tiles
from splat.backend.device import by_triton
from splat.model.camera import Camera
from splat.raster.cpu import binning, compositing, packing, tile
from splat.raster.cpu.raster import Raster

Calls = dict[str, Callable[[], object]]


def compositing_stages(
    workload: Workload, camera: Camera, projected: tuple[Any, ...], raster: Any, adjoint: Any
) -> Calls:
    """The stages of a view by name.  projected: splats, depths and which are drawn; they leave `raster` as it was."""
    make = _on_gpu if by_triton(workload.gaussians.flat) else _on_cpu
    return make(workload, camera, projected, raster, adjoint)


def pairs_of(raster: Any) -> int:
    if not isinstance(raster, Raster):
        from splat.raster.cuda.binning import HEIGHT, WIDTH

        return raster.entries_reached * WIDTH * HEIGHT
    _ = raster.slot_start  # drops the entries that are not reached
    rows = ((raster.lists.rows >> 8) & 255) - (raster.lists.rows & 255) + 1
    return int(rows.sum()) * raster.plane[1] // raster.frame.columns


def _on_cpu(workload: Workload, camera: Camera, projected: tuple[Any, ...], raster: Raster, adjoint: Any) -> Calls:
    splats, depths, drawn = (tensor.numpy() for tensor in projected)
    where, n = (camera.width, camera.height, workload.settings), len(splats)
    lists = binning.bin_splats(splats, depths, drawn, *where)  # also the entries that `slots` drops
    sums = aligned((int(raster.slot_start[-1]) * tile.SUMS,), raster.dtype)
    drawing = (raster.params, raster.lists, raster.frame, raster.pixels)

    def slots() -> np.ndarray:
        raster.lists, raster._slot_start = lists, None
        return raster.slot_start

    def backward() -> None:
        over_tiles(compositing.backward, *drawing, adjoint.cotangent, sums)
        over_range(n, packing.reduce_gradient, splats, raster.slot_start, sums, adjoint.moments, adjoint.gradient)

    return {
        "bin": lambda: binning.bin_splats(splats, depths, drawn, *where),
        "pack": lambda: over_range(n, packing.pack_splats, splats, -8.0, np.inf, np.empty_like(raster.params)),
        "forward": lambda: over_tiles(compositing.forward, raster.params, lists, raster.frame, raster.pixels),
        "slots": slots,
        "backward + reduce": backward,
    }


def _on_gpu(workload: Workload, camera: Camera, projected: tuple[Any, ...], raster: Any, adjoint: Any) -> Calls:
    from splat.raster.cuda.binning import bin_splats

    splats, depths, drawn = projected
    return {
        "bin": lambda: bin_splats(splats, depths, drawn, camera.width, camera.height, raster.frame),
        "pack": raster.pack,
        "forward": raster.forward,
        "slots": raster.number_slots,
        "backward + reduce": lambda: raster.backward(adjoint.cotangent),
    }
