"""Training of 3D Gaussian Splatting (Kerbl et al. 2023): the loop, which reads from top to bottom.

Steps are counted from 1.  Views come in epochs, each a new random order.  All randomness comes from one generator, and
`Training` holds all that the next step depends on: a training that is saved and loaded continues to the same bits.

    position rate(step) = extent * position^(1 - s) * position_final^s,   s = max(0, step - hold) / (iterations - hold)
    SH degree(step)     = min(sh_degree, (step - 1) // sh_degree_every)

The Gaussians hold only the SH bands in use; a band joins as zeros, which is the same as one whose gradient was zero.

Where Gaussians have Mip-Splatting's 3-D filter (`render.antialias`), `Training.update_filter` keeps it up to date.

The published code (graphdeco-inria/gaussian-splatting, train.py) orders a step in another way:

    update      after density control, whose new tensors have no gradient yet: a step that clones, splits and prunes updates
                nothing, one that resets opacities does not update these.  Here every step updates, and density control comes
                after; its statistics are of the render before the update in both
    last step   makes no update there, and here one at the lowest of the position rates
    SH degree   rises before the renders of the steps 1000, 2000, 3000; here before those of 1001, 2001, 3001
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from math import isfinite

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from splat.losses.autograd import Clamped
from splat.losses.protocols import ViewLoss
from splat.projection.reference import on_screen, project
from splat.scenes.view import View, inside_image
from splat.training.state import Step, TrainConfig, Training


@dataclass(frozen=True)
class StepResult:
    """A step done: its number, the view's loss before the update, the number of Gaussians after it, the view's name."""

    step: int
    loss: float
    gaussians: int
    view: str


def prepare(training: Training, views: Sequence[View]) -> None:
    """Get ready for steps on these views; a second call changes nothing.

    InputError where there are no views, they lack what the method needs, none draws a Gaussian, or no part of the method would
    begin.  A method with every part switched off is 3DGS, the base that it is compared with.
    """
    config = training.config
    if not views:
        raise InputError("expected at least one view to train on, got none")
    parts = config.method.parts(config)
    if parts and all(begins >= config.iterations for begins in parts.values()):
        late = ", ".join(f"{name} = {begins}" for name, begins in parts.items())
        raise InputError(
            f"expected a training in which the method acts, got {config.method.name} which never does in "
            f"{config.iterations} steps ({late}); take more steps, let it begin earlier, or use the method 3dgs"
        )
    training.update_filter(0, [view.camera for view in views])
    _require_in_sight(training, views)
    training.method.on_start(training, views)


def train(training: Training, views: Sequence[View]) -> Iterator[StepResult]:
    """Make the steps that are left of config.iterations, one each time the next item is asked for.

    Between two items `training` is complete: it can be saved, evaluated, or left there.  InputError as of `prepare`, and where
    a loss or gradient is not finite.

    >>> from splat import SyntheticSettings, TrainConfig, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> training = Training.start(made.truth, made.scene.extent(), TrainConfig(iterations=2))
    >>> [done.step for done in train(training, made.scene.load())]
    [1, 2]
    """
    prepare(training, views)
    config, method, dtype = training.config, training.method, training.gaussians.flat.dtype
    loss_of = config.losses_against(views, training.gaussians.flat)
    cameras = [view.camera for view in views]
    while training.step < config.iterations:
        # what the step is about: a view, a background, the loss against that view
        number = training.step + 1
        training.raise_sh_degree(min(config.sh_degree, (number - 1) // config.sh_degree_every))
        chosen = training.next_view(len(views))
        background, against = config.background_colour(dtype), loss_of
        if config.random_background:
            drawn = torch.rand(3, generator=training.generator, dtype=dtype)
            background, against = drawn, losses_on(drawn, config, views, training.gaussians.flat)
        step = Step(number, training, training.gaussians, views, chosen, background, against)

        value = method.own_step(step)
        value = photometric_step(step) if value is None else value
        _require_finite("loss", value, step)
        method.after_step(step)
        training.update_filter(number, cameras)
        training.step = number
        yield StepResult(number, value, len(training.gaussians), views[chosen].name)


@torch.no_grad()
def _require_in_sight(training: Training, views: Sequence[View]) -> None:
    """InputError where no view draws a Gaussian: nothing would ever move."""
    gaussians, settings, nearer = training.gaussians, training.config.render, 0
    gaussians = gaussians.with_flat(gaussians.flat.cpu())
    for camera in (view.camera for view in views):
        if bool(on_screen(project(gaussians, camera, settings), camera).any()):
            return
        nearer = max(nearer, int(inside_image(camera, gaussians.means.double(), (0.0, settings.near)).sum()))
    raise InputError(
        f"expected Gaussians that a view draws, got {len(gaussians)} that none of {len(views)} views draws; up to "
        f"{nearer} lie nearer than the near plane at {settings.near:g} world units: scale the scene, or lower it with --set "
        "render.near=X"
    )


def photometric_step(step: Step) -> float:
    """A step of 3DGS on the sampled view, with what the method adds; the loss before it."""
    training, method = step.training, step.training.method
    # the gradient of the loss, and what the method makes of it
    scale = method.opacity_scale(step)
    base = step.loss_and_gradient(step.gaussians, scale)
    _require_finite("loss", base.loss, step)
    found = method.gradient(step, base)
    _require_finite("gradient", float(found.gradient.sum()), step)

    # update, then clone, split and prune
    training.descend(found.gradient, step.number)
    if base.loss and step.number == len(step.views) and not bool(training.adam.first.flat.any()):
        raise InputError(
            f"expected a gradient, got exactly 0 in the first {step.number} steps, one on each view: what they show does not "
            "depend on the Gaussians; look at their opacities and at the scene's scale"
        )
    training.control_density(step.number, step.camera, found)
    return base.loss


def losses_on(
    drawn: Float[Tensor, "3"], config: TrainConfig, views: Sequence[View], like: Tensor
) -> Callable[[int], ViewLoss | Clamped]:
    """A function from a view's index to the loss against its image on this background; like: see `TrainConfig.loss_against`."""
    usual = config.background_colour(drawn.dtype)
    return cache(lambda index: config.loss_against(with_background(views[index], usual, drawn), like))


def with_background(view: View, old: Float[Tensor, "3"], new: Float[Tensor, "3"]) -> Float[Tensor, "3 h w"]:
    """The view's image, composited over another colour where it is transparent; photographs are opaque."""
    if view.alpha is None:
        return view.image
    return view.image + (1 - view.alpha) * (new - old)[:, None, None]


def _require_finite(what: str, value: float, step: Step) -> None:
    """InputError that names the step and its view, unless a loss, or the sum of a gradient, is finite."""
    if not isfinite(value):
        name = step.views[step.chosen].name
        raise InputError(f"expected a finite {what}, got {value} at step {step.number} on view {name}; lower the rates")
