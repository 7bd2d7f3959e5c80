"""Scores of Gaussians on views that they were not trained on.

Where views have masks, only the pixels inside count, as on DTU since pixelNeRF (RegNeRF, DNGaussian and CoR-GS, in its
`metrics_dtu.py`): PSNR is over the pixels inside; for SSIM and LPIPS, whose windows reach across the edge, both images are
white outside.

LPIPS (Zhang et al. 2018): the distance of two images in the features of a network.  Lower is better.

The package `lpips` (the extra `lpips`) computes it with VGG-16, whose weights torchvision fetches when they are first
used.  Images go in as they are, in [0, 1], because 3DGS's `metrics.py` and its sparse-view followers feed them so: the
network was meant to see [-1, 1], but then no number would compare with theirs.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr
from splat.losses.reference import psnr, ssim
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.render import render
from splat.scenes.view import View

SMALLEST = 16  # px; VGG halves an image four times
Perceptual = Callable[[Float[Tensor, "3 h w"], Float[Tensor, "3 h w"]], float | None]


@dataclass(frozen=True)
class ViewScore:
    """psnr: dB, peak 1; ssim: mean structural similarity (`splat/losses/reference.py`); lpips: None where not known."""

    name: str
    psnr: float
    ssim: float
    lpips: float | None = None

    @property
    def avge(self) -> float | None:
        """Geometric mean of 10^(-PSNR / 10), sqrt(1 - SSIM) and LPIPS (Niemeyer et al., *RegNeRF*, 2022); None without it."""
        return self.lpips and (10 ** (-self.psnr / 10) * max(1 - self.ssim, 0.0) ** 0.5 * self.lpips) ** (1 / 3)


@dataclass(frozen=True, repr=False)
class Evaluation(ShortRepr):
    """Scores of every view, and their means, which papers report.  masked: whether only pixels inside masks count."""

    views: tuple[ViewScore, ...]
    masked: bool = False

    @property
    def psnr(self) -> float:
        return fmean(view.psnr for view in self.views)

    @property
    def ssim(self) -> float:
        return fmean(view.ssim for view in self.views)

    @property
    def lpips(self) -> float | None:
        return self._mean("lpips")

    @property
    def avge(self) -> float | None:
        return self._mean("avge")

    def _mean(self, name: str) -> float | None:
        known = [getattr(view, name) for view in self.views]
        return None if None in known else fmean(known)


@torch.no_grad()
def evaluate(
    gaussians: Gaussians,
    views: Sequence[View],
    background: Float[Tensor, "3"] | None = None,
    settings: RenderSettings = RenderSettings(),
    *,
    lpips: Perceptual | None = None,
    on_image: Callable[[str, Float[Tensor, "3 h w"]], None] | None = None,
) -> Evaluation:
    """Render every view and score it; on_image(name, image) receives each image as it is rendered.

    >>> from splat import SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> evaluate(made.truth, made.scene.load()).psnr > 60  # dB: the pictures are renders of these Gaussians
    True
    """
    if not views:
        raise ValueError("expected at least one view to evaluate on, got none")
    masked = have_masks(views)
    scores = []
    for view in views:
        image = render(gaussians, view.camera, background, settings).image.to(view.image.device)
        scores.append(score(image, view, lpips))
        if on_image is not None:
            on_image(view.name, image)
    return Evaluation(tuple(scores), masked)


def have_masks(views: Sequence[View]) -> bool:
    """Whether the views have masks.  InputError where only some do: their scores would have no mean."""
    without = [view.name for view in views if view.mask is None]
    if 0 < len(without) < len(views):
        raise InputError(
            f"expected a mask for each of {len(views)} views that are scored together or for none, got "
            f"{len(views) - len(without)}, and none for {without[0]}; add those that are missing"
        )
    return bool(views) and not without


def score(image: Float[Tensor, "3 h w"], view: View, lpips: Perceptual | None = None) -> ViewScore:
    """Similarity of an image to the view's picture, inside its mask."""
    image, target = image.clamp(0, 1), view.image
    if view.mask is None:
        ratio = psnr(image, target)
    else:
        ratio = psnr(image[:, None, view.mask], target[:, None, view.mask])
        image, target = (torch.where(view.mask, picture, 1.0) for picture in (image, target))
    return ViewScore(view.name, ratio, ssim(image, target), lpips(image, target) if lpips else None)


class MissingPerceptual(RuntimeError):
    """LPIPS cannot be computed here; the message says why and what to do."""


def load_lpips() -> Perceptual:
    """The distance as a function of two images; its value is None for images too small for the network.

    MissingPerceptual without the package or its weights.
    """
    try:
        package = import_module("lpips")
    except (ImportError, RuntimeError) as error:  # RuntimeError: a torchvision that does not fit torch
        raise MissingPerceptual(
            f"LPIPS is left out: {error}; to have it, install the package: pip install -e '.[lpips]'"
        ) from error
    try:
        with warnings.catch_warnings(action="ignore"):  # of arguments that lpips passes to torchvision
            network = package.LPIPS(net="vgg", verbose=False).eval().requires_grad_(False)
    except (OSError, RuntimeError) as error:
        raise MissingPerceptual(
            f"LPIPS is left out: the weights of its network cannot be loaded ({error}); fetch them once with a connection"
        ) from error

    @torch.no_grad()
    def distance(image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"]) -> float | None:
        if min(image.shape[1:]) < SMALLEST:
            return None
        return float(network(image.clamp(0, 1).float()[None], target.float()[None]))

    return distance
