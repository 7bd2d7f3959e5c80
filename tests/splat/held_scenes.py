"""Small scenes of two views, and their loss and its derivatives by the specification in float64."""

from collections.abc import Sequence

import torch
from torch import Tensor

from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.render import render
from splat.scenes.view import View
from tests.splat.photometric import photometric_loss
from tests.splat.random_scenes import random_camera

BACKGROUND = torch.tensor([0.2, 0.5, 0.875], dtype=torch.float64)


def two_views(width: int = 30, height: int = 22) -> list[View]:
    """Cameras apart from each other, random pictures."""
    generator = torch.Generator().manual_seed(0)
    views = [(str(seed), random_camera(width, height, seed=seed, focal=28.0)) for seed in (1, 2)]
    return [View(name, camera, torch.rand(3, height, width, generator=generator)) for name, camera in views]


def mean_loss(
    gaussians: Gaussians, views: Sequence[View], loss: LossSettings, settings: RenderSettings = RenderSettings()
) -> Tensor:
    """The specification's loss of the views, with its regularisers of all the Gaussians."""
    images = [render(gaussians, view.camera, BACKGROUND, settings, backend="reference").image for view in views]
    losses = [photometric_loss(image, view.image.double(), loss) for image, view in zip(images, views, strict=True)]
    opacity, scale = gaussians.opacity_logits.sigmoid().mean(), gaussians.log_scales.exp().mean()
    return torch.stack(losses).mean() + loss.opacity_reg * opacity + loss.scale_reg * scale


def gradient_and_products(
    gaussians: Gaussians,
    views: Sequence[View],
    loss: LossSettings,
    U: Tensor,
    settings: RenderSettings = RenderSettings(),
) -> tuple[Tensor, Tensor]:
    """The specification's gradient and H U."""
    flat = gaussians.flat.clone().requires_grad_()
    value = mean_loss(gaussians.with_flat(flat), views, loss, settings)
    (gradient,) = torch.autograd.grad(value, flat, create_graph=True)
    columns = [torch.autograd.grad((gradient * u).sum(), flat, retain_graph=True)[0] for u in U.T]
    return gradient.detach(), torch.stack(columns, dim=1)
