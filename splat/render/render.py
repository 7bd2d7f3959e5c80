"""Render a view of a set of Gaussians: the one interface to the renderer's implementations."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import Splats, project
from splat.render.autograd import project_by_kernel, rasterize_by_kernel
from splat.render.forward import background_of
from splat.render.reference import rasterize_reference

Backend = Literal["kernels", "reference"]


@dataclass(frozen=True, eq=False)
class Rendering:
    """image: RGB in the encoding of the training images, background included, not clamped to [0, 1].

    alpha: accumulated opacity; splats: the 2-D footprints.
    depth: the sum of weight times z, world units (divide by alpha for a mean); None where it was not asked for.
    `splats.means` is on the autograd graph: its gradient is the screen-space gradient of densification.
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
    opacity_scale: Float[Tensor, " n"] | None = None,
    backend: Backend = "kernels",
) -> Rendering:
    """Colour, accumulated alpha and, if asked for, expected depth of one view; twice differentiable.

    background: RGB, black where None.  opacity_scale: constant factors of the opacities; may exceed 1, and 0 hides a Gaussian.
    backend: "kernels": those for the device of the Gaussians; "reference": plain torch (slow, any number of derivatives).
    Raises InputError where there is no Gaussian, or a parameter or the background is not finite.
    """
    gaussians.require_finite()
    background = background_of(gaussians, background)
    if backend == "reference":
        splats = _gained(project(gaussians, camera, settings), opacity_scale)
        image, alpha, expected = rasterize_reference(splats, background, camera.width, camera.height, settings)
        return Rendering(image, alpha, expected if depth else None, splats)
    splats = _gained(project_by_kernel(gaussians, camera, settings), opacity_scale)
    image, alpha = rasterize_by_kernel(splats, background, camera.width, camera.height, settings)
    expected = _layered_depth(splats, gaussians, camera, settings)[0] if depth else None
    return Rendering(image, alpha, expected, splats)


def render_depth(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings = RenderSettings()
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Expected depth and accumulated alpha of `render`, without a pass for the colours."""
    gaussians.require_finite()
    return _layered_depth(project_by_kernel(gaussians, camera, settings), gaussians, camera, settings)


def render_layers(
    gaussians: Gaussians, camera: Camera, layers: Float[Tensor, "n 3"], settings: RenderSettings = RenderSettings()
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"]]:
    """Three numbers of each Gaussian composited like a colour, on 0, and accumulated alpha."""
    gaussians.require_finite()
    return _layered(project_by_kernel(gaussians, camera, settings), layers, camera, settings)


def _gained(splats: Splats, opacity_scale: Float[Tensor, " n"] | None) -> Splats:
    if opacity_scale is None:
        return splats
    return replace(splats, opacities=splats.opacities * opacity_scale.to(splats.opacities))


def _layered_depth(
    splats: Splats, gaussians: Gaussians, camera: Camera, settings: RenderSettings
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Depth, which is composited like a colour, with z for red; and alpha."""
    axis, centre = camera.forward.to(gaussians.flat), camera.centre.to(gaussians.flat)
    z = (gaussians.means - centre) @ axis
    planes, alpha = _layered(
        splats, torch.stack([z, torch.zeros_like(z), torch.zeros_like(z)], dim=1), camera, settings
    )
    return planes[0], alpha


def _layered(
    splats: Splats, layers: Float[Tensor, "n 3"], camera: Camera, settings: RenderSettings
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"]]:
    """The splats with `layers` for their colours, on black; and alpha."""
    black = torch.zeros(3, dtype=layers.dtype)
    return rasterize_by_kernel(replace(splats, colours=layers), black, camera.width, camera.height, settings)
