"""Workloads of a bench: Gaussians with the views that they are compared with, of a scene, a checkpoint or synthetic."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.scenes.scene import load_scene
from splat.scenes.splits import split_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.view import View
from splat.training.checkpoint import open_subject
from splat.training.start import gaussians_from_points


@dataclass(frozen=True)
class Size:
    """A number of splats (or Gaussians) and an image size, px."""

    count: int
    width: int
    height: int

    @classmethod
    def parse(cls, text: str) -> "Size":
        """Size from "10k@504x378"."""
        match = re.fullmatch(r"(\d+)(k?)@(\d+)x(\d+)", text)
        size = cls(int(match[1]) * (1000 if match[2] else 1), int(match[3]), int(match[4])) if match else None
        if size is None or min(size.count, size.width, size.height) < 1:
            raise InputError(f"expected a size as GAUSSIANS@WIDTHxHEIGHT, e.g. 10k@504x378, got {text!r}")
        return size

    def __str__(self) -> str:
        count = f"{self.count // 1000}k" if self.count % 1000 == 0 else str(self.count)
        return f"{count}@{self.width}x{self.height}"


@dataclass(frozen=True, eq=False)
class Workload:
    """Gaussians and the views that they are compared with."""

    name: str
    gaussians: Gaussians
    views: tuple[View, ...]
    background: Float[Tensor, "3"]
    loss: LossSettings = LossSettings()
    settings: RenderSettings = RenderSettings()

    @property
    def pixels(self) -> int:
        """Number of pixels of one view."""
        return self.views[0].camera.width * self.views[0].camera.height

    def to(self, device: torch.device) -> "Workload":
        """The Gaussians on a device, where all that is computed of them is then computed; views stay where they are."""
        return replace(self, gaussians=self.gaussians.with_flat(self.gaussians.flat.to(device)))


def synthetic_workload(size: Size) -> Workload:
    """Four views of the synthetic scene, whose Gaussians have lost their exact colours, so that the loss is not at 0."""
    made = synthetic_scene(SyntheticSettings(size.count, 4, size.width, size.height, sh_degree=3))
    return Workload(f"synthetic {size}", _discoloured(made.truth), tuple(made.scene.load()), made.scene.background)


def _discoloured(gaussians: Gaussians) -> Gaussians:
    gaussians = gaussians.select(torch.arange(len(gaussians)), 3)
    gaussians.sh.add_(0.1 * torch.randn(gaussians.sh.shape, generator=torch.Generator().manual_seed(0)))
    return gaussians


def workload_of(path: Path) -> Workload:
    """A checkpoint's Gaussians and training views; of a scene's folder the start: all its points, SH degree 3, three views.

    Raises FileNotFoundError or ValueError where the path is neither, or the scene has no points.
    """
    if path.is_file():
        subject = open_subject(path)
        training, scene, config = subject.checkpoint.training, subject.scene, subject.checkpoint.training.config
        views, name = tuple(scene.load(subject.checkpoint.scene.train)), f"{scene.name}, step {training.step}"
        return Workload(name, training.gaussians, views, scene.background, config.loss, config.render)
    scene = load_scene(path)
    if scene.points is None:
        raise InputError(f"expected a scene with points, got {path} without any; train it and give the checkpoint")
    views = tuple(scene.load(split_scene(scene, 3).train))
    gaussians = gaussians_from_points(scene.points, scene.frames, sh_degree=3)
    return Workload(f"{scene.name}, start", gaussians, views, scene.background)
