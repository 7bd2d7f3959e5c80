"""Render a view of a set of Gaussians: the one interface to the renderer's implementations."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.camera import Camera
from splat.gaussians import Gaussians
from splat.projection import Splats, project
from splat.raster.reference import rasterize_reference
from splat.settings import RenderSettings

Backend = Literal["cpu", "reference"]


@dataclass(frozen=True, eq=False)
class Rendering:
    """image: linear RGB as trained on, background included; alpha: accumulated opacity; splats: the 2-D footprints.

    `splats.means` is on the autograd graph: call `.retain_grad()` on it to get the screen-space gradient of densification.
    """

    image: Float[Tensor, "3 h w"]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"] | None
    splats: Splats


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"] | None = None,
    settings: RenderSettings = RenderSettings(),
    *,
    depth: bool = False,
    backend: Backend = "cpu",
) -> Rendering:
    """Colour, accumulated alpha and, if asked for, expected depth (sum of weight times z, world units) of one view.

    Differentiable twice in the Gaussians' stored parameters.  background: black where None.
    """
    if background is None:
        background = torch.zeros(3, dtype=gaussians.flat.dtype)
    splats = project(gaussians, camera, settings)
    image, alpha, expected = rasterize_reference(splats, background, camera.width, camera.height, settings)
    return Rendering(image, alpha, expected if depth else None, splats)
