"""What measures at poses share: images of Gaussians where no photograph is needed.

new poses   the cameras of the views that were held out, without their photographs
|A - B|_1   the mean of |A - B| over pixels and colours, of images whose colours are in [0, 1]
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.render import render


@dataclass(frozen=True, eq=False)
class Poses:
    """Cameras, and how Gaussians are rendered there; background: RGB."""

    cameras: Sequence[Camera]
    background: Float[Tensor, "3"]
    settings: RenderSettings

    @torch.no_grad()
    def images(self, gaussians: Gaussians, shown: Float[Tensor, " n"] | None = None) -> list[Float64[Tensor, "3 h w"]]:
        """The render of every camera.  shown: 1 for each Gaussian that is drawn, 0 for the others; None: all are."""
        return [
            render(gaussians, each, self.background, self.settings, opacity_scale=shown).image.double()
            for each in self.cameras
        ]


def distance(some: Sequence[Tensor], others: Sequence[Tensor]) -> float:
    """The mean over the poses of |A - B|_1."""
    return sum(float((a - b).abs().mean()) for a, b in zip(some, others, strict=True)) / len(some)
