"""A scene of a dozen Gaussians and three small views, with a start that is not the truth."""

from collections import deque

import torch
from torch import Tensor

from splat.losses.cpu.loss import CpuViewLoss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.loss_and_gradient import LossAndGradient
from splat.render.render import render
from splat.scenes.view import View
from splat.training.densify import DensifySettings
from splat.training.loop import train
from splat.training.origin.fingerprint import ViewData
from splat.training.origin.subject import SceneReference
from splat.training.state import MethodSettings, Step, TrainConfig, Training

SMOOTH = RenderSettings(alpha_min=0.0, transmittance_min=0.0, fov_clamp=1e6)  # no threshold that can be off
WIDTH, HEIGHT, EXTENT = 20, 14, 2.0
LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
LENS, SIZE = (20.0, 20.0, WIDTH / 2, HEIGHT / 2), (WIDTH, HEIGHT)
SEEN = {f"view{i}": ViewData(LEVEL, (0.4 * (i - 1), 0.1 * i, 0.0), LENS, SIZE) for i in range(3)}
REFERENCE = SceneReference("/nowhere/tiny", "../tiny", None, 1.0, list(SEEN), [], SEEN)


def tiny_gaussians(n: int = 12, seed: int = 0, sh_degree: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    attributes = {
        "means": normal(n, 3) * torch.tensor([0.5, 0.35, 0.5]) + torch.tensor([0.0, 0.0, 3.0]),
        "log_scales": normal(n, 3) * 0.3 - 1.5,
        "quats": normal(n, 4),
        "opacity_logits": normal(n),
        "sh": normal(n, (sh_degree + 1) ** 2, 3) * 0.5,
    }
    return Gaussians.pack(attributes).to(dtype)


def tiny_views(dtype: torch.dtype = torch.float32) -> list[View]:
    truth = tiny_gaussians(seed=1, dtype=dtype)
    views = []
    for i in range(3):
        centre = torch.tensor([0.4 * (i - 1), 0.1 * i, 0.0], dtype=torch.float64)
        camera = Camera(torch.eye(3, dtype=torch.float64), centre, 20.0, 20.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
        views.append(View(f"view{i}", camera, render(truth, camera).image.detach()))
    return views


def tiny_config(iterations: int = 12, seed: int = 0) -> TrainConfig:
    """Every part of training happens within a dozen steps: densification, opacity reset, more bands, random colours."""
    schedule = {"every": 2, "every_share": 1.0, "reset_every": 5, "stop_share": 0.75}
    densify = DensifySettings(gradient_threshold=1e-3, clone_scale=0.11, prune_scale=0.14, **schedule)
    return TrainConfig(iterations, seed, sh_degree=2, sh_degree_every=4, random_background=True, densify=densify)


def trained(config: TrainConfig, start: Gaussians | None = None, views: list[View] | None = None) -> Training:
    """A training from its first step to its last."""
    return ended(Training.start(tiny_gaussians() if start is None else start, EXTENT, config), views)


def ended(training: Training, views: list[View] | None = None) -> Training:
    deque(train(training, views or tiny_views()), maxlen=0)
    return training


def a_step(method: MethodSettings, number: int = 1, views: list[View] | None = None, **others) -> Step:
    """A step of a method in float64 that has chosen the second view.  others: of the training."""
    views, config = views or tiny_views(torch.float64), TrainConfig(10, method=method, **others)
    training = Training.start(tiny_gaussians(sh_degree=1, dtype=torch.float64), EXTENT, config)
    training.method.on_start(training, views)
    losses = [CpuViewLoss(view.image, config.loss, torch.float64) for view in views]
    background = config.background_colour(torch.float64)
    return Step(number, training, training.gaussians, views, 1, background, losses.__getitem__)


def both_of(step: Step) -> tuple[LossAndGradient, LossAndGradient]:
    """The photometric loss of a step, and what the method makes of it."""
    base = step.loss_and_gradient(step.gaussians)
    return base, step.training.method.gradient(step, base)
