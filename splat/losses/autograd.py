"""The losses of `reference.py` by the kernels, as torch functions, twice differentiable."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.autograd import last_derivative
from splat.losses.protocols import ViewLoss


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
    """The loss of an image as a torch scalar, twice differentiable; loss: from `Backend.view_loss`, as it is or clamped."""
    if isinstance(loss, Clamped):
        return view_loss(image.clamp(0, 1), loss.loss)
    return _Photometric.apply(image, loss)  # pyright: ignore[reportReturnType]
