"""The stages of compositing that a bench times one by one, in the kernels' own parts, on the CPU and on a GPU.

    bin, pack, forward, slots, backward + reduce

pairs: the (pixel, Gaussian) pairs that a pass evaluates: on the CPU every lane of every row of every intersection that is
reached, on a GPU every pixel of its tile.
"""

from collections.abc import Callable
from typing import Any

from splat.raster.cpu.raster import CpuRaster

Calls = dict[str, Callable[[], object]]


def compositing_stages(projected: tuple[Any, ...], raster: Any, adjoint: Any) -> Calls:
    """The stages of a view by name.  projected: splats, depths and which are drawn; they leave `raster` as it was."""
    return {
        "bin": lambda: raster.bin(*projected[1:]),
        "pack": raster.pack,
        "forward": raster.forward,
        "slots": raster.number_accumulators,
        "backward + reduce": lambda: raster.backward(adjoint.cotangent),
    }


def pairs_of(raster: Any) -> int:
    if not isinstance(raster, CpuRaster):
        from splat.raster.cuda.binning import HEIGHT, WIDTH

        return raster.intersections_reached * WIDTH * HEIGHT
    packed = raster.reached[0].rows
    rows = ((packed >> 8) & 255) - (packed & 255) + 1
    return int(rows.sum()) * raster.plane[1] // raster.frame.columns
