"""DropGaussian: the image of the Gaussians that stay, its schedule and its expectation."""

from dataclasses import replace
from math import sqrt

import pytest
import torch

from splat.render.render import render
from splat.training.loop import train
from splat.training.methods.dropout import DropGaussian, DropGaussianMethod
from splat.training.state import TrainConfig, Training
from tests.splat.photometric import photometric_loss
from tests.splat.tiny import EXTENT, tiny_config, tiny_gaussians, tiny_views, trained


@pytest.fixture
def gains(monkeypatch) -> list[torch.Tensor]:
    """Every gain that a training draws."""
    drawn, draw = [], DropGaussianMethod.opacity_scale
    monkeypatch.setattr(DropGaussianMethod, "opacity_scale", lambda *a: drawn.append(draw(*a)) or drawn[-1])
    return drawn


def test_the_loss_is_of_the_remaining_gaussians_with_raised_opacities(gains):
    start, views = tiny_gaussians(dtype=torch.float64), tiny_views(torch.float64)
    start.opacity_logits.clamp_max_(-0.1)  # raised by 1 / (1 - 0.4) they stay below 1
    training = Training.start(start, EXTENT, TrainConfig(1, seed=1, method=DropGaussian(p_max=0.4)))
    (done,) = train(training, views)
    keep = gains[0] > 0
    assert 0 < keep.sum() < len(start)
    remaining = start.select(keep)
    remaining.opacity_logits.copy_((remaining.opacity_logits.sigmoid() / (1 - 0.4)).logit())
    view = next(view for view in views if view.name == done.view)
    image = render(remaining, view.camera, backend="reference").image
    assert done.loss == pytest.approx(photometric_loss(image, view.image).item(), rel=1e-12)


def test_the_share_grows_in_proportion_to_the_step_up_to_p_max_at_the_last(gains):
    config = replace(tiny_config(6), sh_degree=0, method=DropGaussian(p_max=0.3))
    trained(config, tiny_gaussians(2000))
    assert len(gains) == 6
    for number, gain in enumerate(gains, start=1):
        p = 0.3 * number / 6
        assert torch.unique(gain).tolist() == pytest.approx([0, 1 / (1 - p)], rel=1e-6)
        dropped = (gain == 0).double().mean().item()
        assert abs(dropped - p) < 4 * sqrt(p * (1 - p) / len(gain))


def test_a_gaussian_is_dropped_independently_and_anew_at_each_step(gains):
    trained(TrainConfig(2, method=DropGaussian(p_max=0.5)), tiny_gaussians(4000))
    first, second = ((gain > 0).double() for gain in gains)
    for one, other in [(first, second), (first[1:], first[:-1])]:
        assert abs(torch.corrcoef(torch.stack([one, other]))[0, 1]) < 4 / sqrt(len(one))
