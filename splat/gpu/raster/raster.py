"""The compositing of the splats of one view on a GPU: `render.backend.Raster` by Triton kernels.

Planes have no padding: (planes, height, width), contiguous, in the precision of the pixels (that of `depths`).

Accumulation (`settings.accumulation`) is "deterministic": each intersection has an accumulator for its sums, and these are
added in a fixed order, so every result is the same to the last bit from run to run; or "atomic": sums are added to those of
their splats in whatever order, which is faster and takes less memory.

Two sizes are read back by the constructor, the numbers of strips and of intersections (`binning.py`), for which arrays are
made; no later call waits for the device: there is room for the sums of all intersections, even where no pixel reaches them.
Everything runs on the current stream of the splats' device.
"""

from functools import cached_property
from typing import NoReturn

import torch
import triton
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from landscape.errors import InputError
from splat.gpu.language.compile import launch
from splat.gpu.raster import binning, blocks, compositing, packing
from splat.gpu.raster.binning import HEIGHT, WIDTH, Accumulators, grid
from splat.model.settings import RenderSettings
from splat.render.formulas import SPLAT, thresholds_of

# Tangents that one launch has in registers: with 4, a thread of `backward_tangent` would need more than there are.
TOGETHER = 2
TILE = {"WIDTH": WIDTH, "HEIGHT": HEIGHT}
LAUNCH = {"num_warps": 1}
BLOCK = 128  # splats a program of the kernels that run over splats
SPLATS = {"BLOCK": BLOCK, "num_warps": 4}
ROWS = 2  # splats whose accumulators a program sums
SIDE_BY_SIDE = 256  # numbers of a splat's accumulators that it reads at a time


