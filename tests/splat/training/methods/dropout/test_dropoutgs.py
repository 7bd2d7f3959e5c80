"""The random dropout regularisation of DropoutGS against one autograd expression."""

import pytest
import torch

from splat.losses.reference import LossSettings
from splat.render.render import render
from splat.training.methods.dropout import DropoutGS, dropout
from tests.splat.photometric import photometric_loss
from tests.splat.tiny import a_step, both_of


@pytest.mark.parametrize("literal", [False, True])
def test_the_gradient_is_that_of_the_loss_and_of_the_agreement(monkeypatch, literal):
    masks, draw = [], dropout
    monkeypatch.setattr("splat.training.methods.dropout.dropout", lambda *a: masks.append(draw(*a)) or masks[-1])
    loss, background = LossSettings(literal=literal), (0.2, 0.4, 0.1)
    step = a_step(DropoutGS(p=0.5, weight=0.3), loss=loss, background=background)
    gradient, image = both_of(step)[1].gradient, step.views[1].image

    stays = masks[0].nonzero()[:, 0]
    assert 0 < len(stays) < len(step.gaussians)
    flat = step.gaussians.flat.detach().requires_grad_()
    gaussians = step.gaussians.with_flat(flat)
    whole, dropped = (
        render(these, step.camera, step.background, backend="reference").image
        for these in (gaussians, gaussians.select(stays))
    )
    total = photometric_loss(whole, image, loss) + 0.3 * photometric_loss(whole, dropped)
    (expected,) = torch.autograd.grad(total, flat)
    assert (gradient - expected).norm() < 1e-10 * expected.norm()
