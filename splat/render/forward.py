"""Project and composite a view without derivatives, and find the Gaussians that touch it."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splat.backend.autograd import to_backend
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.dispatch import projected
from splat.projection.formulas import lens_of
from splat.raster.dispatch import rasterize


def rasterize_view(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"],
    settings: RenderSettings,
    *,
    finite: bool = False,
) -> Any:
    """Project and composite a view by the kernels where the Gaussians are, without derivatives.

    finite: they are known to be, and are not looked at again.
    """
    if not finite:
        gaussians.require_finite()
    splats = projected(gaussians, lens_of(camera, settings))
    background = background.to(gaussians.flat, non_blocking=True)
    return rasterize(*splats, background, camera.width, camera.height, settings)


def touches(raster: Any) -> Bool[Tensor, " n"]:
    """Which splats have any weight in any pixel of the image: the exact support of the view's derivatives."""
    ones = torch.ones_like(torch.as_tensor(raster.crop(raster.planes)))
    return torch.as_tensor(raster.backward(raster.pad(to_backend(ones))).gradient)[:, 6] != 0
