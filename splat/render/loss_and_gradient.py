"""The photometric loss of one view and its gradient in the stored parameters: one pass to the image and one back.

The numbers are those of `torch.autograd.grad` through `render`, to the bit, without torch's graph between.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from splat.losses.autograd import Clamped
from splat.losses.protocols import ViewLoss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.formulas import lens_of
from splat.projection.reference import Splats
from splat.render.backend import backend_of, plain_gradient
from splat.render.forward import background_of

OPACITY = 5  # column of the opacities in splats (n, 9)


@dataclass(frozen=True, eq=False)
class LossAndGradient:
    """gradient: dL / d flat; screen_gradient: dL / d splats.means, per px; all off the autograd graph."""

    loss: float
    gradient: Float[Tensor, " p"]
    screen_gradient: Float[Tensor, "n 2"]
    splats: Splats


class ViewPass:
    """One view, rendered for a gradient: the planes of `raster`, the splats as composited, and the pass back.

    opacity_scale: see `render`.  Raises InputError where a parameter or the background is not finite.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Float[Tensor, "3"],
        settings: RenderSettings = RenderSettings(),
        opacity_scale: Float[Tensor, " n"] | None = None,
    ):
        gaussians.require_finite()
        self._gaussians, self._lens = gaussians.with_flat(gaussians.flat.detach()), lens_of(camera, settings)
        self._backend = backend_of(gaussians.flat)
        self._splats, self._depths, self._drawn = self._backend.project(self._gaussians, self._lens)
        self._opacity_scale = opacity_scale
        shown, size = self._scaled(self._splats), (camera.width, camera.height)
        behind = background_of(gaussians, background)
        self.raster = self._backend.rasterize(shown, self._depths, self._drawn, behind, *size, settings)

    def _scaled(self, numbers: Float[Tensor, "n 9"]) -> Float[Tensor, "n 9"]:
        """Splats, or their plain adjoints, with the opacities' column multiplied by opacity_scale."""
        if self._opacity_scale is None:
            return numbers
        numbers = numbers.clone()
        numbers[:, OPACITY] *= self._opacity_scale.to(numbers)
        return numbers

    @property
    def splats(self) -> Splats:
        means, conics, opacities, colours = self.raster.splats.split((2, 3, 1, 3), dim=1)
        return Splats(means, conics, opacities[:, 0], colours, self._depths, self._drawn)

    def pull_back(self, cotangent: Float[Tensor, "4 H W"]) -> tuple[Float[Tensor, " p"], Float[Tensor, "n 2"]]:
        """The gradients in the stored parameters and in the splats' means, given that in the planes."""
        bar = plain_gradient(self.raster.splats, self.raster.backward(cotangent).moments)
        gradient = self._backend.project_vjp(self._gaussians, self._lens, self._splats, self._drawn, self._scaled(bar))
        return gradient, bar[:, :2]


def loss_and_gradient(
    gaussians: Gaussians,
    camera: Camera,
    loss: ViewLoss | Clamped,
    background: Float[Tensor, "3"],
    settings: RenderSettings = RenderSettings(),
    opacity_scale: Float[Tensor, " n"] | None = None,
) -> LossAndGradient:
    """Loss and gradient of a view; opacity_scale and errors: see `ViewPass`."""
    view = ViewPass(gaussians, camera, background, settings, opacity_scale)
    value, cotangent = _linearized(loss, view.raster.planes)
    gradient, screen_gradient = view.pull_back(cotangent)
    return LossAndGradient(value.item(), gradient, screen_gradient, view.splats)


def _linearized(loss: ViewLoss | Clamped, planes: Float[Tensor, "4 H W"]) -> tuple[Tensor, Float[Tensor, "4 H W"]]:
    """The loss of an image's planes, and its gradient in them."""
    if isinstance(loss, Clamped):
        value, gradient = _linearized(loss.loss, planes.clamp(0, 1))
        return value, gradient * ((planes >= 0) & (planes <= 1))
    linear = loss.linearize(planes, second_order=False)
    return linear.scalar(planes), linear.gradient
