"""One view held still: the loss, its gradient, and exact derivatives of first and second order as products with blocks.

Everything that depends on the scene alone is done once: projection with its Jacobian and curvature per Gaussian, order,
tile lists, final transmittances, first-order adjoints, the loss's own derivatives.  Each product is then two passes over
the pixels for K vectors together.  With y the splats, P the projection, R the compositing, g = dl/dI, a = R'(y)^T g:

    gradient  P'^T R'^T g
    J u       R' P' u
    G u       P'^T R'^T l'' R' P' u                                          (Gauss-Newton; l'' may be indefinite: SSIM)
    H u       P'^T [ R'^T l'' R' P' u + (g . R'')(P' u) ] + (a . P'') u

Vectors are columns of (p, K) blocks laid out like `Gaussians.flat`.  The order of the splats, the alpha_min cut, the stop and
the clamps are held fixed; they are piecewise constant.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from splat.camera import Camera
from splat.device import by_triton
from splat.gaussians import Gaussians
from splat.losses_cpu import LinearLoss, ViewLoss
from splat.projection_cpu import lens_of
from splat.projection_linear import Held, Projection, split
from splat.raster.cpu import Adjoint, Raster
from splat.raster.formulas import SUMS, TANGENTS, TILE_ROWS
from splat.raster.functions import held_view, projected
from splat.settings import RenderSettings


def rasterize_view(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, "3"], settings: RenderSettings
) -> Any:
    """Project and composite a view by the kernels where the Gaussians are, without derivatives."""
    gaussians.require_finite()
    splats = projected(gaussians, lens_of(camera, settings))
    background = background.to(gaussians.flat, non_blocking=True)
    return held_view(*splats, background, camera.width, camera.height, settings)


GEOMETRY_COLUMNS = {
    "means": slice(0, 3), "log_scales": slice(3, 6), "quats": slice(6, 10), "opacity_logits": slice(10, 11),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class OwnBlocks:
    """The diagonal blocks of a Hessian that belong to one Gaussian each.

    geometry: over the attributes in GEOMETRY_COLUMNS; sh: the diagonal of the SH block.
    """

    geometry: Float[Tensor, "n 11 11"]
    sh: Float[Tensor, "n k 3"]

    def __add__(self, other: "OwnBlocks") -> "OwnBlocks":
        return OwnBlocks(self.geometry + other.geometry, self.sh + other.sh)

    def __mul__(self, factor: float) -> "OwnBlocks":
        return OwnBlocks(self.geometry * factor, self.sh * factor)

    def traces(self, quats: Float[Tensor, "n 4"] | None = None) -> dict[str, float]:
        """Trace of each attribute's block, summed in double precision; without the radial directions of unit quats."""
        result = {name: float(part.sum()) for name, part in self.diagonals.items()}
        if quats is not None:
            q, columns = quats.double(), GEOMETRY_COLUMNS["quats"]
            result["quats"] -= float(torch.einsum("ni,nij,nj->", q, self.geometry[:, columns, columns].double(), q))
        return result

    @property
    def diagonals(self) -> dict[str, Float64[Tensor, "n ..."]]:
        """The diagonal, attribute by attribute."""
        diagonal = self.geometry.double().diagonal(dim1=1, dim2=2)
        return {**{name: diagonal[:, columns] for name, columns in GEOMETRY_COLUMNS.items()}, "sh": self.sh.double()}


