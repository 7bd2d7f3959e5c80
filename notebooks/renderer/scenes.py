"""Our own rasteriser in the place of somebody else's: renders and their gradients alone, beside the exact operators.

demo     a small synthetic scene after a moment of training with L1 + SSIM, in float64 and float32; its traces are exact
RUN      a folder of `landscape train`, in float32, as other people's rasterisers are; its traces are sampled

The exact operators are in float64 in both, and the loss of the image too: SSIM in float32 would be wrong by 0.1%.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from landscape import RendererHessian
from splat import (
    Gaussians,
    LossSettings,
    SceneHessian,
    SceneObjective,
    SyntheticSettings,
    TrainConfig,
    Training,
    initial_gaussians,
    open_subject,
    synthetic_scene,
    train,
)
from splat.curvature.traces import exact_traces
from splat.losses.autograd import view_loss
from splat.render.backend import backend_of
from splat.render.render import render

DENSE = 3000  # rows up to which traces are those of the dense matrix
SAMPLES = 64  # of the traces of larger ones


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene and the type in which the renderer works."""

    name: str
    objective: SceneObjective
    dtype: torch.dtype

    @property
    def gaussians(self) -> int:
        return len(self.objective.active)

    @property
    def type(self) -> str:
        return str(self.dtype).removeprefix("torch.")

    @cached_property
    def exact(self) -> SceneHessian:
        return SceneHessian(self.objective, keep_null=True)

    @cached_property
    def exact_gauss_newton(self) -> SceneHessian:
        return SceneHessian(self.objective, gauss_newton=True, keep_null=True)

    @cached_property
    def traces(self) -> dict[str, tuple[float, float]]:
        """Of Gauss-Newton's blocks, with the half width of their 95% interval, 0 where they are exact."""
        G = self.exact_gauss_newton
        if G.dim <= DENSE:
            diagonal = G.apply(torch.eye(G.dim, dtype=torch.float64)).diagonal()
            return {name: (float(diagonal[rows].sum()), 0.0) for name, rows in G.blocks.items()}
        found = exact_traces(self.objective, torch.Generator().manual_seed(1), samples=SAMPLES, gauss_newton=True)
        return {name: (trace.value, trace.half_width) for name, trace in found.items()}

    def foreign(self) -> RendererHessian:
        """The bridge: images and their gradients from the rasteriser, no second derivative of it."""
        like = self.objective.active.flat
        parts = self.objective.active.to(self.dtype).attributes
        named = {name: value.clone().requires_grad_() for name, value in parts.items()}
        losses = [
            backend_of(like).view_loss(view.image, self.objective.loss_settings, like) for view in self.objective.views
        ]
        cameras = [view.camera for view in self.objective.views]
        background, settings = self.objective.background.to(self.dtype), self.objective.settings
        return RendererHessian(
            lambda view: render(Gaussians.pack(named), cameras[view], background, settings).image,
            named,
            lambda image, view: view_loss(image.to(like), losses[view]),
            range(len(cameras)),
        )


def demo(gaussians: int = 100, width: int = 40, height: int = 30, steps: int = 100) -> Scene:
    """The synthetic scene: three views, L1 + SSIM."""
    made = synthetic_scene(SyntheticSettings(gaussians=gaussians, views=3, width=width, height=height))
    views = made.scene.load()
    start = initial_gaussians(made.scene, views, 0, generator=torch.Generator().manual_seed(0))
    config = TrainConfig(iterations=steps, sh_degree=1, sh_degree_every=max(1, steps // 3))
    training = Training.start(start, made.scene.extent([view.name for view in views]), config)
    for _ in train(training, views):
        pass
    gaussians64 = training.gaussians.to(torch.float64)
    return Scene("demo", SceneObjective(gaussians64, views, LossSettings("l1")), torch.float64)


def trained(run: Path) -> Scene:
    """The scene of a training, at its checkpoint, with its views and its loss."""
    subject = open_subject(run)
    training, views = subject.checkpoint.training, subject.scene.load(subject.checkpoint.scene.train)
    return Scene(run.name, training.config.objective(training.gaussians.to(torch.float64), views), torch.float32)


def directions(blocks: dict[str, slice], dim: int, each: int) -> tuple[list[str], Tensor]:
    """Names, and unit vectors (dim, each (1 + blocks)): random over all rows, and over those of a block alone."""
    V = torch.randn(dim, each * (1 + len(blocks)), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for index, rows in enumerate(blocks.values(), 1):
        outside = torch.ones(dim, dtype=torch.bool)
        outside[rows] = False
        V[outside, each * index : each * (index + 1)] = 0
    return [name for name in ("random", *blocks) for _ in range(each)], V / V.norm(dim=0)
