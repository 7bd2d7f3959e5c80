"""A scene of a dozen Gaussians and three small views, with a start that is not the truth."""

import torch
from torch import Tensor

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.render import render
from splat.scenes.view import View
from splat.training.densify import DensifySettings
from splat.training.origin.fingerprint import ViewData
from splat.training.origin.scene_reference import SceneReference
from splat.training.state import TrainConfig

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
    densify = DensifySettings(
        every=2,
        every_share=1.0,
        reset_every=5,
        stop_share=0.75,
        gradient_threshold=1e-3,
        clone_scale=0.11,
        prune_scale=0.14,
    )
    return TrainConfig(iterations, seed, sh_degree=2, sh_degree_every=4, random_background=True, densify=densify)
