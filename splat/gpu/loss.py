"""The losses on the GPU: the classes of `losses/cpu/loss.py` for tensors there.

Planes are images without padding, (3 or 4, h, w).  Only reading `CudaLinearLoss.value` waits for the device.
"""

from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from triton import cdiv

from splat.gpu import loss_kernels as kernels
from splat.gpu.language.compile import launch
from splat.losses.formulas import KINDS, SECONDS
from splat.losses.protocols import require_planes
from splat.losses.reference import LossSettings, beyond, window

BLOCK = 256


class CudaImageLoss:
    """`losses.protocols.ImageLoss`: the constants, sizes and flags that its kernels take."""

    def __init__(self, image: Float[Tensor, "3 h w"], settings: LossSettings):
        self.like, self.shape = image.new_empty(0), tuple(image.shape[-2:])
        self.pixel, self.structural = settings.pixel_weight / image[:3].numel(), settings.structural(*self.shape)
        self.margin = {"MARGIN": settings.margin}
        numbers = torch.tensor([settings.eps, self.pixel, self.structural], dtype=torch.float64)
        taps = window(torch.float64)
        self.constants = torch.cat([taps, numbers]).to(image, non_blocking=True)
        self.squared = (taps.to(image.dtype) ** 2).to(image, non_blocking=True)
        self.ssim = settings.ssim_weight > 0
        self.which = {"KIND": KINDS[settings.pixel], "SSIM": self.ssim}

    @property
    def couples_pixels(self) -> bool:
        """Whether the loss has second derivatives across pixels."""
        return self.ssim

    @property
    def programs(self) -> int:
        return cdiv(3 * self.shape[0] * self.shape[1], BLOCK)

    def fields(self, *sizes: int) -> Tensor:
        """Uninitialised fields, (..., 3, h, w)."""
        return self.like.new_empty(*sizes, 3, *self.shape)

    def sums(self, *sizes: int) -> Float64[Tensor, "2 *sizes b"]:
        """Zeros for every program's sums of two numbers, such as the pixel loss and 1 - S."""
        return self.like.new_zeros(2, *sizes, self.programs, dtype=torch.float64)

    def total(self, sums: Float64[Tensor, "2 b"]) -> Float64[Tensor, ""]:
        """The loss."""
        pixels, distances = sums.sum(dim=1)
        return self.pixel * pixels + self.structural * distances

    def run(self, kernel, *arguments, vectors: int = 1, **flags) -> None:
        launch(kernel, (self.programs, vectors), *arguments, *self.shape, **flags, BLOCK=BLOCK)

    def padded(self, image: Tensor) -> Tensor:
        return image.detach().to(self.like).contiguous()

    def cropped(self, planes: Tensor) -> Float[Tensor, "3 h w"]:
        return planes[:3]

    def blurred(self, fields: Tensor, taps: Tensor) -> Tensor:
        """Fields (f, 3, h, w) along their rows."""
        out = torch.empty_like(fields)
        self.run(kernels.blur_along, fields, out, taps, vectors=len(fields))
        return out

    def moments_along(self, image: Tensor) -> Tensor:
        """The window's mean and variance along the rows."""
        out = self.fields(2)
        self.run(kernels.moments_along, image, out, self.constants)
        return out

    def fed(self, vectors: Tensor, residual: Tensor, target: Tensor, fields: int) -> Tensor:
        """The first so many of v, r v and (y - c) v of every vector (k, 3 or more, h, w), blurred along the rows."""
        out = self.fields(len(vectors), fields)
        inputs = vectors, vectors.stride(0), residual, target
        self.run(kernels.feed, *inputs, out, self.constants, vectors=len(vectors), FIELDS=fields)
        return out

    def consistency(self, x: Tensor, y: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        sums, slopes = self.sums(), self.like
        if self.ssim:
            r, slopes = x - y, self.fields(4)
            fed, along = self.fed(r[None], r, y, 2), self.moments_along(0.5 * (x + y))
            self.run(kernels.differentiate_pair, fed, along, slopes, sums[1], self.constants, **self.margin)
            slopes = self.blurred(slopes, self.constants)
        in_x, in_y = self.fields(), self.fields()
        self.run(
            kernels.finish_pair, slopes, x, y, in_x, in_y, sums[0], self.constants, **self.which,
        )  # fmt: skip
        return self.total(sums).to(self.like.dtype), (in_x, in_y)


class CudaViewLoss(CudaImageLoss):
    """`losses.protocols.ViewLoss`; what depends on the target alone is computed once."""

    def __init__(self, target: Float[Tensor, "3 h w"], settings: LossSettings, dtype: torch.dtype):
        super().__init__(target.to(dtype), settings)
        self.target, self.moments = self.padded(target), self.like
        if self.ssim:
            along, self.moments = self.moments_along(self.target), self.fields(2)
            self.run(kernels.moments_down, along, self.moments, self.constants)

    def _evaluate(self, image: Tensor, slopes: bool, second: bool) -> tuple[Tensor, ...]:
        """The loss, the gradient, the residual, S's second derivatives and blur(S_p); empty what is not asked for."""
        require_planes(image, self.target)
        residual, sums = image[:3] - self.target, self.sums()
        gradient = self.like.new_zeros(4, *self.shape) if slopes else self.like
        first = bends = sp = self.like
        if self.ssim:
            first, sp = (self.fields(3), self.fields()) if slopes else (first, sp)
            bends = self.fields(SECONDS) if second else bends
            fed = self.fed(residual[None], residual, self.target, 3)
            outputs = first, bends, sums[1]
            flags = {"SLOPES": slopes, "SECOND": second, **self.margin}
            self.run(kernels.differentiate, fed, self.moments, *outputs, self.constants, **flags)
            first = self.blurred(first, self.constants) if slopes else first
        inputs, outputs = (first, residual, self.target), (gradient, sp, sums[0])
        self.run(kernels.finish_gradient, *inputs, *outputs, self.constants, **self.which, SLOPES=slopes)
        return self.total(sums), gradient, residual, bends, sp

    def value(self, image: Tensor) -> float:
        """The loss at an image."""
        return float(self._evaluate(image, slopes=False, second=False)[0])

    def linearize(self, image: Tensor, second_order: bool = True) -> "CudaLinearLoss":
        return CudaLinearLoss(self, *self._evaluate(image, slopes=True, second=second_order))


class CudaLinearLoss:
    """`losses.protocols.LinearLoss`: value, gradient (4, h, w; that of alpha is 0) and Hessian-vector products."""

    def __init__(
        self, loss: CudaViewLoss, total: Tensor, gradient: Tensor, residual: Tensor, second: Tensor, blurred: Tensor
    ):
        self.loss, self.total, self.gradient = loss, total, gradient
        self._residual, self._second, self._blurred = residual, second, blurred

    @property
    def value(self) -> float:
        return float(self.total)

    def scalar(self, like: Tensor) -> Float[Tensor, ""]:
        return self.total.to(like.dtype)

    def hvp(self, tangents: Float[Tensor, "k p h w"], out: Tensor | None = None) -> Float[Tensor, "k 4 h w"]:
        if not self.loss.ssim:
            return self._finish(tangents.contiguous(), self.loss.like, self._blurred, out)
        loss, K, means = self.loss, len(tangents), tangents[:, :3].mean(dim=(2, 3), keepdim=True)
        tangents = tangents[:, :3] - means
        fed, bends = loss.fed(tangents, self._residual, loss.target, 3), loss.fields(K, 3)
        loss.run(kernels.curve, fed, self._second, bends, loss.constants, vectors=K)
        products = self._finish(tangents, bends, self._blurred, out)
        products[:, :3].addcmul_(means, self._uniform)
        return products

    @cached_property
    def _uniform(self) -> Float[Tensor, "3 h w"]:
        """The product of an image of ones, with SSIM."""
        loss, bends = self.loss, self.loss.fields(1, 3)
        edges = (beyond(length).to(loss.constants, non_blocking=True) for length in reversed(loss.shape))
        fed = loss.fed(self._residual[None], self._residual, loss.target, 3)
        loss.run(kernels.differentiate_uniform, fed, loss.moments, *edges, bends, loss.constants, **loss.margin)
        ones = torch.ones_like(self._residual)[None]
        return self._finish(ones, bends, torch.zeros_like(self._blurred), None)[0, :3].contiguous()

    def _finish(
        self, tangents: Tensor, bends: Tensor, blurred_sp: Tensor, out: Tensor | None
    ) -> Float[Tensor, "k 4 h w"]:
        """The products, from S_m', S_p', S_q' of every tangent."""
        loss, K = self.loss, len(tangents)
        blurred = loss.blurred(bends.flatten(0, 1), loss.constants) if loss.ssim else loss.like
        products = self.gradient.new_empty(K, *self.gradient.shape) if out is None else out
        loss.run(
            kernels.finish_product, tangents, tangents.stride(0), blurred, self._residual, loss.target, blurred_sp,
            products, products.stride(0), loss.constants, vectors=K, **loss.which,
        )  # fmt: skip
        products[:, 3] = 0
        return products

    def curvatures(self, tangents: Float[Tensor, "k p h w"]) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        loss, K = self.loss, len(tangents)
        tangents = tangents.contiguous()
        fed, sums = loss.fed(tangents, self._residual, loss.target, 3) if loss.ssim else loss.like, loss.sums(K)
        loss.run(
            kernels.forms, tangents, tangents.stride(0), fed, self._second, self._residual, self._blurred, self.diagonal,
            *sums, loss.constants, vectors=K, **loss.which,
        )  # fmt: skip
        full, pixelwise = sums.sum(dim=2)
        return full, pixelwise

    @property
    def bytes(self) -> int:
        kept = self.gradient, self._residual, self._second, *2 * [self._blurred], self.loss.target, self.loss.moments
        return sum(tensor.nbytes for tensor in kept)

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many tangents takes beside its result: twice nine blurred planes each, and three of it less
        its mean."""
        return vectors * 21 * self.gradient[0].nbytes

    @cached_property
    def diagonal(self) -> Float[Tensor, "3 h w"]:
        loss, diagonal = self.loss, self.loss.fields()
        along = loss.blurred(self._second, loss.squared) if loss.ssim else loss.like
        loss.run(
            kernels.finish_diagonal, along, self._residual, loss.target, self._blurred, diagonal, loss.constants,
            loss.squared, **loss.which,
        )  # fmt: skip
        return diagonal
