"""The losses on the GPU: the classes of `losses_cpu.py` for tensors there.

Planes are images without padding, (3 or 4, h, w).  Only `LinearLoss.value`, where it is read, waits for the device.
"""

from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from triton import cdiv

from splat.backend.gpu.compile import launch
from splat.losses.cuda import kernels
from splat.losses.formulas import CHARBONNIER, L1, L2, SECONDS
from splat.losses.reference import LossSettings, window

KINDS = {"l1": L1, "charbonnier": CHARBONNIER, "l2": L2}
BLOCK = 256
FORMULAS = kernels.FORMULAS


class CudaImageLoss:
    """A loss of images of one size: what its kernels are told."""

    def __init__(self, image: Float[Tensor, "3 h w"], settings: LossSettings):
        self.like, self.settings, self.shape = image.new_empty(0), settings, tuple(image.shape[-2:])
        count = 3 * self.shape[0] * self.shape[1]
        self.pixel, self.structural = settings.pixel_weight / count, settings.ssim_weight / count
        numbers = torch.tensor([settings.eps, self.pixel, self.structural], dtype=torch.float64)
        taps = window(torch.float64)
        self.constants = torch.cat([taps, numbers]).to(image, non_blocking=True)
        self.squared = (taps.to(image.dtype) ** 2).to(image, non_blocking=True)
        self.kind, self.ssim = KINDS[settings.pixel], settings.ssim_weight > 0

    @property
    def programs(self) -> int:
        return cdiv(3 * self.shape[0] * self.shape[1], BLOCK)

    def fields(self, *sizes: int) -> Tensor:
        """Uninitialised fields, (..., 3, h, w)."""
        return self.like.new_empty(*sizes, 3, *self.shape)

    def sums(self, *sizes: int) -> Float64[Tensor, "2 *sizes b"]:
        """Places for every program's sums of two numbers: the pixel loss and 1 - S, say."""
        return self.like.new_zeros(2, *sizes, self.programs, dtype=torch.float64)

    def total(self, sums: Float64[Tensor, "2 b"]) -> Float64[Tensor, ""]:
        """The loss."""
        pixels, distances = sums.sum(dim=1)
        return self.pixel * pixels + self.structural * distances

    def run(self, kernel, *arguments, vectors: int = 1, **flags) -> None:
        launch(kernel, (self.programs, vectors), *arguments, *self.shape, **flags, BLOCK=BLOCK)

    def padded(self, image: Tensor) -> Tensor:
        """An image as the kernels take it."""
        return image.detach().to(self.like).contiguous()

    def cropped(self, planes: Tensor) -> Float[Tensor, "3 h w"]:
        """The first three planes."""
        return planes[:3]

    def blurred(self, fields: Tensor, taps: Tensor) -> Tensor:
        """Fields (f, 3, h, w) along their rows."""
        out = torch.empty_like(fields)
        self.run(kernels.blur_along, fields, out, taps, vectors=len(fields))
        return out

    def moments_along(self, x: Tensor, y: Tensor) -> Tensor:
        """Mean and variance of (x + y) / 2 along the rows."""
        out = self.fields(2)
        self.run(kernels.moments_along, x, y, out, self.constants)
        return out

    def consistency(self, x: Tensor, y: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """The loss between two images, and its gradients in both: `consistency_kernels.py`."""
        sums, slopes = self.sums(), self.like
        if self.ssim:
            fed, slopes = self.fields(2), self.fields(4)
            self.run(kernels.feed_pair, x, y, fed, self.constants)
            along = self.moments_along(x, y)
            self.run(kernels.differentiate_pair, fed, along, slopes, sums[1], self.constants, FORMULAS=FORMULAS)
            slopes = self.blurred(slopes, self.constants)
        in_x, in_y = self.fields(), self.fields()
        self.run(
            kernels.finish_pair, slopes, x, y, in_x, in_y, sums[0], self.constants, KIND=self.kind, SSIM=self.ssim,
            FORMULAS=FORMULAS,
        )  # fmt: skip
        return self.total(sums).to(self.like.dtype), (in_x, in_y)


class CudaViewLoss(CudaImageLoss):
    """The loss of images against one target; what depends on the target alone is computed once."""

    def __init__(self, target: Float[Tensor, "3 h w"], settings: LossSettings, dtype: torch.dtype):
        super().__init__(target.to(dtype), settings)
        self.target, self.moments = self.padded(target), self.like
        if self.ssim:
            along, self.moments = self.moments_along(self.target, self.target), self.fields(2)
            self.run(kernels.moments_down, along, self.moments, self.constants)

    def _start(self, image: Tensor, slopes: bool, second: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The residual, the sums with those of 1 - S, S_m, S_p, S_q (or nothing), and the second derivatives (or nothing)."""
        residual, sums = image[:3] - self.target, self.sums()
        first = self.fields(3) if self.ssim and slopes else self.like
        bends = self.fields(SECONDS) if self.ssim and second else self.like
        if self.ssim:
            fed = self.fields(3)
            self.run(kernels.feed, residual, 0, residual, self.target, fed, self.constants)
            self.run(
                kernels.differentiate, fed, self.moments, first, bends, sums[1], self.constants, SLOPES=slopes,
                SECOND=second, FORMULAS=FORMULAS,
            )  # fmt: skip
        return residual, sums, first, bends

    def _finish(self, residual: Tensor, sums: Tensor, blurred: Tensor, gradient: Tensor, sp: Tensor) -> None:
        """The sums of the pixel loss and, where there is a place for it, the gradient."""
        self.run(
            kernels.finish_gradient, blurred, residual, self.target, gradient, sp, sums[0], self.constants, KIND=self.kind,
            SSIM=self.ssim, SLOPES=gradient.numel() > 0, FORMULAS=FORMULAS,
        )  # fmt: skip

    def value(self, image: Tensor) -> float:
        """The loss at an image."""
        residual, sums, first, _ = self._start(image, slopes=False, second=False)
        self._finish(residual, sums, first, self.like, self.like)
        return float(self.total(sums))

    def linearize(self, image: Tensor, second_order: bool = True) -> "CudaLinearLoss":
        """Value and gradient at an image (at least three planes), and what the Hessian's product needs if second_order."""
        residual, sums, first, second = self._start(image, slopes=True, second=second_order)
        gradient = self.like.new_zeros(4, *self.shape)
        sp = self.fields() if self.ssim else self.like
        blurred = self.blurred(first, self.constants) if self.ssim else self.like
        self._finish(residual, sums, blurred, gradient, sp)
        return CudaLinearLoss(self, self.total(sums), gradient, residual, second, sp)


class CudaLinearLoss:
    """A loss held still at an image: value, gradient (4, h, w; that of alpha is 0) and Hessian-vector products."""

    def __init__(
        self, loss: CudaViewLoss, total: Tensor, gradient: Tensor, residual: Tensor, second: Tensor, blurred: Tensor
    ):
        self.loss, self.total, self.gradient = loss, total, gradient
        self._residual, self._second, self._blurred = residual, second, blurred

    @cached_property
    def value(self) -> float:
        return float(self.total)

    def scalar(self, like: Tensor) -> Float[Tensor, ""]:
        """The value on the device, in the precision of another tensor."""
        return self.total.to(like.dtype)

    def hvp(self, tangents: Float[Tensor, "k p h w"], out: Tensor | None = None) -> Float[Tensor, "k 4 h w"]:
        """l'' v for K tangents (at least three planes each), to out (which may be the tangents themselves)."""
        loss, K = self.loss, len(tangents)
        tangents, blurred = tangents.contiguous(), loss.like
        if loss.ssim:
            fed, bends = self._fed(tangents), loss.fields(K, 3)
            loss.run(kernels.curve, fed, self._second, bends, loss.constants, vectors=K, FORMULAS=FORMULAS)
            blurred = loss.blurred(bends.flatten(0, 1), loss.constants)
        products = self.gradient.new_empty(K, *self.gradient.shape) if out is None else out
        loss.run(
            kernels.finish_product, tangents, tangents.stride(0), blurred, self._residual, loss.target, self._blurred,
            products, products.stride(0), loss.constants, vectors=K, KIND=loss.kind, SSIM=loss.ssim, FORMULAS=FORMULAS,
        )  # fmt: skip
        products[:, 3] = 0
        return products

    def _fed(self, tangents: Float[Tensor, "k p h w"]) -> Float[Tensor, "k 3 3 h w"]:
        """v, r v and (y - c) v of every tangent, blurred along the rows."""
        loss, fed = self.loss, self.loss.fields(len(tangents), 3)
        held = self._residual, loss.target
        loss.run(kernels.feed, tangents, tangents.stride(0), *held, fed, loss.constants, vectors=len(tangents))
        return fed

    def curvatures(self, tangents: Float[Tensor, "k p h w"]) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """v . l'' v for K tangents (at least three planes each), and v . D v with the diagonal D of l''."""
        loss, K = self.loss, len(tangents)
        tangents = tangents.contiguous()
        fed, sums = self._fed(tangents) if loss.ssim else loss.like, loss.sums(K)
        loss.run(
            kernels.forms, tangents, tangents.stride(0), fed, self._second, self._residual, self._blurred, self.diagonal,
            *sums, loss.constants, vectors=K, KIND=loss.kind, SSIM=loss.ssim, FORMULAS=FORMULAS,
        )  # fmt: skip
        full, pixelwise = sums.sum(dim=2)
        return full, pixelwise

    @property
    def bytes(self) -> int:
        """Memory of what is held, the target's included."""
        held = (self.gradient, self._residual, self._second, self._blurred, self.loss.target, self.loss.moments)
        return sum(tensor.nbytes for tensor in held)

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many tangents takes beside its result: two times nine blurred planes each."""
        return vectors * 18 * self.gradient[0].nbytes

    @cached_property
    def diagonal(self) -> Float[Tensor, "3 h w"]:
        """The pixel-diagonal of l''."""
        loss, diagonal = self.loss, self.loss.fields()
        along = loss.blurred(self._second, loss.squared) if loss.ssim else loss.like
        loss.run(
            kernels.finish_diagonal, along, self._residual, loss.target, self._blurred, diagonal, loss.constants,
            loss.squared, KIND=loss.kind, SSIM=loss.ssim, FORMULAS=FORMULAS,
        )  # fmt: skip
        return diagonal
