"""The random dropout regularisation of DropoutGS against one autograd expression."""

import pytest
import torch

from splat.losses.cpu.loss import ViewLoss
from splat.losses.reference import photometric_loss
from splat.render.loss_and_gradient import loss_and_gradient
from splat.render.render import render
from splat.training.methods import dropoutgs
from splat.training.methods.dropoutgs import DropoutGS
from splat.training.state import Step, TrainConfig, Training
from tests.splat.tiny import EXTENT, tiny_gaussians, tiny_views


def test_the_gradient_is_that_of_the_loss_and_the_agreement_with_the_gaussians_that_stay(monkeypatch):
    masks, draw = [], dropoutgs.dropout
    monkeypatch.setattr(dropoutgs, "dropout", lambda *a: masks.append(draw(*a)) or masks[-1])
    views, config = tiny_views(torch.float64), TrainConfig(10, method=DropoutGS(p=0.5, weight=0.3))
    training = Training.start(tiny_gaussians(sh_degree=1, dtype=torch.float64), EXTENT, config)
    background = torch.tensor([0.2, 0.4, 0.1], dtype=torch.float64)
    loss = ViewLoss.of(views[1].image, config.loss, torch.float64)
    step = Step(1, training, training.gaussians, views, 1, background, loss)
    base = loss_and_gradient(step.gaussians, step.camera, step.loss, step.background)
    gradient = training.regularizer.gradient(step, base)

    stays = masks[0].nonzero()[:, 0]
    assert 0 < len(stays) < len(step.gaussians)
    flat = step.gaussians.flat.detach().requires_grad_()
    gaussians = step.gaussians.with_flat(flat)
    whole, dropped = (
        render(these, step.camera, background, backend="reference").image
        for these in (gaussians, gaussians.select(stays))
    )
    total = photometric_loss(whole, views[1].image) + 0.3 * photometric_loss(whole, dropped)
    (expected,) = torch.autograd.grad(total, flat)
    assert (gradient - expected).norm() < 1e-10 * expected.norm()


@pytest.mark.parametrize("settings", [{"p": 0.0}, {"p": 1.0}, {"weight": 0.0}, {"weight": float("inf")}])
def test_settings_of_dropoutgs_that_make_no_sense_are_refused(settings):
    with pytest.raises(ValueError, match="p above 0 and below 1 and a finite weight above 0"):
        DropoutGS(**settings)
