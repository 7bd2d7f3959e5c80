"""Compositing of the splats of one view on the CPU: `render.backend.Raster` by Numba kernels on NumPy views of tensors.

Planes are padded to whole tiles.  An intersection is a splat in a tile.  Tiles, and arrays of the kernels, such as `params` and
the accumulators: `tile.py`.
"""

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from splat.backend.cpu.memory import PIXEL_ROWS, TILE_HEIGHT, aligned
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import LIGHT, over_range, over_tiles
from splat.losses.cpu.loss import CpuLinearLoss
from splat.model.settings import RenderSettings
from splat.render.cpu import binning, blocks, compositing, coupling, footprints, packing, tangents, tile
from splat.render.formulas import SPLAT, thresholds_of

FOOTPRINT_BYTES = 1 << 28  # most memory for footprints of splats at a time


class CpuRaster:
    """`render.backend.Raster` on the CPU; lists: the splats of each tile; plane: size of a padded plane (rows, columns)."""

    def __init__(
        self,
        splats: Float64[Tensor, "n 9"],
        depths: Float[Tensor, " n"],
        drawn: Bool[Tensor, " n"],
        background: Float[Tensor, "3"],
        width: int,
        height: int,
        settings: RenderSettings,
    ):
        self.splats, self.width, self.height = splats.double().contiguous(), width, height
        self.dtype, self.thresholds = depths.numpy().dtype, thresholds_of(settings, depths.dtype)
        self.lists = self.bin(depths, drawn)
        self.intersections = self.lists.splat.size
        lanes, scalar, limits = lanes_of(self.dtype), self.dtype.type, self.thresholds
        across, columns, tile_rows = tile.grid_of(width, height, lanes)
        self.plane = (tile_rows * TILE_HEIGHT, columns * across)
        size = self.plane[0] * self.plane[1]
        self.frame = tile.Frame(
            width, height, columns, self.plane[1], size, scalar(limits.alpha_max), scalar(limits.free), scalar(limits.floor),
            np.ascontiguousarray(background.numpy(), self.dtype),
            np.repeat(np.arange(0, TILE_HEIGHT, PIXEL_ROWS, dtype=self.dtype), lanes),
        )  # fmt: skip
        self.params = aligned((len(splats) * tile.PARAMS,), self.dtype)
        planes, last, stop = (aligned((count * size,), self.dtype) for count in (4, 1, 1))
        self.pixels = tile.Pixels(planes, last, stop, np.empty(columns * tile_rows, np.int64))
        self.pack()
        self.forward()

    def bin(self, depths: Float[Tensor, " n"], drawn: Bool[Tensor, " n"]) -> tile.Lists:
        """The tile lists."""
        size = (self.width, self.height)
        return binning.bin_splats(self.splats.numpy(), depths.numpy(), drawn.numpy(), *size, self.thresholds)

    def pack(self) -> None:
        """Fill `params`, the splats as the passes over the pixels read them."""
        arguments = (self.splats.numpy(), self.thresholds.least, self.thresholds.contour, self.params)
        over_range(len(self.splats), packing.pack_splats, *arguments, least=LIGHT)

    def forward(self) -> None:
        """Fill `pixels`: the image, and where its pixels stop."""
        over_tiles(compositing.forward, self.params, self.lists, self.frame, self.pixels)

    @property
    def planes(self) -> Float[Tensor, "4 H W"]:
        """Red, green, blue and accumulated alpha."""
        return torch.from_numpy(self.pixels.planes).view(4, *self.plane)

    def crop(self, planes: Float[Tensor, "*k H W"]) -> Float[Tensor, "*k h w"]:
        return planes[..., : self.height, : self.width]

    def pad(self, planes: Float[Tensor, "*k h w"]) -> Float[Tensor, "*k H W"]:
        padded = aligned((*planes.shape[:-2], *self.plane), self.dtype)
        padded[..., : self.height, : self.width] = planes.numpy()
        padded[..., self.height :, :] = 0
        padded[..., self.width :] = 0
        return torch.from_numpy(padded)

    @cached_property
    def reached(self) -> tuple[tile.Lists, np.ndarray]:
        """`number_accumulators`, kept from the first pass that sums over pixels on."""
        return self.number_accumulators()

    def number_accumulators(self) -> tuple[tile.Lists, np.ndarray]:
        """The intersections that some pixel reaches, and (n + 1,) the first accumulator of each splat."""
        return binning.reached_lists(self.lists, self.pixels.reached, len(self.splats))

    @property
    def draw_order(self) -> int:
        return hash((self.lists.start.tobytes(), self.lists.splat.tobytes()))

    @property
    def intersections_reached(self) -> int:
        return int(self.reached[1][-1])

    @property
    def pairs(self) -> int:
        packed = self.reached[0].rows  # the first and the last row of each splat in its tile, a byte each
        rows = ((packed >> 8) & 255) - (packed & 255) + 1
        return int(rows.sum()) * lanes_of(self.dtype)

    @property
    def touched(self) -> Int[Tensor, " m"]:
        return torch.from_numpy(np.flatnonzero(np.diff(self.reached[1])))

    def dark_tiles(self, adjoint: "CpuAdjoint", curvature: Float[Tensor, "3 H W"]) -> int:
        planes = torch.cat([adjoint.cotangent, curvature]).numpy()
        # planes, rows of tiles, rows of a tile, tiles in a row, pixels in a row of a tile
        shape = len(planes), -1, TILE_HEIGHT, self.frame.columns, self.plane[1] // self.frame.columns
        lit = (planes != 0).reshape(shape).any(axis=(0, 2, 4)).reshape(-1)
        return int(((np.diff(self.reached[0].start) > 0) & ~lit).sum())

    @property
    def bytes(self) -> int:
        lists, splat_start = self.reached
        arrays = (self.splats, self.params, *self.lists, *lists, *self.pixels, splat_start)
        return sum(array.nbytes for array in arrays)

    def workspace(self, vectors: int) -> int:
        n, pixels = len(self.splats), 5 * self.frame.size
        return vectors * self.dtype.itemsize * (pixels + SPLAT * (self.intersections_reached + 2 * n))

    def backward(self, cotangent: Float[Tensor, "4 H W"]) -> "CpuAdjoint":
        return CpuAdjoint(self, cotangent)

    def gaussian_blocks(
        self, adjoint: "CpuAdjoint", curvature: Float[Tensor, "3 H W"], index: Int[Tensor, " m"], gauss_newton: bool
    ) -> Float64[Tensor, "m 9 9"]:
        (lists, splat_start), found = self.reached, np.empty((len(index), SPLAT, SPLAT))
        sums = aligned((splat_start[-1] * blocks.BLOCK_SUMS,), self.dtype)
        v_planes = torch.zeros_like(adjoint.cotangent) if gauss_newton else adjoint.cotangent
        planes = (self.flat(v_planes), self.flat(curvature))
        over_tiles(blocks.block_moments, self.params, lists, self.frame, self.pixels, *planes, sums)
        moments = adjoint.moments.numpy()
        over_range(len(index), blocks.reduce_blocks, index.numpy(), splat_start, sums, moments, not gauss_newton, found)
        return torch.from_numpy(found)

    def coupled_blocks(
        self, loss: CpuLinearLoss, index: Int[Tensor, " m"], space: list[np.ndarray]
    ) -> tuple[Float[Tensor, "3 H W"], Float64[Tensor, "m 9 9"]]:
        """Footprints are kept for as many splats at a time as FOOTPRINT_BYTES allow, but for one at least."""
        coupled = loss.coupling()
        (lists, splat_start), splats = self.reached, index.numpy()
        blocks = np.zeros((len(splats), SPLAT, SPLAT))
        layout, row = footprints.footprints_of(lists, splat_start), footprints.FOOTPRINT * lanes_of(self.dtype)
        ends, start = layout.place[splat_start[splats + 1]], 0
        most = max(FOOTPRINT_BYTES // (row * self.dtype.itemsize), 1)
        while start < len(splats):
            begin = splat_start[splats[start]]
            stop = max(int(np.searchsorted(ends, layout.place[begin] + most, side="right")), start + 1)
            end = splat_start[splats[stop - 1] + 1]
            size = int(layout.place[end] - layout.place[begin]) * row
            if not space or space[0].size < size:
                space[:] = [aligned((max(size, most * row),), self.dtype)]  # pages count once they are written
            view = (self.params, lists, self.frame, self.pixels)
            over_tiles(footprints.find_footprints, *view, layout, begin, end, space[0])
            # neighbours one after the other: the pixels under them stay in the cache
            order = start + np.argsort(layout.tiles[splat_start[splats[start:stop]]], kind="stable")
            over_tiles(
                coupling.coupled_blocks, order, splats, self.params, self.frame, (layout, begin, space[0]), *coupled[:3],
                blocks,
            )  # fmt: skip
            start = stop
        return torch.from_numpy(coupled.uncoupled).view(3, *self.plane), torch.from_numpy(blocks)

    def neighbours(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Each intersection's splat; the number of pixels in which it has weight; the splat directly in front of it.

        In front: of the tile's splats with weight in one of these pixels, the last one before it; -1 where there is none.
        """
        lists = self.reached[0]
        covered, before = np.empty((2, lists.splat.size), np.int32)
        over_tiles(footprints.find_neighbours, self.params, lists, self.frame, self.pixels, covered, before)
        return lists.splat, covered, before

    def jvp(self, directions: Float[Tensor, "n k 9"]) -> "CpuTangent":
        return CpuTangent(self, directions)

    def flat(self, planes: Float[Tensor, "..."]) -> np.ndarray:
        """Planes as the kernels take them."""
        return np.ascontiguousarray(planes.numpy(), self.dtype).reshape(-1)


class CpuAdjoint:
    """`render.backend.Adjoint` on the CPU."""

    def __init__(self, raster: CpuRaster, cotangent: Float[Tensor, "4 H W"]):
        lists, splat_start = raster.reached
        self.cotangent = cotangent
        sums = aligned((splat_start[-1] * SPLAT,), raster.dtype)
        arguments = (raster.params, lists, raster.frame, raster.pixels, raster.flat(cotangent), sums)
        over_tiles(compositing.backward, *arguments)
        moments = np.empty((len(raster.splats), SPLAT), raster.dtype)
        over_range(len(moments), packing.reduce_sums, splat_start, sums, moments)
        self.moments: Float[Tensor, "n 9"] = torch.from_numpy(moments)

    @property
    def bytes(self) -> int:
        return self.moments.nbytes


class CpuTangent:
    """`render.backend.Tangent` on the CPU; keeps the tangents of the final transmittances for `backward_tangent`."""

    def __init__(self, raster: CpuRaster, tangents_of_splats: Float[Tensor, "n k 9"]):
        self.raster, self._directions = raster, np.ascontiguousarray(tangents_of_splats.numpy(), raster.dtype)
        K, size = self._directions.shape[1], raster.frame.size
        planes, self._transmittances = (aligned((K * count * size,), raster.dtype) for count in (4, 1))
        over_tiles(
            tangents.tangent, raster.params, self._directions.reshape(-1), raster.reached[0], raster.frame, raster.pixels,
            planes, self._transmittances,
        )  # fmt: skip
        self.planes: Float[Tensor, "k 4 H W"] = torch.from_numpy(planes).view(K, 4, *raster.plane)

    def backward_tangent(self, adjoint: CpuAdjoint, cotangents: Float[Tensor, "k 4 H W"]) -> Float[Tensor, "n k 9"]:
        raster, (lists, splat_start) = self.raster, self.raster.reached
        n, K = self._directions.shape[:2]
        sums = aligned((splat_start[-1] * K * SPLAT,), raster.dtype)
        over_tiles(
            tangents.backward_tangent, raster.params, self._directions.reshape(-1), lists, raster.frame, raster.pixels,
            raster.flat(adjoint.cotangent), self._transmittances, raster.flat(cotangents), sums,
        )  # fmt: skip
        product = np.empty_like(self._directions)
        arguments = (self._directions, splat_start, sums, adjoint.moments.numpy(), product)
        over_range(n, packing.reduce_tangents, *arguments)
        return torch.from_numpy(product)
