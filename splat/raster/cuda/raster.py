"""The compositing of splats on the GPU: a view held still, with the interface of `cpu.Raster` for tensors.

`CudaRaster` has done all that depends on the splats alone (order, tile lists, final transmittances, stops); its methods are
passes over the pixels.  Images are planes without padding, (planes, height, width), contiguous, in the precision of the pixels
(that of `depths`); a splat is nine numbers (`packing.py`), in double precision.

Sums (`settings.sums`) are "ordered": they go through slots and are added in a fixed order, so every result is the same to the
last bit from run to run; or "atomic": entries are added to their splats as they come, which is faster and takes less memory.

Two sizes are read back by the constructor, the numbers of strips and of entries (`cuda_binning`), for which arrays are made;
no later call waits for the device: there is room for the sums of all entries, also of those that no pixel reaches.
Everything runs on the current stream of the splats' device.
"""

from math import inf, log2

import torch
import triton
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splat.backend.gpu.compile import launch
from splat.model.settings import RenderSettings
from splat.raster.cuda import binning as cuda_binning
from splat.raster.cuda import blocks as cuda_blocks
from splat.raster.cuda import compositing as cuda_compositing
from splat.raster.cuda import packing as cuda_packing
from splat.raster.cuda.binning import HEIGHT, WIDTH, Slots, grid

LEAST_TRANSMITTANCE = {torch.float32: 1e-30, torch.float64: 1e-290}  # beneath it T would underflow
LEAST_LOG2_ALPHA = {torch.float32: -126.0, torch.float64: -1022.0}  # the range of exp2
TOGETHER = (
    2  # tangents that one launch has in registers: with 4, a thread of `curvature` would need more than there are
)
TILE = {"WIDTH": WIDTH, "HEIGHT": HEIGHT}
LAUNCH = {"num_warps": 1}
BLOCK = 128  # splats a program of the kernels that run over splats
SPLATS = {"BLOCK": BLOCK, "num_warps": 4}
ROWS = 2  # splats whose slots a program sums
SIDE_BY_SIDE = 256  # numbers of a splat's slots that it reads at a time


