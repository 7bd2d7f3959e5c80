"""The gradient of a training's step is that of torch through the render, to the bit."""

import pytest
import torch

from splat.losses.autograd import Clamped, view_loss
from splat.losses.reference import LossSettings
from splat.model.settings import RenderSettings
from splat.render.backend import backend_of
from splat.render.loss_and_gradient import loss_and_gradient
from splat.render.render import render
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import filtered, random_gaussians
from tests.splat.tolerances import DTYPES


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("clamped", [False, True])
@pytest.mark.parametrize("antialias", ["none", "mip", "mip-splatting"])
def test_loss_and_gradients_are_those_of_torch_through_the_render(antialias, clamped, scaled, dtype):
    gaussians, view = filtered(random_gaussians(60, 2), antialias).to(dtype), two_views()[0]
    gaussians.sh[:20, 0] += 3.0  # too bright
    gaussians.means[0, 2] = -1.0  # behind the camera
    scale = torch.linspace(0, 1.5, 60) if scaled else None
    settings, background = RenderSettings(antialias=antialias), BACKGROUND.to(dtype)
    loss = backend_of(gaussians.flat).view_loss(view.image, LossSettings("charbonnier"), gaussians.flat)
    loss = Clamped(loss) if clamped else loss
    flat = gaussians.flat.clone().requires_grad_()
    drawn = render(gaussians.with_flat(flat), view.camera, background, settings, opacity_scale=scale)
    assert (drawn.image > 1).any() and (drawn.image < 1).any()
    value = view_loss(drawn.image, loss)
    gradient, screen_gradient = torch.autograd.grad(value, [flat, drawn.splats.means])
    found = loss_and_gradient(gaussians, view.camera, loss, background, settings, scale)
    assert found.loss == value.item() and gradient.any()
    assert torch.equal(found.gradient, gradient) and torch.equal(found.screen_gradient, screen_gradient)
    for name, number in vars(drawn.splats.detach()).items():
        assert torch.equal(getattr(found.splats, name), number), name
