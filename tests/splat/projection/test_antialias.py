"""Antialiased opacities against the equations that each tool publishes, and Mip-Splatting's 3-D filter against its own code."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from landscape.errors import InputError
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.antialias import baked, sampling_widths
from splat.projection.reference import project
from splat.render.render import render
from splat.training.densify import reset_opacities
from splat.training.origin.presets import PRESETS, render_of
from tests.oracles import composited_picture, splat_of_gaussian
from tests.refusals import refused
from tests.splat.random_scenes import MODES, filtered, random_camera, random_gaussians

Factor = Callable[[np.ndarray, float], float]
SIZE = 24, 18
BACKGROUND = np.array([0.2, 0.5, 0.9])


def graphdeco(covariance: np.ndarray, blur: float) -> float:
    """diff-gaussian-rasterization, forward.cu: h_convolution_scaling."""
    before = covariance[0, 0] * covariance[1, 1] - covariance[0, 1] ** 2
    after = (covariance[0, 0] + blur) * (covariance[1, 1] + blur) - covariance[0, 1] ** 2
    return np.sqrt(max(0.000025, before / after))


def gsplat(covariance: np.ndarray, blur: float) -> float:
    """gsplat 1.5, add_blur: compensation."""
    return np.sqrt(max(0.0, np.linalg.det(covariance) / np.linalg.det(covariance + blur * np.eye(2))))


def mip_splatting(covariance: np.ndarray, blur: float) -> float:
    """Mip-Splatting, forward.cu: coef."""
    before, after = (max(1e-6, np.linalg.det(covariance + k * np.eye(2))) for k in (0.0, blur))
    return 0.0 if before <= 1e-6 or after <= 1e-6 else np.sqrt(before / (after + 1e-6) + 1e-6)


PUBLISHED: dict[str, tuple[Factor, float]] = {
    "graphdeco": (graphdeco, 0.3),
    "gsplat-1.6": (graphdeco, 0.3),
    "gsplat": (gsplat, 0.3),
    "nerfstudio": (gsplat, 0.3),
    "brush": (gsplat, 0.1),
    "mip-splatting": (mip_splatting, 0.1),
}


def scene(*, with_filter: bool) -> Gaussians:
    """From far larger than a pixel to far smaller, and thin ones."""
    gaussians = random_gaussians(30, 1, seed=3, logit=2.0, spread=0.8)
    gaussians.log_scales[:12] -= torch.linspace(0, 7, 12)[:, None]
    gaussians.log_scales[12:18, 1] -= torch.linspace(1, 9, 6)
    if with_filter:
        gaussians = filtered(gaussians, "mip-splatting")
        assert gaussians.filter_widths is not None
        gaussians.filter_widths[::2] = 0  # too small for a pixel all the same
    return gaussians


@pytest.mark.parametrize("name", PUBLISHED)
def test_pictures_under_a_preset_are_those_of_its_tools_equations(name):
    factor, blur = PUBLISHED[name]
    with_filter = name == "mip-splatting"
    settings = render_of(PRESETS[name], {}, antialiased=True)
    gaussians, camera = scene(with_filter=with_filter), random_camera(*SIZE, focal=30.0)
    means, log_scales, quats, logits, sh = (value.numpy() for value in gaussians.attributes.values())
    opacities = 1 / (1 + np.exp(-logits))
    if with_filter:
        assert gaussians.filter_widths is not None
        squares, added = np.exp(2 * log_scales), gaussians.filter_widths.numpy()[:, None] ** 2
        opacities = opacities * np.sqrt(squares.prod(axis=1) / (squares + added).prod(axis=1))
        log_scales = np.log(np.sqrt(squares + added))
    pinhole = (camera.fx, camera.fy, camera.cx, camera.cy)
    limits = (1.3 * SIZE[0] / 2 / camera.fx, 1.3 * SIZE[1] / 2 / camera.fy)
    frame = (camera.rotation.numpy(), camera.centre.numpy(), pinhole, limits)
    sharp = [splat_of_gaussian(*each, *frame, 0.0) for each in zip(means, log_scales, quats, sh, strict=True)]
    factors = np.array([factor(covariance, blur) for _, covariance, _, _ in sharp])
    assert factors.min() < 0.01 and factors.max() > 0.9
    blurred = [(mean, covariance + blur * np.eye(2), colour, z) for mean, covariance, colour, z in sharp]
    expected, alpha, _ = composited_picture(
        blurred, opacities * factors, BACKGROUND, SIZE, near=settings.near, cap=settings.alpha_max, cut=1 / 255,
        floor=1e-4,
    )  # fmt: skip
    found = render(gaussians, camera, torch.from_numpy(BACKGROUND), settings, backend="reference")
    assert np.abs(found.image.numpy() - expected).max() < 1e-9
    assert np.abs(found.alpha.numpy() - alpha).max() < 1e-9
    kernels = render(gaussians, camera, torch.from_numpy(BACKGROUND), settings)
    assert float((kernels.image - found.image).abs().max()) < 1e-12
    plain = render(gaussians, camera, torch.from_numpy(BACKGROUND), replace(settings, antialias="none"))
    assert float((plain.image - found.image).abs().max()) > 0.01


def test_mip_splattings_blur_is_its_kernel_size():
    assert render_of(PRESETS["mip-splatting"], {"kernel_size": 0.3}, antialiased=True).blur == 0.3


@pytest.mark.parametrize("mode", MODES)
def test_a_filter_that_is_baked_in_leaves_every_splat_as_it_was(mode):
    gaussians, camera = scene(with_filter=True), random_camera()
    before, after = (project(each, camera, MODES[mode]) for each in (gaussians, baked(gaussians)))
    for name in ("means", "conics", "opacities"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=1e-11, atol=1e-14)
    assert baked(gaussians).filter_widths is None and baked(baked(gaussians)).filter_widths is None


def test_the_filters_widths_are_those_of_mip_splattings_training():
    gaussians = random_gaussians(200, spread=3.0)
    cameras = [random_camera(40, 30, seed=seed, focal=focal) for seed, focal in ((0, 30.0), (1, 45.0), (2, 38.0))]
    distance, valid = np.full(200, 100000.0), np.zeros(200, bool)
    for camera in cameras:
        x, y, z = ((gaussians.means - camera.centre) @ camera.rotation.T).numpy().T
        u, v = x / np.maximum(z, 0.001) * camera.fx + camera.cx, y / np.maximum(z, 0.001) * camera.fy + camera.cy
        inside = (u >= -0.15 * 40) & (u <= 1.15 * 40) & (v >= -0.15 * 30) & (v <= 1.15 * 30) & (z > 0.2)
        distance[inside] = np.minimum(distance[inside], z[inside])
        valid |= inside
    assert 0 < valid.sum() < 200
    distance[~valid] = distance[valid].max()
    np.testing.assert_allclose(sampling_widths(gaussians, cameras), distance / 45.0 * 0.2**0.5, rtol=1e-12)
    gaussians.means[:, 2] = -9.0
    refused("expected a camera", sampling_widths, gaussians, cameras)


def test_a_reset_lowers_opacities_under_the_filter():
    gaussians = scene(with_filter=True)
    squares = (2 * gaussians.log_scales).exp()
    assert gaussians.filter_widths is not None
    wide = squares + gaussians.filter_widths[:, None].square()
    factor = (squares.prod(dim=1) / wide.prod(dim=1)).sqrt()
    before = gaussians.opacity_logits.sigmoid() * factor
    reset_opacities(gaussians, 0.01)
    torch.testing.assert_close(gaussians.opacity_logits.sigmoid() * factor, before.clamp_max(0.01))


def test_widths_are_one_for_each_gaussian_and_not_negative():
    gaussians = random_gaussians(4)
    refused("expected 4 filter widths", gaussians.with_filter, torch.zeros(3))
    with pytest.raises(InputError, match=r"non-negative filter_widths, got -1\.0 at Gaussian 2"):
        gaussians.with_filter(torch.tensor([0.0, 1.0, -1.0, 2.0])).require_finite()
    refused("'antialias': expected 'none' or 'mip'", RenderSettings, antialias="sharp")