class LinearizedView:
    """A view's loss at fixed Gaussians: `.value`, `.image`, `.gradient`, `.jvp(U)`, `.vjp(G)`, `.hvp(U)`, `.ggn(U)`."""

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        loss: ViewLoss,
        background: Float[Tensor, "3"],
        settings: RenderSettings = RenderSettings(),
    ):
        self.gaussians = gaussians
        self._raster = rasterize_view(gaussians, camera, background, settings)
        self._loss: LinearLoss = loss.linearize(self._raster.planes)
        self._adjoint: Adjoint = self._raster.backward(self._loss.gradient)
        self._index = np.flatnonzero(np.diff(self._raster.slot_start))
        self._projection = Projection(
            gaussians, lens_of(camera, settings), self._raster.splats, self._adjoint.gradient, self._index
        )
        self.value = self._loss.value

    @property
    def gradient(self) -> Float[Tensor, " p"]:
        """Of the loss; worked out from its adjoint every time, so that a view that is kept does not hold p numbers more."""
        return self._pulled(self._adjoint.gradient[:, None], None)[:, 0]

    @property
    def image(self) -> Float[Tensor, "3 h w"]:
        return torch.from_numpy(self._raster.crop(self._raster.planes[:3]).copy())

    @property
    def entries(self) -> int:
        """How many (splat, tile) pairs a product passes over."""
        return int(self._raster.slot_start[-1])

    @property
    def entries_behind(self) -> int:
        """How many (splat, tile) pairs are left out because every pixel has stopped in front of them."""
        return self._raster.listed - self.entries

    @property
    def dark_tiles(self) -> int:
        """How many tiles with entries are left out of products: the loss has neither slope nor curvature all over them."""
        raster = self._raster
        rows, lanes = TILE_ROWS, raster.plane[1] // raster.frame.columns
        planes = np.concatenate([self._adjoint.cotangent.reshape(4, *raster.plane), self._loss.diagonal])
        lit = (planes != 0).reshape(len(planes), -1, rows, raster.frame.columns, lanes).any(axis=(0, 2, 4)).reshape(-1)
        _ = raster.slot_start  # entries that no pixel reaches are dropped by now
        return int(((np.diff(raster.lists.start) > 0) & ~lit).sum())

    @property
    def touched(self) -> int:
        """How many Gaussians reach a tile of this view before its pixels stop."""
        return len(self._index)

    @property
    def held(self) -> Held:
        """The projection's derivatives, Gaussian by Gaussian."""
        return self._projection.held

    @property
    def bytes(self) -> int:
        """Memory of what is held for the products."""
        adjoint = self._adjoint.gradient.nbytes + self._adjoint.moments.nbytes  # its cotangent is the loss's gradient
        return self._raster.bytes + self._projection.bytes + self._loss.bytes + adjoint

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many vectors takes beside its argument, its result and the loss's few rows a thread."""
        item, planes, n = self._raster.dtype.itemsize, self._raster.frame.size, len(self.gaussians)
        each = item * (5 * planes + SUMS * self.entries + TANGENTS * n) + 8 * 2 * 9 * n
        return vectors * each + item * 3 * planes

    def concerns(self, U: Float[Tensor, "p k"]) -> bool:
        """Whether a vector moves any Gaussian that the view draws: where none does, all products are 0."""
        parts = split(_block(U), len(self.gaussians), self.gaussians.sh_degree)
        return any(part[self._index].any() for part in parts)

    def jvp(self, U: Float[Tensor, "p k"]) -> Float[Tensor, "k 4 h w"]:
        """J U: tangents of colour and accumulated alpha."""
        planes = self._raster.jvp(self._projection.jvp(_block(U))).planes
        return torch.from_numpy(self._raster.crop(planes).copy())

    def vjp(self, G: Float[Tensor, "k 4 h w"]) -> Float[Tensor, "p k"]:
        """J^T G for cotangents of colour and accumulated alpha."""
        bars = [self._raster.backward(self._raster.pad(g.numpy())).gradient for g in G]
        return self._pulled(np.stack(bars, axis=1), None)

    def hvp(self, U: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """H U of the view's loss."""
        block = _block(U)
        return self._pulled(self._curved(block), block)

    def ggn(self, U: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """G U, the Gauss-Newton part of H U."""
        tangent = self._raster.jvp(self._projection.jvp(_block(U)))
        cotangents = self._loss.hvp(tangent.planes)
        bars = [self._raster.backward(cotangent).gradient for cotangent in cotangents]
        return self._pulled(np.stack(bars, axis=1), None)

    def block_diagonal(self, *, gauss_newton: bool = False) -> "OwnBlocks":
        """Every Gaussian's own block of the Hessian, or of its Gauss-Newton part, exactly, in one pass over the pixels.

        "Exactly" for losses that are sums over pixels; of SSIM's l'' the coupling between pixels is left out.
        """
        own = self._raster.own_blocks(self._adjoint, self._loss.diagonal, self._index, gauss_newton)
        n, bands = len(self.gaussians), self.gaussians.sh.shape[1]
        dtype = self._raster.dtype
        geometry, sh = np.zeros((n, 11, 11), dtype), np.zeros((n, bands, 3), dtype)
        self._projection.add_blocks(own, not gauss_newton, geometry, sh)
        return OwnBlocks(torch.from_numpy(geometry), torch.from_numpy(sh))

    def loss_curvatures(self, U: Float[Tensor, "p k"]) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """(J u)^T l'' (J u) of every column, and the same with l'' replaced by its pixel-diagonal: no backward pass."""
        planes = self._raster.jvp(self._projection.jvp(_block(U))).planes
        products, images = self._loss.hvp(planes)[:, :3], self._raster.crop(planes[:, :3])
        weighted = self._raster.crop(self._loss.diagonal) * images
        full = np.einsum("kchw,kchw->k", images, self._raster.crop(products), dtype=np.float64)
        pixelwise = np.einsum("kchw,kchw->k", images, weighted, dtype=np.float64)
        return torch.from_numpy(full), torch.from_numpy(pixelwise)

    def _curved(self, block: np.ndarray) -> np.ndarray:
        """The tangent of the splats' adjoint, (n, K, 9); all else that it takes is free again before the result is made."""
        tangent = self._raster.jvp(self._projection.jvp(block))
        cotangents = self._loss.hvp(tangent.planes, out=tangent.planes)
        return tangent.curvature(self._adjoint, cotangents)

    def _pulled(self, cotangents: np.ndarray, block: np.ndarray | None) -> Tensor:
        out = np.zeros((self.gaussians.flat.numel(), cotangents.shape[1]), self._raster.dtype)
        self._projection.pull(cotangents, block, out)
        return torch.from_numpy(out)


def hold(
    gaussians: Gaussians, camera: Camera, loss: Any, background: Float[Tensor, "3"], settings: RenderSettings
) -> Any:
    """A view held still where its Gaussians are: a `LinearizedView` or a `CudaLinearizedView`, of one interface."""
    if by_triton(gaussians.flat):
        from splat.linearize_cuda import CudaLinearizedView

        return CudaLinearizedView(gaussians, camera, loss, background, settings)
    return LinearizedView(gaussians, camera, loss, background, settings)


def touches(raster: Any) -> Bool[Tensor, " n"]:
    """Which splats have any weight in any pixel of the image: the exact support of the view's derivatives."""
    if isinstance(raster, Raster):
        ones = raster.pad(np.ones((4, raster.height, raster.width), raster.dtype))
        return torch.from_numpy(raster.backward(ones).gradient[:, 6] != 0)
    return raster.backward(torch.ones_like(raster.planes)).gradient[:, 6] != 0


def order_of(raster: Any) -> int:
    """Which splats each tile draws, in which order: the same number for the same lists."""
    if isinstance(raster, Raster):
        return hash(raster.lists.splat.tobytes())
    splat = raster.lists.splat.long()
    mixed = (splat + 1) * 0x1E3779B97F4A7C15 ^ torch.arange(len(splat), device=splat.device) * 0x3F58476D1CE4E5B9
    return int(((mixed ^ (mixed >> 31)) * 0x14D049BB133111EB).sum())


def _block(U: Tensor) -> np.ndarray:
    return np.ascontiguousarray(U.detach().numpy())
