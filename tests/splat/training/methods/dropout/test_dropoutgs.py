"""The random dropout regularisation of DropoutGS against one autograd expression."""

from dataclasses import replace

import pytest
import torch

from splat.losses.cpu.loss import CpuViewLoss
from splat.losses.reference import LossSettings, photometric_loss
from splat.render.loss_and_gradient import loss_and_gradient
from splat.render.render import render
from splat.training.methods.dropout import dropoutgs
from splat.training.methods.dropout.dropoutgs import DropoutGS
from splat.training.state import Step, TrainConfig, Training
from tests.splat.tiny import EXTENT, tiny_gaussians, tiny_views


@pytest.mark.parametrize("literal", [False, True])
def test_the_gradient_is_that_of_the_loss_and_of_the_agreement(monkeypatch, literal):
    masks, draw = [], dropoutgs.dropout
    monkeypatch.setattr(dropoutgs, "dropout", lambda *a: masks.append(draw(*a)) or masks[-1])
    views, config = tiny_views(torch.float64), TrainConfig(10, method=DropoutGS(p=0.5, weight=0.3))
    config = replace(config, loss=LossSettings(literal=literal))
    training = Training.start(tiny_gaussians(sh_degree=1, dtype=torch.float64), EXTENT, config)
    background = torch.tensor([0.2, 0.4, 0.1], dtype=torch.float64)
    loss = CpuViewLoss(views[1].image, config.loss, torch.float64)
    step = Step(1, training, training.gaussians, views, 1, background, lambda _: loss)
    base = loss_and_gradient(step.gaussians, step.camera, step.loss_of(step.chosen), step.background)
    gradient = training.method.gradient(step, base).gradient

    stays = masks[0].nonzero()[:, 0]
    assert 0 < len(stays) < len(step.gaussians)
    flat = step.gaussians.flat.detach().requires_grad_()
    gaussians = step.gaussians.with_flat(flat)
    whole, dropped = (
        render(these, step.camera, background, backend="reference").image
        for these in (gaussians, gaussians.select(stays))
    )
    total = photometric_loss(whole, views[1].image, config.loss) + 0.3 * photometric_loss(whole, dropped)
    (expected,) = torch.autograd.grad(total, flat)
    assert (gradient - expected).norm() < 1e-10 * expected.norm()
