"""The photometric loss of one view and its gradient in the stored parameters: one render, one backward pass."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.autograd import Clamped, view_loss
from splat.losses.protocols import ViewLoss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import Splats
from splat.render.render import render


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
    flat = gaussians.flat.detach().requires_grad_()
    rendering = render(gaussians.with_flat(flat), camera, background, settings, opacity_scale=opacity_scale)
    value = view_loss(rendering.image, loss)
    gradient, screen_gradient = torch.autograd.grad(value, [flat, rendering.splats.means])
    return LossAndGradient(value.item(), gradient, screen_gradient, rendering.splats.detach())
