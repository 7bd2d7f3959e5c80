"""One view held still on the GPU: `linearize.LinearizedView` for tensors there; no product waits for the device.

The pieces are those of the CPU, with the same formulas and the same precisions between them: `projection_cuda.py`,
`raster/cuda.py`, `losses_cuda.py`.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splat.camera import Camera
from splat.gaussians import Gaussians
from splat.linearize import OwnBlocks, rasterize_view
from splat.losses_cuda import CudaViewLoss
from splat.projection_cpu import lens_of
from splat.projection_cuda import CudaProjection
from splat.projection_linear import Held
from splat.raster.cuda import CudaTangent
from splat.raster.formulas import SUMS, TANGENTS
from splat.settings import RenderSettings


class CudaLinearizedView:
    """A view's loss at fixed Gaussians: `.value`, `.image`, `.gradient`, `.jvp(U)`, `.vjp(G)`, `.hvp(U)`, `.ggn(U)`."""

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        loss: CudaViewLoss,
        background: Float[Tensor, "3"],
        settings: RenderSettings = RenderSettings(),
    ):
        self.gaussians = gaussians
        self._raster = rasterize_view(gaussians, camera, background, settings)
        self._loss = loss.linearize(self._raster.planes)
        self._adjoint = self._raster.backward(self._loss.gradient)
        self._index = self._raster.touched
        self._projection = CudaProjection(
            gaussians, lens_of(camera, settings), self._raster.splats, self._adjoint.gradient, self._index
        )

    @property
    def value(self) -> float:
        return self._loss.value

    @property
    def gradient(self) -> Float[Tensor, " p"]:
        """Of the loss; worked out from its adjoint every time, so that a view that is kept does not hold p numbers more."""
        return self._projection.pull(self._adjoint.gradient[:, None], None)[:, 0]

    @property
    def image(self) -> Float[Tensor, "3 h w"]:
        return self._raster.planes[:3].clone()

    @property
    def entries(self) -> int:
        """How many (splat, tile) pairs a product passes over."""
        return self._raster.entries_reached

    @property
    def entries_behind(self) -> int:
        """How many (splat, tile) pairs are left out because every pixel has stopped in front of them."""
        return self._raster.entries - self.entries

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
        adjoint = self._adjoint.gradient.nbytes + self._adjoint.totals.nbytes  # its cotangent is the loss's gradient
        return self._raster.bytes + self._projection.bytes + self._loss.bytes + adjoint

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many vectors takes beside its argument and its result."""
        item, pixels, n = self._raster.dtype.itemsize, self._raster.height * self._raster.width, len(self.gaussians)
        each = item * ((5 + 18) * pixels + SUMS * self._raster.entries + TANGENTS * n) + 8 * (2 * 9 + SUMS) * n
        return vectors * each

    def concerns(self, U: Float[Tensor, "p k"]) -> bool:
        """True: to look whether the vectors move any Gaussian that the view draws would be to wait for the device."""
        return True

    def jvp(self, U: Float[Tensor, "p k"]) -> Float[Tensor, "k 4 h w"]:
        """J U: tangents of colour and accumulated alpha."""
        return self._tangent(U).planes

    def vjp(self, G: Float[Tensor, "k 4 h w"]) -> Float[Tensor, "p k"]:
        """J^T G for cotangents of colour and accumulated alpha."""
        bars = [self._raster.backward(g).gradient for g in G]
        return self._projection.pull(torch.stack(bars, dim=1), None)

    def hvp(self, U: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """H U of the view's loss."""
        return self._projection.pull(self._curved(U), U.detach())

    def ggn(self, U: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """G U, the Gauss-Newton part of H U."""
        return self.vjp(self._loss.hvp(self._tangent(U).planes))

    def block_diagonal(self, *, gauss_newton: bool = False) -> OwnBlocks:
        """Every Gaussian's own block of the Hessian, or of its Gauss-Newton part: see `LinearizedView`."""
        own = self._raster.own_blocks(self._adjoint, self._loss.diagonal, self._index, gauss_newton)
        return OwnBlocks(*self._projection.blocks(own, not gauss_newton))

    def loss_curvatures(self, U: Float[Tensor, "p k"]) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """(J u)^T l'' (J u) of every column, and the same with l'' replaced by its pixel-diagonal: no backward pass."""
        planes = self._tangent(U).planes
        images, products = planes[:, :3].double(), self._loss.hvp(planes)[:, :3]
        full = (images * products).sum(dim=(1, 2, 3))
        return full, (images.square() * self._loss.diagonal).sum(dim=(1, 2, 3))

    def _curved(self, U: Tensor) -> Tensor:
        """The tangent of the splats' adjoint, (n, K, 9); all else that it takes is free again before the result is made."""
        tangent = self._tangent(U)
        return tangent.curvature(self._adjoint, self._loss.hvp(tangent.planes, out=tangent.planes))

    def _tangent(self, U: Tensor) -> CudaTangent:
        return self._raster.jvp(self._projection.jvp(U.detach()))
