"""Project and composite a view without derivatives, and find the Gaussians that touch it."""

from math import isfinite

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.formulas import lens_of
from splat.render.backend import Raster, backend_of


def rasterize_view(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, "3"],
    settings: RenderSettings,
    *,
    finite: bool = False,
) -> Raster:
    """Project and composite a view by the kernels where the Gaussians are; finite: they are known to be, and not checked."""
    if not finite:
        gaussians.require_finite()
    backend = backend_of(gaussians.flat)
    splats = backend.project(gaussians, lens_of(camera, settings))
    background = background.to(gaussians.flat, non_blocking=True)
    return backend.rasterize(*splats, background, camera.width, camera.height, settings)


def background_of(gaussians: Gaussians, colour: Float[Tensor, "3"] | None) -> Float[Tensor, "3"]:
    """The colour behind the Gaussians, in their type and where they are; black where None.

    InputError where it is not three finite numbers.
    """
    if colour is None:
        return gaussians.flat.new_zeros(3)
    if colour.shape != (3,) or not all(map(isfinite, colour.tolist())):
        raise InputError(f"expected a background of three finite numbers, red, green and blue, got {colour.tolist()}")
    return colour.to(gaussians.flat, non_blocking=True)


def touches(raster: Raster) -> Bool[Tensor, " n"]:
    """Mask of the splats with weight in some pixel of the image: the exact support of the view's derivatives."""
    return weights(raster) != 0


def weights(raster: Raster) -> Float[Tensor, " n"]:
    """The sum of alpha T over the pixels: the derivative of a channel's sum in each splat's colour."""
    ones = torch.ones_like(raster.crop(raster.planes))
    return raster.backward(raster.pad(ones)).moments[:, 6]