class CudaRaster:
    """One view of one set of splats, composited and held still.

    splats: (n, 9), finite, in double precision; depths: (n,) positive where drawn, in the precision of the pixels.  With
    transmittance_min = 0 a pixel still stops at LEAST_TRANSMITTANCE.  planes: red, green, blue and accumulated alpha.
    """

    def __init__(
        self,
        splats: Float[Tensor, "n 9"],
        depths: Float[Tensor, "n"],
        drawn: Bool[Tensor, "n"],
        background: Float[Tensor, "3"],
        width: int,
        height: int,
        settings: RenderSettings,
    ):
        self.splats, self.dtype, self.device = splats.double().contiguous(), depths.dtype, splats.device
        self.width, self.height, self.ordered = width, height, settings.sums == "ordered"
        self.frame = _frame(background, settings, self.dtype, self.device)
        self.lists = cuda_binning.bin_splats(self.splats, depths, drawn, width, height, self.frame)
        self.params = self._empty(len(splats), cuda_packing.PARAMS)
        self.planes = self._empty(4, height, width)
        self._transmittance, self._stop = self._empty(height, width), self._empty(height, width, dtype=torch.int32)
        self._reached = self._empty(len(self.lists.start) - 1, dtype=torch.int32)
        self._slots: Slots | None = None
        self.pack()
        self.forward()

    def pack(self) -> None:
        """The splats as the passes over the pixels read them."""
        n = len(self.splats)
        launch(cuda_packing.pack_splats, grid(n, BLOCK), self.splats, self.frame, self.params, n, **SPLATS)

    def forward(self) -> None:
        """The image, and where its pixels stop."""
        self._order = _heaviest_first(self.lists.start.diff())
        self._launch(
            cuda_compositing.forward, self.lists.start, self.lists.splat, self.params, self.frame, self.planes,
            self._transmittance, self._stop, self._reached,
        )  # fmt: skip
        self._order = _heaviest_first(self._reached)

    def _empty(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        return torch.empty(shape, dtype=dtype or self.dtype, device=self.device)

    def _launch(self, kernel, *arguments, **constants) -> None:
        """A kernel on every tile, heaviest first."""
        columns = -(-self.width // WIDTH)
        programs = (len(self._order),)
        launch(
            kernel, programs, self._order, *arguments, columns, self.width, self.height, **constants, **TILE, **LAUNCH
        )

    @property
    def entries(self) -> int:
        """How many entries the tile lists have: splats in tiles."""
        return len(self.lists.splat)

    @property
    def order(self) -> int:
        """Which splats each tile draws, in which order: the same number for the same lists."""
        splat = self.lists.splat.long()
        mixed = (splat + 1) * 0x1E3779B97F4A7C15 ^ torch.arange(len(splat), device=self.device) * 0x3F58476D1CE4E5B9
        return int(((mixed ^ (mixed >> 31)) * 0x14D049BB133111EB).sum())

    @property
    def slots(self) -> Slots:
        """Where the sums of the entries go that some pixel reaches."""
        if self._slots is None:
            self._slots = self.number_slots()
        return self._slots

    def number_slots(self) -> Slots:
        return cuda_binning.number_slots(self.lists, self._reached)

    @property
    def entries_reached(self) -> int:
        """How many entries some pixel reaches; reads their number back."""
        return int(self._reached.sum())

    @property
    def touched(self) -> Int[Tensor, "m"]:
        """The splats that have entries that some pixel reaches; reads their number back."""
        kept = cuda_binning.kept_entries(self.lists, self._reached)
        count = torch.zeros(len(self.splats), dtype=torch.int32, device=self.device)
        return count.index_add_(0, self.lists.splat, kept.to(torch.int32)).nonzero()[:, 0]

    def dark_tiles(self, adjoint: "CudaAdjoint", curvature: Float[Tensor, "3 h w"]) -> int:
        """How many tiles with entries have neither cotangent nor curvature anywhere; reads their number back."""
        lit = ((adjoint.cotangent != 0).any(0) | (curvature != 0).any(0)).float()
        tiles = torch.nn.functional.max_pool2d(lit[None], (HEIGHT, WIDTH), ceil_mode=True).flatten()
        return int(((self._reached > 0) & (tiles == 0)).sum())

    @property
    def bytes(self) -> int:
        """Memory of what is held."""
        tensors = [self.splats, self.params, *self.lists, self.planes, self._transmittance, self._stop, self._reached]
        tensors += self._slots or ()
        return sum(tensor.nbytes for tensor in tensors)

    def workspace(self, vectors: int) -> int:
        """Bytes that `jvp` and `curvature` of so many directions take, directions and result included."""
        n, pixels, item = len(self.splats), 5 * self.height * self.width, self.dtype.itemsize
        each = item * (pixels + cuda_packing.SUMS * self.entries + cuda_packing.TANGENTS * n)
        return vectors * (each + (2 * 9 + cuda_packing.SUMS) * 8 * n)

    def crop(self, planes: Float[Tensor, "*planes h w"]) -> Float[Tensor, "*planes h w"]:
        """The planes themselves: they have no padding here."""
        return planes

    def pad(self, planes: Float[Tensor, "*planes h w"]) -> Float[Tensor, "*planes h w"]:
        """Planes as the kernels take them: contiguous, in the precision of the pixels."""
        return planes.to(self.dtype).contiguous()

    def totals(self, kernel, vectors: int, width: int, *arguments, **constants) -> Float[Tensor, "n vectors width"]:
        """The totals over every splat's entries of a kernel that leaves `vectors` times `width` sums an entry.

        Its first arguments are those of `backward`, its last the sums.
        """
        n, ordered = len(self.splats), self.ordered
        sums = self._empty(self.entries if ordered else n, vectors, width)
        self._launch(
            kernel, self.lists.start, self._reached, self.lists.splat, self.slots.slot if ordered else self.lists.splat,
            self.params, self.frame, self._transmittance, self._stop, *arguments, sums if ordered else sums.zero_(),
            ATOMIC=not ordered, **constants,
        )  # fmt: skip
        if not ordered:
            return sums
        totals = self._empty(n, vectors, width, dtype=torch.float64)
        sum_slots(self.slots.first, self.slots.last, sums, totals)
        return totals

    def backward(self, cotangent: Float[Tensor, "4 h w"]) -> "CudaAdjoint":
        """The gradient in the splats from cotangent planes."""
        return CudaAdjoint(self, cotangent)

    def gaussian_blocks(
        self, adjoint: "CudaAdjoint", curvature: Float[Tensor, "3 h w"], index: Int[Tensor, "m"], gauss_newton: bool
    ) -> Float[Tensor, "m 9 9"]:
        """Own blocks of the splats at index: of the Hessian or of its Gauss-Newton part.

        adjoint: that of the loss's gradient; curvature: the pixel-diagonal of l''.
        """
        gradient = torch.zeros_like(adjoint.cotangent) if gauss_newton else adjoint.cotangent
        totals = self.totals(cuda_blocks.block_moments, 1, cuda_blocks.BLOCK_SUMS, gradient, self.pad(curvature))[:, 0]
        moments = torch.zeros_like(adjoint.moments) if gauss_newton else adjoint.moments
        return cuda_blocks.gaussian_blocks(self.splats[index], totals[index].double(), moments[index].double())

    def jvp(self, directions: Float[Tensor, "n K 9"]) -> "CudaTangent":
        """J u for directions of the splats."""
        return CudaTangent(self, directions)


def sum_slots(first: Int[Tensor, "n"], last: Int[Tensor, "n"], sums: Tensor, totals: Tensor) -> None:
    """totals (n, vectors, width) of the sums (slots, vectors, width): those of splat i lie at first[i] .. last[i] - 1."""
    n, vectors, width = totals.shape
    padded = triton.next_power_of_2(width)
    launch(
        cuda_packing.sum_slots, (*grid(n, ROWS), vectors), first, last, sums, totals, n, vectors,
        WIDTH=width, PADDED=padded, SLOTS=SIDE_BY_SIDE // padded, BLOCK=ROWS, num_warps=1,
    )  # fmt: skip


def _frame(background: Tensor, settings: RenderSettings, dtype: torch.dtype, device: torch.device) -> Tensor:
    """What all pixels share, in double precision (`cuda_packing`)."""
    least = max(log2(settings.alpha_min) if settings.alpha_min else -inf, LEAST_LOG2_ALPHA[dtype])
    contour = inf if settings.contour_sigma is None else settings.contour_sigma
    free = inf if settings.gradient_through_cap else settings.alpha_max
    floor = max(settings.transmittance_min, LEAST_TRANSMITTANCE[dtype])
    numbers = [settings.alpha_min, contour, least, settings.alpha_max, free, floor]
    shared = torch.tensor(numbers, dtype=torch.float64).to(device, non_blocking=True)
    return torch.cat([shared, background.to(device, torch.float64)])


def _heaviest_first(work: Int[Tensor, "tiles"]) -> Int[Tensor, "tiles"]:
    """Tiles with the most work first, so that the last programs to start are short."""
    return torch.argsort(work, descending=True, stable=True).to(torch.int32)


class CudaAdjoint:
    """The first-order adjoint of the splats: `gradient` (n, 9), `moments` S, Su, Sv (n, 3), and the cotangent it came from."""

    def __init__(self, raster: CudaRaster, cotangent: Float[Tensor, "4 h w"]):
        n, self.cotangent = len(raster.splats), raster.pad(cotangent)
        self.totals = raster.totals(cuda_compositing.backward, 1, cuda_packing.SUMS, self.cotangent)[:, 0]
        self.gradient = torch.empty_like(raster.splats)
        arguments = (raster.splats, self.totals, self.gradient, n)
        launch(cuda_packing.reduce_gradient, grid(n, BLOCK), *arguments, **SPLATS)

    @property
    def bytes(self) -> int:
        """Memory of what is held beside the cotangent."""
        return self.gradient.nbytes + self.totals.nbytes

    @property
    def moments(self) -> Float[Tensor, "n 3"]:
        return self.totals[:, :3]


class CudaTangent:
    """J u of K directions: `planes` (K, 4, h, w), and what the second-order pass needs of it."""

    def __init__(self, raster: CudaRaster, directions: Float[Tensor, "n K 9"]):
        self.raster, self.directions = raster, directions.double().contiguous()
        n, K = directions.shape[:2]
        self.planes = raster._empty(K, 4, raster.height, raster.width)
        self._transmittances = raster._empty(K, raster.height, raster.width)
        self._moves = raster._empty(len(_parts(K)), len(raster._reached), dtype=torch.int32)
        self._packed: list[Tensor] = []
        for part, moves in zip(_parts(K), self._moves, strict=True):
            size = part.stop - part.start
            packed, moved = raster._empty(n, size, cuda_packing.TANGENTS), raster._empty(n, size, dtype=torch.int8)
            arguments = (raster.splats, self.directions, packed, moved, n, K, part.start, size)
            launch(cuda_packing.pack_tangents, (*grid(n, BLOCK), size), *arguments, **SPLATS)
            raster._launch(
                cuda_compositing.tangent, raster.lists.start, raster._reached, raster.lists.splat, raster.params,
                raster.frame, raster._stop, packed, moved, self.planes[part], self._transmittances[part], moves, K=size,
            )  # fmt: skip
            self._packed.append(packed)

    def curvature(self, adjoint: CudaAdjoint, cotangents: Float[Tensor, "K 4 h w"]) -> Float[Tensor, "n K 9"]:
        """The tangent of `CudaRaster.backward` along the directions.

        cotangents: the tangents of the adjoint's cotangent; 0 for the second derivative of the compositing alone.
        """
        raster, (n, K) = self.raster, self.directions.shape[:2]
        cotangents, product = raster.pad(cotangents), torch.empty_like(self.directions)
        for packed, moves, part in zip(self._packed, self._moves, _parts(K), strict=True):
            size = part.stop - part.start
            totals = raster.totals(
                cuda_compositing.curvature, size, cuda_packing.SUMS, adjoint.cotangent, packed, moves,
                self._transmittances[part], cotangents[part], K=size,
            )  # fmt: skip
            arguments = (raster.splats, self.directions, adjoint.totals, totals, product, n, K, part.start, size)
            launch(cuda_packing.reduce_curvature, (*grid(n, BLOCK), size), *arguments, **SPLATS)
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
