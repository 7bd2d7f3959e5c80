"""The specification itself, against a renderer written pixel by pixel from the textbook."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.render import Rendering, render
from tests.oracles import composited_picture, splat_of_gaussian
from tests.splat.random_scenes import random_camera, random_gaussians
from tests.splat.tiny import SMOOTH
from tests.splat.tolerances import relative_error

BACKGROUND = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)


def by_hand(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    clamp = (settings.fov_clamp * camera.width / (2 * camera.fx), settings.fov_clamp * camera.height / (2 * camera.fy))
    pinhole = (camera.fx, camera.fy, camera.cx, camera.cy)
    means, log_scales, quats, logits, sh = (value.numpy() for value in gaussians.attributes.values())
    pose = camera.rotation.numpy(), camera.centre.numpy(), pinhole, clamp, settings.blur
    rows = zip(means, log_scales, quats, sh, strict=True)
    splats = [splat_of_gaussian(*row, *pose) for row in rows]
    sigmas = np.inf if settings.contour_sigma is None else settings.contour_sigma
    return composited_picture(
        splats, 1 / (1 + np.exp(-logits)), BACKGROUND.numpy(), (camera.width, camera.height),
        near=settings.near, cap=settings.alpha_max, cut=settings.alpha_min, floor=settings.floor(torch.float64), sigmas=sigmas,
    )  # fmt: skip


def by_reference(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> Rendering:
    return render(gaussians, camera, BACKGROUND, settings, depth=True, backend="reference")


@pytest.mark.parametrize(
    ("settings", "logit"),
    [
        (RenderSettings(), 0.0),
        (RenderSettings(), 5.0),
        (RenderSettings(contour_sigma=3.0), 2.0),
        (SMOOTH, 0.0),
        (RenderSettings(blur=0.7, fov_clamp=0.8, near=3.5, alpha_max=0.9, alpha_min=0.05, transmittance_min=0.02), 3.0),
    ],
    ids=["default", "opaque", "contour", "smooth", "every threshold moved"],
)
def test_the_specification_renders_what_the_textbook_says(settings, logit):
    camera, gaussians = random_camera(21, 18, focal=25.0), random_gaussians(40, 2, logit=logit, spread=1.3)
    colour, alpha, depth = by_hand(gaussians, camera, settings)
    rendering = by_reference(gaussians, camera, settings)
    assert rendering.depth is not None
    assert relative_error(rendering.image, colour) < 1e-12
    assert relative_error(rendering.alpha, alpha) < 1e-12
    assert relative_error(rendering.depth, depth) < 1e-12


THRESHOLDS = {"alpha_max": 0.8, "alpha_min": 0.1, "transmittance_min": 0.1, "contour_sigma": 1.0}
THRESHOLDS |= {"blur": 1.0, "near": 4.0, "fov_clamp": 0.5}


@pytest.mark.parametrize("name", THRESHOLDS)
def test_every_threshold_shows_in_the_picture(name):
    camera, gaussians = random_camera(21, 18, focal=25.0), random_gaussians(40, 0, logit=3.0, spread=1.3)
    plain = by_reference(gaussians, camera, RenderSettings()).image
    moved = by_reference(gaussians, camera, replace(RenderSettings(), **{name: THRESHOLDS[name]})).image
    assert (plain - moved).abs().max() > 1e-3


@pytest.mark.parametrize("backend", ["reference", "kernels"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_second_splat_at_the_cap_stops_a_pixel_in_every_precision(dtype, backend):
    """The two would leave (1 - 0.99)^2, which is transmittance_min but for round-off."""
    camera, gaussians = random_camera(5, 5, focal=5.0), random_gaussians(2, 0).to(dtype)
    depths = torch.tensor([[2.0], [3.0]], dtype=dtype)
    gaussians.means[:] = camera.centre.to(dtype) + depths * camera.rotation[2].to(dtype)
    gaussians.log_scales[:], gaussians.opacity_logits[:] = 4.0, 20.0
    alpha = render(gaussians, camera, torch.zeros(3, dtype=dtype), backend=backend).alpha
    assert float((alpha - 0.99).abs().max()) < 1e-6
