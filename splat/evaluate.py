"""How well Gaussians show views that they were not trained on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from splat.gaussians import Gaussians
from splat.losses import psnr, ssim
from splat.render import render
from splat.scenes.view import View
from splat.settings import RenderSettings


@dataclass(frozen=True)
class ViewScore:
    """psnr: dB, peak 1; ssim: mean structural similarity (`splat/losses.py`)."""

    name: str
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Evaluation:
    """Scores of every view; their means are what papers report."""

    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        return fmean(view.psnr for view in self.views)

    @property
    def ssim(self) -> float:
        return fmean(view.ssim for view in self.views)


@torch.no_grad()
def evaluate(
    gaussians: Gaussians,
    views: Sequence[View],
    background: Float[Tensor, "3"] | None = None,
    settings: RenderSettings = RenderSettings(),
    *,
    on_image: Callable[[str, Float[Tensor, "3 h w"]], None] | None = None,
) -> Evaluation:
    """Render every view and score it; on_image(name, image) receives each image as it is rendered."""
    if not views:
        raise ValueError("expected at least one view to evaluate on, got none")
    scores = []
    for view in views:
        image = render(gaussians, view.camera, background, settings).image
        scores.append(ViewScore(view.name, psnr(image, view.image), ssim(image, view.image)))
        if on_image is not None:
            on_image(view.name, image)
    return Evaluation(tuple(scores))
