"""Training of 3D Gaussian Splatting (Kerbl et al. 2023): settings, state, and the loop, which reads top to bottom.

One step renders one view, takes the gradient of its photometric loss, lets the method's regularizer change it
(`splat/regularizers`), updates every stored parameter with Adam, and, while density control is under way, clones, splits
and prunes.  Steps are counted from 1.  Views come in epochs, each a new random order.  All randomness is drawn from one
generator, and `Training` holds all that the next step depends on: a training that is saved and loaded
(`splat/training/checkpoint.py`) continues to the same bits.

    position rate(step) = extent * position^(1 - s) * position_final^s,   s = step / iterations
    SH degree(step)     = min(sh_degree, (step - 1) // sh_degree_every)

The Gaussians hold only the SH bands in use; a band joins as zeros.  That is the same as carrying bands whose gradient
is zero, and spares their cost.

The published code orders a step otherwise, which makes one update more or less here and there:

    update      after density control, whose new tensors have no gradient yet: a step that clones, splits and prunes updates
                nothing (144 of 30,000 steps), one that resets opacities not these.  Here every step updates, and density
                control sees what it led to; its statistics are of the render before, as there
    last step   makes no update there, and here one at the lowest of the position rates
    SH degree   rises before the renders of the steps 1000, 2000, 3000; here before those of 1001, 2001, 3001

An update moves a parameter by about its rate, and from 2,000 steps on a hundred others lie between two that differ.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.autograd import loss_against
from splat.losses.cpu.loss import ViewLoss
from splat.render.loss_and_gradient import loss_and_gradient
from splat.scenes.view import View
from splat.training.state import Step, Training


@dataclass(frozen=True)
class StepResult:
    """One step done: its number, the view's loss before the update, how many Gaussians there are after it, the view's name."""

    step: int
    loss: float
    gaussians: int
    view: str


def with_background(view: View, old: Float[Tensor, "3"], new: Float[Tensor, "3"]) -> Float[Tensor, "3 h w"]:
    """The view's image, composited over another colour where it is transparent; photographs are opaque."""
    if view.alpha is None:
        return view.image
    return view.image + (1 - view.alpha) * (new - old)[:, None, None]


def train(training: Training, views: Sequence[View]) -> Iterator[StepResult]:
    """Make the steps that are left of config.iterations, one each time the next item is asked for.

    Between two items `training` is whole, so that it can be saved, evaluated or left there.  ValueError where there are no
    views, they lack what the method needs, or a loss or gradient is not finite.
    """
    config, regularizer = training.config, training.regularizer
    if not views:
        raise ValueError("expected at least one view to train on, got none")
    regularizer.begin(training, views)
    losses = [loss_against(view.image, config.loss, training.gaussians.flat) for view in views]
    while training.step < config.iterations:
        number = training.step + 1
        training.raise_sh_degree(min(config.sh_degree, (number - 1) // config.sh_degree_every))
        step = _next_step(training, number, views, losses)
        camera, gaussians = step.camera, training.gaussians
        gain = regularizer.opacity_scale(step)
        base = loss_and_gradient(gaussians, camera, step.loss, step.background, config.render, gain)
        _require_finite("loss", base.loss, step)
        gradient = regularizer.gradient(step, base)
        _require_finite("gradient", float(gradient.sum()), step)  # before the Gaussians and their moments take it over
        training.descend(gradient, number)
        training.control_density(number, camera, base)
        regularizer.after(step)
        training.step = number
        yield StepResult(number, base.loss, len(training.gaussians), views[step.chosen].name)


def _require_finite(what: str, value: float, step: Step) -> None:
    """ValueError that names the step and its view, unless a loss, or the sum of a gradient, is finite."""
    if not isfinite(value):
        name = step.views[step.chosen].name
        raise ValueError(f"expected a finite {what}, got {value} at step {step.number} on view {name}; lower the rates")


def _next_step(training: Training, number: int, views: Sequence[View], losses: Sequence[ViewLoss]) -> Step:
    """The view of a step and what it is compared with."""
    config, gaussians = training.config, training.gaussians
    chosen = training.next_view(len(views))
    background, loss = config.background_colour(gaussians.flat.dtype), losses[chosen]
    if config.random_background:
        drawn = torch.rand(3, generator=training.generator, dtype=background.dtype)
        target = with_background(views[chosen], background, drawn)
        background, loss = drawn, loss_against(target, config.loss, gaussians.flat)
    return Step(number, training, gaussians, views, chosen, background, loss)
