"""The losses of `losses.py` by the kernels, as torch functions and for the second-order renderer.

`loss_against` and `loss_between` alone decide which kernels these are: those where the images are.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.autograd import last_derivative
from splat.backend.device import by_triton
from splat.losses.cpu.loss import NUMPY, CpuImageLoss, CpuViewLoss
from splat.losses.protocols import ImageLoss, ViewLoss
from splat.losses.reference import LossSettings


def loss_against(target: Float[Tensor, "3 h w"], settings: LossSettings, like: Tensor) -> ViewLoss:
    """The loss of images against a target, on the device and in the dtype of the tensor `like`."""
    if by_triton(like):
        from splat.losses.cuda.loss import CudaViewLoss

        return CudaViewLoss(target.to(like.device), settings, like.dtype)
    return CpuViewLoss(target, settings, like.dtype)


def loss_between(image: Float[Tensor, "3 h w"], settings: LossSettings) -> ImageLoss:
    """The loss of two images of the size, dtype and device of this one."""
    if by_triton(image):
        from splat.losses.cuda.loss import CudaImageLoss

        return CudaImageLoss(image.detach(), settings)
    return CpuImageLoss(image.shape, settings, NUMPY[image.dtype])


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, loss: ViewLoss) -> Tensor:
        linear = loss.linearize(loss.padded(image), second_order=False)
        ctx.loss, ctx.gradient = loss, loss.cropped(linear.gradient)
        ctx.save_for_backward(image)
        return linear.scalar(image)

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        return _PhotometricGradient.apply(*ctx.saved_tensors, outputs[0], ctx.loss, ctx.gradient), None


class _PhotometricGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, weight: Tensor, loss: ViewLoss, gradient: Tensor) -> Tensor:
        ctx.loss, ctx.gradient = loss, gradient
        ctx.save_for_backward(image, weight)
        return weight * gradient

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        image, weight = ctx.saved_tensors
        linear = ctx.loss.linearize(ctx.loss.padded(image))
        product = ctx.loss.cropped(linear.hvp(ctx.loss.padded(outputs[0])[None])[0])
        values = (weight.detach() * product, (outputs[0].detach() * ctx.gradient).sum())
        return *last_derivative(values, image, weight, outputs[0]), None, None


@dataclass(frozen=True, eq=False)
class Clamped:
    """A view's loss of the image clamped to [0, 1]: where the image is outside, its gradient is 0."""

    loss: ViewLoss


def view_loss(image: Float[Tensor, "3 h w"], loss: ViewLoss | Clamped) -> Float[Tensor, ""]:
    """The loss of an image as a torch scalar, twice differentiable; loss: from `loss_against`, as it is or clamped."""
    if isinstance(loss, Clamped):
        return view_loss(image.clamp(0, 1), loss.loss)
    return _Photometric.apply(image, loss)  # pyright: ignore[reportReturnType]
