"""LPIPS (Zhang et al. 2018): the distance of two images in the features of a network.  Lower is better.

The package `lpips` (the extra `lpips`) computes it with VGG-16, whose weights torchvision fetches when they are first
used.  Images go in as they are, in [0, 1], because 3DGS's `metrics.py` and its sparse-view followers feed them so: the
network was meant to see [-1, 1], but then no number would compare with theirs.
"""

import warnings
from collections.abc import Callable
from importlib import import_module

import torch
from jaxtyping import Float
from torch import Tensor

SMALLEST = 16  # px; VGG halves an image four times
Perceptual = Callable[[Float[Tensor, "3 h w"], Float[Tensor, "3 h w"]], float | None]


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
