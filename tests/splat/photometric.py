"""The loss of a view in plain torch: the specification of the loss kernels (`splat/losses/reference.py` has the formulas)."""

from jaxtyping import Float
from torch import Tensor

from splat.losses.reference import LossSettings, PixelLoss, ssim_map


def pixel_loss(image: Tensor, target: Tensor, kind: PixelLoss, eps: float) -> Tensor:
    residual = image - target
    if kind == "l1":
        return residual.abs().mean()
    if kind == "l2":
        return residual.square().mean()
    return (residual.square() + eps * eps).sqrt().mean()


def photometric_loss(
    image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], settings: LossSettings = LossSettings()
) -> Float[Tensor, ""]:
    """The loss of one view, a scalar that torch can differentiate."""
    loss = settings.pixel_weight * pixel_loss(image, target, settings.pixel, settings.eps)
    if settings.ssim_weight:
        height, width = image.shape[1:]
        m, weight = settings.margin, settings.structural(height, width)
        loss = loss + weight * (1 - ssim_map(image, target)[:, m : height - m, m : width - m]).sum()
    return loss
