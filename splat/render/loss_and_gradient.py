"""The photometric loss of one view and its gradient in the stored parameters: one pass to the image and one back.

The numbers are those of `torch.autograd.grad` of `view_loss` through `render`, to the bit, without torch's graph between.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from splat.losses.autograd import Clamped
from splat.losses.protocols import ViewLoss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.dispatch import plain_gradient, projected, projected_vjp
from splat.projection.formulas import lens_of
from splat.projection.reference import Splats
from splat.raster.dispatch import rasterize
from splat.render.forward import background_of

OPACITY = 5  # column of the opacities in splats (n, 9)


@dataclass(frozen=True, eq=False)
class LossAndGradient:
    """gradient: dL / d flat; screen_gradient: dL / d splats.means, per px; all off the autograd graph."""

    loss: float
    gradient: Float[Tensor, " p"]
    screen_gradient: Float[Tensor, "n 2"]
    splats: Splats


def loss_and_gradient(
    gaussians: Gaussians,
    camera: Camera,
    loss: ViewLoss | Clamped,
    background: Float[Tensor, "3"],
    settings: RenderSettings = RenderSettings(),
    opacity_scale: Float[Tensor, " n"] | None = None,
) -> LossAndGradient:
    """Loss and gradient; opacity_scale: see `render`.  Raises ValueError where a parameter is not finite."""
    gaussians.require_finite()
    gaussians, lens = gaussians.with_flat(gaussians.flat.detach()), lens_of(camera, settings)
    splats, depths, drawn = projected(gaussians, lens)
    shown = splats if opacity_scale is None else _scaled(splats, opacity_scale)
    size, background = (camera.width, camera.height), background_of(gaussians, background)
    raster = rasterize(shown, depths, drawn, background, *size, settings)
    value, cotangent = _linearized(loss, raster.planes)
    bar = plain_gradient(shown, raster.backward(cotangent).moments)
    of_splats = bar if opacity_scale is None else _scaled(bar, opacity_scale)
    gradient = projected_vjp(gaussians, lens, splats, drawn, of_splats)
    means, conics, opacities, colours = shown.split((2, 3, 1, 3), dim=1)
    return LossAndGradient(
        value.item(), gradient, bar[:, :2], Splats(means, conics, opacities[:, 0], colours, depths, drawn)
    )


def _scaled(numbers: Float[Tensor, "n 9"], opacity_scale: Float[Tensor, " n"]) -> Float[Tensor, "n 9"]:
    """Splats, or their plain adjoints, with the column of the opacities multiplied."""
    numbers = numbers.clone()
    numbers[:, OPACITY] *= opacity_scale.to(numbers)
    return numbers


def _linearized(loss: ViewLoss | Clamped, planes: Float[Tensor, "4 H W"]) -> tuple[Tensor, Float[Tensor, "4 H W"]]:
    """The loss of an image's planes, and its gradient in them."""
    if isinstance(loss, Clamped):
        value, gradient = _linearized(loss.loss, planes.clamp(0, 1))
        return value, gradient * ((planes >= 0) & (planes <= 1))
    linear = loss.linearize(planes, second_order=False)
    return linear.scalar(planes), linear.gradient
