"""SAM against its definition by autograd in the units of its ball."""

from math import sqrt

import pytest
import torch

from splat.render.loss_and_gradient import loss_and_gradient
from splat.render.render import render
from splat.training import state
from splat.training.methods.sam import SAM, ascent
from splat.training.state import LearningRates, Step, learning_rates, position_rate
from tests.splat.photometric import photometric_loss
from tests.splat.tiny import EXTENT, a_step, both_of


def units_of(step: Step, metric: str) -> torch.Tensor:
    if metric == "parameters":
        return torch.ones_like(step.gaussians.flat)
    rates = LearningRates()
    return learning_rates(step.gaussians, rates, position_rate(rates, EXTENT, 3, 10))


@pytest.mark.parametrize(("metric", "rho"), [("parameters", 0.02), ("rates", 3.0)])
def test_the_gradient_is_that_of_the_loss_one_ascent_away_in_the_ball(metric, rho):
    step = a_step(SAM(rho=rho, metric=metric), number=3, background=(0.2, 0.4, 0.1))
    base, got = (each.gradient for each in both_of(step))

    units = units_of(step, metric)

    def loss(u: torch.Tensor) -> torch.Tensor:
        gaussians = step.gaussians.with_flat(u * units)
        image = render(gaussians, step.camera, step.background, backend="reference").image
        return photometric_loss(image, step.views[1].image, step.config.loss)

    u = (step.gaussians.flat / units).requires_grad_()
    (slope,) = torch.autograd.grad(loss(u), u)
    radius = rho if metric == "parameters" else rho * sqrt(len(u))
    worst = (u + radius * slope / slope.norm()).detach().requires_grad_()
    (expected,) = torch.autograd.grad(loss(worst), worst)
    expected = expected / units
    assert (got - expected).norm() < 1e-10 * expected.norm()
    assert (got - base).norm() > 1e-3 * expected.norm()


def test_no_step_of_the_same_length_rises_faster():
    generator = torch.Generator().manual_seed(0)
    gradient, units = torch.randn(2, 40, generator=generator, dtype=torch.float64)
    units = units.abs()
    eps = ascent(gradient, units, 0.3)
    assert (eps / units).norm().item() == pytest.approx(0.3, rel=1e-14)
    others = torch.randn(200, 40, generator=generator, dtype=torch.float64)
    others = units * 0.3 * others / others.norm(dim=1, keepdim=True)
    nearly = 0.999 * eps + 0.001 * others
    nearly = 0.3 * nearly / (nearly / units).norm(dim=1, keepdim=True)
    assert (torch.cat([others, nearly]) @ gradient < eps @ gradient).all()


def test_one_more_render_a_step_and_nothing_moves_where_the_gradient_is_0(monkeypatch):
    calls = []
    monkeypatch.setattr(state, "loss_and_gradient", lambda *a: calls.append(a[0]) or loss_and_gradient(*a))
    step = a_step(SAM())
    step.gaussians.means[:, 2] = -3.0
    gradient = both_of(step)[1].gradient
    assert len(calls) == 2 and torch.equal(calls[1].flat, step.gaussians.flat)  # the first is the base
    assert not gradient.any()
