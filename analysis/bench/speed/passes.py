"""The stages of compositing that a bench times one by one, on the CPU and on a GPU.

    bin                   sort by depth, tile lists, order of the tiles
    pack                  parameters of the splats as the kernels read them
    forward
    slots                 numbering of the (splat, tile) intersections that some pixel reaches
    backward + reduce     and the sum over each splat's intersections
    J u K                 the image's change along K tangents
    tangent of backward K
    reduce K              the sum over each splat's intersections

A gradient is the first five, a product with the Hessian the last three.  Arrays are allocated beforehand.

pairs: the (pixel, Gaussian) pairs that a pass evaluates: on the CPU every lane of every row of every intersection that is
reached, on a GPU every pixel of its tile.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.cpu.planes import aligned
from splat.backend.cpu.threads import over_range, over_tiles
from splat.projection.dispatch import coefficients_of, plain_gradient
from splat.raster.cpu import compositing, packing, tangents
from splat.raster.cpu.raster import CpuAdjoint, CpuRaster
from splat.raster.formulas import SPLAT

Calls = dict[str, Callable[[], object]]


def compositing_stages(projected: tuple[Any, ...], raster: Any, adjoint: Any) -> Calls:
    """The first five stages of a view by name.  projected: splats, depths, which are drawn; `raster` stays as it was."""
    return {
        "bin": lambda: raster.bin(*projected[1:]),
        "pack": raster.pack,
        "forward": raster.forward,
        "slots": raster.number_accumulators,
        "backward + reduce": lambda: raster.backward(adjoint.cotangent),
    }


def compositing_kernels(raster: CpuRaster, adjoint: CpuAdjoint) -> Callable[[], np.ndarray]:
    """ "backward + reduce" of a CPU into arrays that are there already: a call that leaves and returns the moments (n, 9)."""
    lists, splat_start = raster.reached
    sums, moments = (
        aligned((int(splat_start[-1]) * SPLAT,), raster.dtype),
        np.empty((len(raster.splats), SPLAT), raster.dtype),
    )
    arguments = (raster.params, lists, raster.frame, raster.pixels, raster.flat(adjoint.cotangent), sums)

    def backward() -> np.ndarray:
        over_tiles(compositing.backward, *arguments)
        over_range(len(moments), packing.reduce_sums, splat_start, sums, moments)
        return moments

    return backward


def tangent_stages(
    raster: CpuRaster, adjoint: CpuAdjoint, directions: Float[Tensor, "n k 9"], cotangents: Float[Tensor, "k 4 H W"]
) -> tuple[Calls, Callable[[], tuple[np.ndarray, np.ndarray]]]:
    """The last three stages on a CPU, and what they leave, in plain coordinates: the images' changes (k, 3, h, w) and the
    products (n, k, 9).

    directions: plain tangents of the splats; cotangents: tangents of the adjoint's cotangent.
    """
    dtype, size, (lists, splat_start), K = raster.dtype, raster.frame.size, raster.reached, directions.shape[1]
    packed = torch.stack(
        [coefficients_of(raster.splats, each.contiguous()) for each in directions.double().unbind(1)], dim=1
    )
    packed = np.ascontiguousarray(packed.numpy(), dtype)
    planes, transmittances = aligned((K * 4 * size,), dtype), aligned((K * size,), dtype)
    sums, product = aligned((int(splat_start[-1]) * K * SPLAT,), dtype), np.empty_like(packed)
    primal, moments = (raster.params, packed.reshape(-1), lists, raster.frame, raster.pixels), adjoint.moments.numpy()
    v_planes, dv_planes = raster.flat(adjoint.cotangent), raster.flat(cotangents)
    calls: Calls = {
        f"J u {K}": lambda: over_tiles(tangents.tangent, *primal, planes, transmittances),
        f"tangent of backward {K}": lambda: over_tiles(
            tangents.backward_tangent, *primal, v_planes, transmittances, dv_planes, sums
        ),
        f"reduce {K}": lambda: over_range(
            len(packed), packing.reduce_tangents, packed, splat_start, sums, moments, product
        ),
    }

    def left() -> tuple[np.ndarray, np.ndarray]:
        plain = [plain_gradient(raster.splats, each.contiguous()) for each in torch.from_numpy(product).unbind(1)]
        images = raster.crop(torch.from_numpy(planes).view(K, 4, *raster.plane)[:, :3])
        return images.numpy(), torch.stack(plain, dim=1).numpy()

    return calls, left


def pairs_of(raster: Any) -> int:
    """(pixel, Gaussian) pairs that a pass evaluates."""
    if not isinstance(raster, CpuRaster):
        from splat.raster.cuda.binning import HEIGHT, WIDTH

        return raster.intersections_reached * WIDTH * HEIGHT
    packed = raster.reached[0].rows
    rows = ((packed >> 8) & 255) - (packed & 255) + 1
    return int(rows.sum()) * raster.plane[1] // raster.frame.columns
