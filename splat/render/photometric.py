"""The photometric loss of one view and its gradient in the stored parameters: one render, one backward pass."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.autograd import view_loss
from splat.losses.cpu.loss import ViewLoss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import Splats
from splat.render.render import render


@dataclass(frozen=True, eq=False)
class Photometric:
    """gradient: dL / d flat; screen_gradient: dL / d splats.means, per px; all off the autograd graph."""

    loss: float
    gradient: Float[Tensor, " p"]
    screen_gradient: Float[Tensor, "n 2"]
    splats: Splats


def photometric(
    gaussians: Gaussians,
    camera: Camera,
    loss: ViewLoss,
    background: Float[Tensor, "3"],
    settings: RenderSettings = RenderSettings(),
    opacity_gain: Float[Tensor, " n"] | None = None,
) -> Photometric:
    """Loss and gradient; opacity_gain: see `splat.render.render.render`.  Raises ValueError where a parameter is not finite."""
    flat = gaussians.flat.detach().requires_grad_()
    rendering = render(gaussians.with_flat(flat), camera, background, settings, opacity_gain=opacity_gain)
    value = view_loss(rendering.image, loss)
    gradient, screen_gradient = torch.autograd.grad(value, [flat, rendering.splats.means])
    return Photometric(value.item(), gradient, screen_gradient, rendering.splats.detach())
