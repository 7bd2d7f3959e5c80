"""Renderers that stand for other people's: bumps on a line in plain torch, and our own rasteriser on a small trained scene.

Both can be differentiated twice, which no bridge uses: their exact Hessians are the oracles.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import torch
from torch import Tensor

from landscape import ObjectiveHessian, RendererHessian
from splat import (
    Gaussians,
    LossSettings,
    SceneHessian,
    SceneObjective,
    SyntheticSettings,
    TrainConfig,
    Training,
    initial_gaussians,
    synthetic_scene,
    train,
)
from splat.losses.autograd import view_loss
from splat.render.backend import backend_of
from splat.render.render import render

PIXELS = torch.linspace(-1, 1, 40, dtype=torch.float64)


@dataclass
class Bumps:
    """Six bumps on a line, seen from places that shift near ones more; their parameters are `named`.

    cut: weights below it are dropped, a jump as of a splat's footprint.  change: applied to each image.
    """

    dtype: torch.dtype = torch.float64
    cut: float = 0.0
    change: Callable[[Tensor], Tensor] = lambda image: image
    views: tuple[float, ...] = (-0.3, 0.0, 0.4)
    renders: int = 0
    named: dict[str, Tensor] = field(init=False)

    def __post_init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        start = {"places": torch.linspace(-0.8, 0.8, 6), "depths": torch.rand(6, generator=generator)}
        start |= {"widths": torch.full((6,), -1.5), "heights": torch.randn(6, generator=generator)}
        self.named = {name: value.to(self.dtype).requires_grad_() for name, value in start.items()}

    def image(self, named: dict[str, Tensor], view: float) -> Tensor:
        offsets = PIXELS.to(self.dtype) - (named["places"] + view * named["depths"])[:, None]
        weights = torch.exp(-((offsets / named["widths"].exp()[:, None]) ** 2) / 2)
        return (named["heights"][:, None] * torch.where(weights < self.cut, 0.0, weights)).sum(dim=0)

    def render(self, view: float) -> Tensor:
        self.renders += 1
        return self.change(self.image(self.named, view))

    @staticmethod
    def loss(image: Tensor, view: float) -> Tensor:
        """Couples neighbouring pixels, and is not convex in the image."""
        target = torch.sin(3 * PIXELS + view).to(image)
        return ((image - target) ** 2).mean() - (image[1:] * image[:-1]).cos().mean()

    def hessian(self, **options: Any) -> RendererHessian:
        return RendererHessian(self.render, self.named, self.loss, self.views, **options)

    def exact(self) -> ObjectiveHessian:
        """The Hessian by double backward."""
        sizes = [value.numel() for value in self.named.values()]

        def mean_loss(theta: Tensor) -> Tensor:
            named = dict(zip(self.named, theta.split(sizes), strict=True))
            return torch.stack([self.loss(self.image(named, view), view) for view in self.views]).mean()

        return ObjectiveHessian(mean_loss, torch.cat([value.detach() for value in self.named.values()]))


@dataclass
class SplatScene:
    """A trained scene, and the exact operators of its loss."""

    objective: SceneObjective
    exact: SceneHessian
    exact_gauss_newton: SceneHessian

    def hessian(self, dtype: torch.dtype = torch.float32) -> RendererHessian:
        """The bridge, by renders and their gradients in this dtype alone."""
        active = self.objective.active.to(dtype)
        named = {name: value.clone().requires_grad_() for name, value in active.attributes.items()}
        # SSIM in float32 would be wrong by 0.1% in all products
        like = self.objective.active.flat
        losses = [
            backend_of(like).view_loss(view.image, self.objective.loss_settings, like) for view in self.objective.views
        ]
        cameras = [view.camera for view in self.objective.views]
        return RendererHessian(
            lambda view: render(Gaussians.pack(named), cameras[view]).image,
            named,
            lambda image, view: view_loss(image.to(like), losses[view]),
            range(len(cameras)),
        )


@cache
def trained(
    gaussians: int = 100, width: int = 40, height: int = 30, steps: int = 100, sh_degree: int = 1
) -> SplatScene:
    """A synthetic scene of three views, trained for a moment with L1 + SSIM."""
    made = synthetic_scene(SyntheticSettings(gaussians=gaussians, views=3, width=width, height=height))
    views = made.scene.load()
    start = initial_gaussians(made.scene, views, 0, generator=torch.Generator().manual_seed(0))
    config = TrainConfig(iterations=steps, sh_degree=sh_degree, sh_degree_every=max(1, steps // 3))
    training = Training.start(start, made.scene.extent([view.name for view in views]), config)
    for _ in train(training, views):
        pass
    objective = SceneObjective(training.gaussians.to(torch.float64), views, LossSettings("l1"))
    exact, part = (SceneHessian(objective, gauss_newton=part, keep_null=True) for part in (False, True))
    return SplatScene(objective, exact, part)


def by_block(blocks: dict[str, slice], dim: int, generator: torch.Generator, each: int = 1) -> Tensor:
    """Unit vectors: random ones over all rows, then over each block alone."""
    V = torch.randn(dim, each * (1 + len(blocks)), generator=generator, dtype=torch.float64)
    for index, rows in enumerate(blocks.values(), 1):
        columns = slice(each * index, each * (index + 1))
        kept = V[rows, columns].clone()
        V[:, columns] = 0
        V[rows, columns] = kept
    return V / V.norm(dim=0)
