"""The compositing of splats on the CPU: a view held still.

`Raster` has done all that depends on the splats alone (order, tile lists, final transmittances, stops); its methods are
passes over the pixels.  Images are padded planes: (planes, padded height, padded width), whole tiles of `lanes` x TILE_ROWS
pixels; a splat is nine numbers (`packing.py`).
"""

from math import log2

import numpy as np

from splat.backend.cpu.planes import TILE_ROWS, aligned
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import over_range, over_tiles
from splat.model.settings import RenderSettings
from splat.raster.cpu import binning, blocks, compositing, packing, tangents, tile

LEAST_TRANSMITTANCE = {np.dtype(np.float32): 1e-30, np.dtype(np.float64): 1e-290}  # beneath it T would underflow
LEAST_LOG2_ALPHA = {np.dtype(np.float32): -126.0, np.dtype(np.float64): -1022.0}  # the range of exp2


class Raster:
    """One view of one set of splats, composited and held still.

    splats: (n, 9), finite, kept in double precision; depths: (n,) positive where drawn, in the precision of the pixels;
    background: (3,).  With transmittance_min = 0 a pixel still
    stops at LEAST_TRANSMITTANCE, an error of the image far beneath round-off.  entries: how many the tile lists had before
    those that no pixel reaches were dropped.
    """

    def __init__(
        self,
        splats: np.ndarray,
        depths: np.ndarray,
        drawn: np.ndarray,
        background: np.ndarray,
        width: int,
        height: int,
        settings: RenderSettings,
    ):
        splats = np.ascontiguousarray(splats, np.float64)
        self.splats, self.dtype, self.width, self.height = splats, depths.dtype, width, height
        dtype, n = self.dtype, len(splats)
        lanes = lanes_of(dtype)
        self.lists = binning.bin_splats(splats, depths, drawn, width, height, settings)
        self.entries = self.lists.splat.size
        columns, tile_rows = -(-width // lanes), -(-height // TILE_ROWS)
        self.plane = (tile_rows * TILE_ROWS, columns * lanes)
        size = self.plane[0] * self.plane[1]
        scalar = dtype.type
        self.frame = tile.Frame(
            columns,
            self.plane[1],
            size,
            scalar(settings.alpha_max),
            scalar(max(settings.transmittance_min, LEAST_TRANSMITTANCE[dtype])),
            np.ascontiguousarray(background, dtype),
            np.repeat(np.arange(TILE_ROWS, dtype=dtype), lanes),
        )
        self.params = aligned((n * tile.PARAMS,), dtype)
        least = log2(settings.alpha_min) if settings.alpha_min else -np.inf
        contour = np.inf if settings.contour_sigma is None else settings.contour_sigma
        over_range(n, packing.pack_splats, splats, max(least, LEAST_LOG2_ALPHA[dtype]), contour, self.params)
        self.pixels = tile.Pixels(aligned((4 * size,), dtype), aligned((size,), dtype), aligned((size,), dtype))
        over_tiles(compositing.forward, self.params, self.lists, self.frame, self.pixels)
        self._slot_start: np.ndarray | None = None

    @property
    def planes(self) -> np.ndarray:
        """Red, green, blue and accumulated alpha: (4, padded height, padded width)."""
        return self.pixels.planes.reshape(4, *self.plane)

    def crop(self, planes: np.ndarray) -> np.ndarray:
        """A view of padded planes without the padding."""
        return planes[..., : self.height, : self.width]

    def pad(self, planes: np.ndarray) -> np.ndarray:
        """Padded copies of planes, 0 outside the image, so that pixels outside it have no weight in any derivative."""
        padded = aligned((*planes.shape[:-2], *self.plane), self.dtype)
        padded[..., : self.height, : self.width] = planes
        padded[..., self.height :, :] = 0
        padded[..., self.width :] = 0
        return padded

    @property
    def slot_start(self) -> np.ndarray:
        """(n + 1,) where each splat's entries begin among the slots of the sums; drops the entries that no pixel reaches."""
        if self._slot_start is None:
            per_tile = np.diff(self.lists.start)
            tile_rows, lanes = TILE_ROWS, self.plane[1] // self.frame.columns
            stops = self.pixels.stop.reshape(-1, tile_rows, self.frame.columns, lanes).max(axis=(1, 3)).reshape(-1)
            reached = np.minimum(per_tile, stops).astype(np.int64)
            self.lists, self._slot_start = binning.reached_lists(self.lists, reached, len(self.splats))
        return self._slot_start

    @property
    def order(self) -> int:
        """Which splats each tile draws, in which order: the same number for the same lists."""
        return hash(self.lists.splat.tobytes())

    @property
    def entries_reached(self) -> int:
        """How many entries some pixel reaches."""
        return int(self.slot_start[-1])

    @property
    def touched(self) -> np.ndarray:
        """The splats that have entries that some pixel reaches."""
        return np.flatnonzero(np.diff(self.slot_start))

    def dark_tiles(self, adjoint: "Adjoint", curvature: np.ndarray) -> int:
        """How many tiles with entries have no slope and no curvature (as in `gaussian_blocks`) in any pixel."""
        rows, lanes = TILE_ROWS, self.plane[1] // self.frame.columns
        planes = np.concatenate([adjoint.cotangent.reshape(4, *self.plane), curvature])
        lit = (planes != 0).reshape(len(planes), -1, rows, self.frame.columns, lanes).any(axis=(0, 2, 4)).reshape(-1)
        _ = self.slot_start  # drops the entries that no pixel reaches
        return int(((np.diff(self.lists.start) > 0) & ~lit).sum())

    @property
    def bytes(self) -> int:
        """Memory of what is held."""
        held = (self.splats, self.params, *self.lists, *self.pixels, self.slot_start)
        return sum(array.nbytes for array in held)

    def workspace(self, vectors: int) -> int:
        """Bytes that `jvp` and `curvature` of so many directions take, directions and result included."""
        n, pixels = len(self.splats), 5 * self.frame.size
        each = self.dtype.itemsize * (pixels + tile.SUMS * self.entries_reached + tile.TANGENTS * n)
        return vectors * (each + 2 * 9 * 8 * n)

    def backward(self, cotangent: np.ndarray) -> "Adjoint":
        """The gradient in the splats from padded cotangent planes (4, ...)."""
        return Adjoint(self, cotangent)

    def gaussian_blocks(
        self, adjoint: "Adjoint", curvature: np.ndarray, index: np.ndarray, gauss_newton: bool
    ) -> np.ndarray:
        """Own blocks (m, 9, 9) of the splats at index: of the Hessian or of its Gauss-Newton part.

        adjoint: that of the loss's gradient; curvature: the pixel-diagonal of l'', padded planes (3, ...).
        """
        dtype, slot_start = self.dtype, self.slot_start
        sums = aligned((slot_start[-1] * blocks.BLOCK_SUMS,), dtype)
        gradient = np.zeros_like(adjoint.cotangent) if gauss_newton else adjoint.cotangent
        over_tiles(
            blocks.block_moments, self.params, self.lists, self.frame, self.pixels, gradient,
            np.ascontiguousarray(curvature, dtype).reshape(-1), sums,
        )  # fmt: skip
        own = np.empty((index.size, 9, 9))
        over_range(
            index.size,
            blocks.reduce_blocks,
            index,
            self.splats,
            slot_start,
            sums,
            adjoint.moments,
            not gauss_newton,
            own,
        )
        return own

    def jvp(self, directions: np.ndarray) -> "Tangent":
        """J u for directions (n, K, 9) of the splats."""
        return Tangent(self, directions)


class Adjoint:
    """The first-order adjoint of the splats: `gradient` (n, 9), its moments, and the cotangent it came from."""

    def __init__(self, raster: Raster, cotangent: np.ndarray):
        dtype, n, slot_start = raster.dtype, len(raster.splats), raster.slot_start
        self.cotangent = np.ascontiguousarray(cotangent, dtype).reshape(-1)
        sums = aligned((slot_start[-1] * tile.SUMS,), dtype)
        over_tiles(compositing.backward, raster.params, raster.lists, raster.frame, raster.pixels, self.cotangent, sums)
        self.moments, self.gradient = np.empty((n, 3), dtype), np.empty_like(raster.splats)
        over_range(n, packing.reduce_gradient, raster.splats, slot_start, sums, self.moments, self.gradient)

    @property
    def bytes(self) -> int:
        """Memory of what is held beside the cotangent."""
        return self.gradient.nbytes + self.moments.nbytes


class Tangent:
    """J u of K directions: `planes` (K, 4, padded height, padded width), and what the second-order pass needs of it."""

    def __init__(self, raster: Raster, directions: np.ndarray):
        self.raster, self.directions = raster, np.ascontiguousarray(directions, np.float64)
        K, dtype, size = directions.shape[1], raster.dtype, raster.frame.size
        self._packed = aligned((len(directions) * K * tile.TANGENTS,), dtype)
        over_range(len(directions), packing.pack_tangents, raster.splats, self.directions, self._packed)
        _ = raster.slot_start  # drops the entries that no pixel reaches
        planes, self._transmittances = aligned((K * 4 * size,), dtype), aligned((K * size,), dtype)
        over_tiles(
            tangents.tangent, raster.params, self._packed, raster.lists, raster.frame, raster.pixels, planes,
            self._transmittances,
        )  # fmt: skip
        self.planes = planes.reshape(K, 4, *raster.plane)

    def curvature(self, adjoint: Adjoint, cotangents: np.ndarray) -> np.ndarray:
        """The tangent of `Raster.backward` along the directions, (n, K, 9).

        cotangents: padded planes (K, 4, ...), the tangents of the adjoint's cotangent; 0 for the second derivative of R alone.
        """
        raster, K = self.raster, self.directions.shape[1]
        slot_start = raster.slot_start
        sums = aligned((slot_start[-1] * K * tile.SUMS,), raster.dtype)
        over_tiles(
            tangents.curvature, raster.params, self._packed, raster.lists, raster.frame, raster.pixels,
            adjoint.cotangent, self._transmittances, np.ascontiguousarray(cotangents, raster.dtype).reshape(-1), sums,
        )  # fmt: skip
        product = np.empty_like(self.directions)
        over_range(
            len(product),
            packing.reduce_curvature,
            raster.splats,
            self.directions,
            slot_start,
            sums,
            adjoint.moments,
            product,
        )
        return product