class CudaRaster:
    """`render.backend.Raster` by Triton kernels."""

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
        self.splats, self.dtype, self.device = splats.double().contiguous(), depths.dtype, splats.device
        self.width, self.height, self.deterministic = width, height, settings.accumulation == "deterministic"
        thresholds = torch.tensor(thresholds_of(settings, self.dtype), dtype=torch.float64)
        shared = (thresholds.to(self.device, non_blocking=True), background.to(self.device, torch.float64))
        self.frame = torch.cat(shared)
        self.lists = self.bin(depths, drawn)
        self.params = self._empty(len(splats), packing.PARAMS)
        self.planes = self._empty(4, height, width)
        self._transmittance, self._stop = self._empty(height, width), self._empty(height, width, dtype=torch.int32)
        self._reached = self._empty(len(self.lists.start) - 1, dtype=torch.int32)
        self.pack()
        self.forward()

    def bin(self, depths: Float[Tensor, " n"], drawn: Bool[Tensor, " n"]) -> binning.Lists:
        """The tile lists."""
        return binning.bin_splats(self.splats, depths, drawn, self.width, self.height, self.frame)

    def pack(self) -> None:
        """The splats as the passes over the pixels read them."""
        n = len(self.splats)
        launch(packing.pack_splats, grid(n, BLOCK), self.splats, self.frame, self.params, n, **SPLATS)

    def forward(self) -> None:
        """The image, and where its pixels stop."""
        self._order = _heaviest_first(self.lists.start.diff())
        self._launch(
            compositing.forward, self.lists.start, self.lists.splat, self.params, self.frame, self.planes,
            self._transmittance, self._stop, self._reached,
        )  # fmt: skip
        self._order = _heaviest_first(self._reached)

    def _empty(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        return torch.empty(shape, dtype=dtype or self.dtype, device=self.device)

    def _launch(self, kernel, *arguments, **constants) -> None:
        """A kernel on every tile, heaviest first."""
        size = (-(-self.width // WIDTH), self.width, self.height)
        launch(kernel, (len(self._order),), self._order, *arguments, *size, **constants, **TILE, **LAUNCH)

    @property
    def intersections(self) -> int:
        """Number of pairs of a splat and a tile in the lists."""
        return len(self.lists.splat)

    @property
    def draw_order(self) -> int:
        numbers = torch.cat([self.lists.start, self.lists.splat]).long()
        place = torch.arange(len(numbers), device=self.device)
        mixed = (numbers + 1) * 0x1E3779B97F4A7C15 ^ place * 0x3F58476D1CE4E5B9
        return int(((mixed ^ (mixed >> 31)) * 0x14D049BB133111EB).sum())

    @cached_property
    def accumulators(self) -> Accumulators:
        """`number_accumulators`, kept from the first pass that sums over pixels on."""
        return self.number_accumulators()

    def number_accumulators(self) -> Accumulators:
        """Places of the sums of the intersections that some pixel reaches."""
        return binning.number_accumulators(self.lists, self._reached)

    @property
    def intersections_reached(self) -> int:
        """Number of intersections that some pixel reaches, read back from the device."""
        return int(self._reached.sum())

    @property
    def pairs(self) -> int:
        return self.intersections_reached * WIDTH * HEIGHT

    @property
    def touched(self) -> Int[Tensor, " m"]:
        """The splats that have intersections that some pixel reaches; reads their number back."""
        kept = binning.kept_intersections(self.lists, self._reached)
        count = torch.zeros(len(self.splats), dtype=torch.int32, device=self.device)
        return count.index_add_(0, self.lists.splat, kept.to(torch.int32)).nonzero()[:, 0]

    def dark_tiles(self, adjoint: "CudaAdjoint", curvature: Float[Tensor, "3 h w"]) -> int:
        """Number of tiles with neither cotangent nor curvature in any pixel, read back from the device."""
        lit = ((adjoint.cotangent != 0).any(0) | (curvature != 0).any(0)).float()
        tiles = torch.nn.functional.max_pool2d(lit[None], (HEIGHT, WIDTH), ceil_mode=True).flatten()
        return int(((self._reached > 0) & (tiles == 0)).sum())

    @property
    def bytes(self) -> int:
        tensors = [self.splats, self.params, *self.lists, self.planes, self._transmittance, self._stop, self._reached]
        tensors += vars(self).get("accumulators", ())
        return sum(tensor.nbytes for tensor in tensors)

    def workspace(self, vectors: int) -> int:
        n, pixels, item = len(self.splats), 5 * self.height * self.width, self.dtype.itemsize
        return vectors * (item * (pixels + SPLAT * (self.intersections + 2 * n)) + (SPLAT * 8 + 1) * n)

    def crop(self, planes: Float[Tensor, "*k h w"]) -> Float[Tensor, "*k h w"]:
        """The planes themselves: they have no padding here."""
        return planes

    def pad(self, planes: Float[Tensor, "*k h w"]) -> Float[Tensor, "*k h w"]:
        """Planes as the kernels take them: contiguous, in the precision of the pixels."""
        return planes.to(self.dtype).contiguous()

    def totals(self, kernel, vectors: int, width: int, *arguments, **constants) -> Float[Tensor, "n vectors width"]:
        """The totals over every splat's intersections of a kernel that leaves `vectors` times `width` sums for each.

        Its first arguments are those of `backward`, its last the sums.
        """
        n, each = len(self.splats), self.deterministic
        sums = self._empty(self.intersections if each else n, vectors, width)
        where = self.accumulators.place if each else self.lists.splat
        self._launch(
            kernel, self.lists.start, self._reached, self.lists.splat, where, self.params, self.frame, self._transmittance,
            self._stop, *arguments, sums if each else sums.zero_(), ATOMIC=not each, **constants,
        )  # fmt: skip
        if not each:
            return sums
        totals = self._empty(n, vectors, width, dtype=torch.float64)
        reduce_sums(self.accumulators.first, self.accumulators.last, sums, totals)
        return totals

    def backward(self, cotangent: Float[Tensor, "4 h w"]) -> "CudaAdjoint":
        return CudaAdjoint(self, cotangent)

    def gaussian_blocks(
        self, adjoint: "CudaAdjoint", curvature: Float[Tensor, "3 h w"], index: Int[Tensor, " m"], gauss_newton: bool
    ) -> Float64[Tensor, "m 9 9"]:
        v_planes = torch.zeros_like(adjoint.cotangent) if gauss_newton else adjoint.cotangent
        totals = self.totals(blocks.block_moments, 1, blocks.BLOCK_SUMS, v_planes, self.pad(curvature))[:, 0]
        return blocks.gaussian_blocks(totals[index], adjoint.moments[index], not gauss_newton)

    def coupled_blocks(self, loss: object, index: Int[Tensor, " m"], space: list[object]) -> NoReturn:
        raise InputError(
            "expected Gaussians on the CPU for exact blocks of a loss with SSIM, got them on a GPU; move them there or ask for "
            "approximate ones"
        )

    def jvp(self, directions: Float[Tensor, "n k 9"]) -> "CudaTangent":
        return CudaTangent(self, directions)


def reduce_sums(first: Int[Tensor, " n"], last: Int[Tensor, " n"], sums: Tensor, totals: Tensor) -> None:
    """totals (n, vectors, width) of the sums (accumulators, vectors, width): those of splat i are first[i] .. last[i] - 1."""
    n, vectors, width = totals.shape
    padded = triton.next_power_of_2(width)
    launch(
        packing.reduce_sums, (*grid(n, ROWS), vectors), first, last, sums, totals, n, vectors,
        WIDTH=width, PADDED=padded, TOGETHER=SIDE_BY_SIDE // padded, BLOCK=ROWS, num_warps=1,
    )  # fmt: skip


def _heaviest_first(work: Int[Tensor, " tiles"]) -> Int[Tensor, " tiles"]:
    """Tiles with the most work first, so that the last programs to start are short."""
    return torch.argsort(work, descending=True, stable=True).to(torch.int32)


class CudaAdjoint:
    """`render.backend.Adjoint`: moments, and the cotangent that they are of."""

    def __init__(self, raster: CudaRaster, cotangent: Float[Tensor, "4 h w"]):
        self.cotangent = raster.pad(cotangent)
        totals = raster.totals(compositing.backward, 1, SPLAT, self.cotangent)
        self.moments: Float[Tensor, "n 9"] = totals[:, 0].to(raster.dtype)

    @property
    def bytes(self) -> int:
        return self.moments.nbytes


class CudaTangent:
    """`render.backend.Tangent`: J u of K tangents, and what the second-order pass needs of it."""

    def __init__(self, raster: CudaRaster, directions: Float[Tensor, "n k 9"]):
        self.raster, self._directions = raster, directions.to(raster.dtype).contiguous()
        K = directions.shape[1]
        moved = (self._directions != 0).any(dim=2).to(torch.int8)
        self.planes: Float[Tensor, "k 4 h w"] = raster._empty(K, 4, raster.height, raster.width)
        self._transmittances = raster._empty(K, raster.height, raster.width)
        self._moves = [raster._empty(len(raster._reached), dtype=torch.int32) for _ in _parts(K)]
        for part, moves in zip(_parts(K), self._moves, strict=True):
            raster._launch(
                compositing.tangent, raster.lists.start, raster._reached, raster.lists.splat, raster.params, raster.frame,
                raster._stop, self._directions, moved, self.planes[part], self._transmittances[part],
                moves, part.start, K, K=part.stop - part.start,
            )  # fmt: skip

    def backward_tangent(self, adjoint: CudaAdjoint, cotangents: Float[Tensor, "k 4 h w"]) -> Float[Tensor, "n k 9"]:
        raster, (n, K) = self.raster, self._directions.shape[:2]
        cotangents, product = raster.pad(cotangents), torch.empty_like(self._directions)
        for moves, part in zip(self._moves, _parts(K), strict=True):
            size = part.stop - part.start
            totals = raster.totals(
                compositing.backward_tangent, size, SPLAT, adjoint.cotangent, self._directions, moves,
                self._transmittances[part], cotangents[part], part.start, K, K=size,
            )  # fmt: skip
            arguments = (self._directions, adjoint.moments, totals, product, n, K, part.start, size)
            launch(packing.reduce_tangents, (*grid(n, BLOCK), size), *arguments, **SPLATS)
        return product


def _parts(K: int) -> list[slice]:
    """K tangents in parts of TOGETHER, the rest in smaller powers of 2."""
    parts, start, size = [], 0, TOGETHER
    while start < K:
        while size > K - start:
            size //= 2
        parts.append(slice(start, start + size))
        start += size
    return parts
