"""Rendering as a torch function: the kernels against plain torch, to the second derivative."""

from itertools import product

import pytest
import torch
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.forward import rasterize_view
from splat.render.render import Backend, render, render_depth
from tests.splat.held_scenes import BACKGROUND
from tests.splat.random_scenes import random_camera, random_gaussians, random_like
from tests.splat.tiny import SMOOTH
from tests.splat.tolerances import DERIVATIVE, IMAGE, errors_by_block, relative_error

SIZES = [(48, 40), (1, 40), (40, 1), (7, 9)]


def everything(gaussians: Gaussians, camera: Camera, backend: Backend, settings: RenderSettings) -> dict[str, Tensor]:
    """Image, alpha, depth, the gradient of a functional of all three, and its Hessian times a vector."""
    h, w = camera.height, camera.width
    dtype = gaussians.flat.dtype
    weights, direction = random_like((5, h, w), 1).to(dtype), random_like(gaussians.flat.shape, 2).to(dtype)
    flat = gaussians.flat.clone().requires_grad_()
    shown = render(gaussians.with_flat(flat), camera, BACKGROUND, settings, depth=True, backend=backend)
    assert shown.depth is not None
    value = (
        (shown.image**2 * weights[:3]).sum() + (shown.alpha * weights[3]).sum() + (shown.depth**2 * weights[4]).sum()
    )
    (gradient,) = torch.autograd.grad(value, flat, create_graph=True)
    (curved,) = torch.autograd.grad((gradient * direction).sum(), flat)
    names = ("image", "alpha", "depth", "gradient", "product")
    values = (shown.image, shown.alpha, shown.depth, gradient, curved)
    return {name: value.detach() for name, value in zip(names, values, strict=True)}


def require_agreement(gaussians: Gaussians, camera: Camera, settings: RenderSettings, dtype=torch.float64) -> None:
    got = everything(gaussians.to(dtype), camera, "kernels", settings)
    expected = everything(gaussians, camera, "reference", settings)
    for name in ("image", "alpha", "depth"):
        assert got[name].dtype == dtype and relative_error(got[name], expected[name]) < IMAGE[dtype], name
    for name in ("gradient", "product"):
        errors = errors_by_block(got[name], expected[name], gaussians.blocks)
        assert max(errors.values()) < DERIVATIVE[dtype], (name, errors)


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("settings", [RenderSettings(), SMOOTH], ids=["default", "smooth"])
def test_kernels_and_plain_torch_agree_to_the_second_derivative(size, settings):
    gaussians, camera = random_gaussians(40, 3, logit=1.0), random_camera(*size, focal=30.0)
    require_agreement(gaussians, camera, settings)


SWITCHES = {
    "gradient_through_cap": (False, True), "alpha_min": (0.0, 1 / 255), "transmittance_min": (0.0, 1e-4),
    "contour_sigma": (None, 3.0), "alpha_max": (0.99, 0.6), "blur": (0.3, 0.0), "fov_clamp": (1.3, 0.1), "near": (0.2, 3.0),
}  # fmt: skip


@pytest.mark.parametrize("values", list(product(*SWITCHES.values())), ids=str)
def test_kernels_and_plain_torch_agree_for_every_combination_of_settings(values):
    settings = RenderSettings(**dict(zip(SWITCHES, values, strict=True)))
    gaussians, camera = random_gaussians(20, 1, logit=5.0), random_camera(36, 24, focal=60.0)
    gaussians.log_scales.sub_(1.0)  # far from a splat its alpha underflows
    require_agreement(gaussians, camera, settings)


@pytest.mark.parametrize("logit", [0.0, 5.0])
def test_training_and_probe_see_the_same_image_to_the_last_bit(logit):
    gaussians, camera = random_gaussians(60, 2, logit=logit).to(torch.float32), random_camera(300, 40, focal=200.0)
    gaussians.log_scales[::2] = torch.tensor([1.0, -6.0, -6.0])  # needles, whose conics float32 would not hold
    shown = render(gaussians, camera, BACKGROUND)
    raster = rasterize_view(gaussians, camera, BACKGROUND, RenderSettings())
    planes = raster.crop(raster.planes)
    assert torch.equal(shown.image, planes[:3]) and torch.equal(shown.alpha, planes[3])


def test_float32_renders_and_differentiates_within_its_tolerance():
    gaussians, camera = random_gaussians(40, 3, logit=-1.0), random_camera(focal=30.0)
    require_agreement(gaussians, camera, SMOOTH, torch.float32)


def test_depth_without_colours_is_that_of_a_whole_render():
    gaussians, camera = random_gaussians(40, 3, logit=1.0), random_camera(focal=30.0)
    whole = render(gaussians, camera, BACKGROUND, SMOOTH, depth=True)
    depth, alpha = render_depth(gaussians, camera, SMOOTH)
    assert torch.equal(depth, whole.depth) and torch.equal(alpha, whole.alpha)  # pyright: ignore[reportArgumentType]


def test_torchs_own_checks_of_first_and_second_derivatives_pass():
    gaussians, camera = random_gaussians(3, 1, spread=0.3), random_camera(16, 12, focal=16.0)

    def values(flat: Tensor) -> Tensor:
        shown = render(gaussians.with_flat(flat), camera, BACKGROUND, SMOOTH)
        return torch.cat([shown.image, shown.alpha[None]])[:, ::4, ::5]

    flat = gaussians.flat.clone().requires_grad_()
    assert torch.autograd.gradcheck(values, (flat,))
    assert torch.autograd.gradgradcheck(lambda flat: (values(flat) ** 2).sum(), (flat,))


def test_a_third_derivative_by_the_kernels_is_refused():
    gaussians, camera = random_gaussians(3), random_camera(16, 12, focal=16.0)
    flat = gaussians.flat.clone().requires_grad_()
    value = (render(gaussians.with_flat(flat), camera).image ** 2).sum()
    for _ in range(2):
        (gradient,) = torch.autograd.grad(value, flat, create_graph=True)
        value = (gradient**2).sum()
    with pytest.raises(NotImplementedError, match="expected at most two derivatives of the kernels, got a third"):
        torch.autograd.grad(value, flat)


def test_screen_space_gradients_are_reachable_for_densification():
    gaussians, camera = random_gaussians(20, logit=1.0), random_camera(focal=30.0)
    weights, gradients = random_like((3, camera.height, camera.width), 1), {}
    for backend in ("kernels", "reference"):
        flat = gaussians.flat.clone().requires_grad_()
        shown = render(gaussians.with_flat(flat), camera, backend=backend)
        (gradients[backend],) = torch.autograd.grad((shown.image * weights).sum(), shown.splats.means)
    assert relative_error(gradients["kernels"], gradients["reference"]) < 1e-12


def test_a_camera_that_sees_nothing_shows_the_background():
    gaussians, camera = random_gaussians(4), random_camera(16, 12)
    gaussians.means[:, 2] = -9.0
    for backend in ("kernels", "reference"):
        shown = render(gaussians, camera, BACKGROUND, depth=True, backend=backend)
        assert (shown.image == BACKGROUND[:, None, None]).all() and shown.depth is not None
        assert not shown.alpha.any() and not shown.depth.any() and not shown.splats.drawn.any()
    assert not render(gaussians, camera).image.any()  # black where no background is named
    assert render(gaussians, camera).depth is None


def test_order_within_the_set_does_not_matter_unless_depths_are_equal():
    gaussians, camera = random_gaussians(50, logit=2.0), random_camera(focal=30.0)
    image = render(gaussians, camera).image
    mixed = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    assert torch.equal(render(gaussians.select(mixed), camera).image, image)
    twins = gaussians.select(torch.tensor([7, 7]))
    twins.sh[1] = -twins.sh[0]
    facing = Camera(
        torch.eye(3, dtype=torch.float64), gaussians.means[7] - 2.0 * torch.eye(3)[2], 30.0, 30.0, 8.0, 6.0, 16, 12
    )
    one, other = (render(twins.select(torch.tensor(order)), facing).image for order in ([0, 1], [1, 0]))
    assert (one - other).abs().max() > 0.01  # the first of the set is in front


@pytest.mark.parametrize("backend", ["kernels", "reference"])
def test_nothing_to_draw_and_backgrounds_that_are_no_colour_are_refused(backend):
    gaussians, camera = random_gaussians(2), random_camera(16, 12)
    with pytest.raises(InputError, match="expected at least one Gaussian, got none"):
        render(gaussians.select(torch.arange(0)), camera, backend=backend)
    for colour in (torch.zeros(2), torch.zeros(3, 1), torch.tensor([0.0, float("nan"), 1.0])):
        with pytest.raises(InputError, match="expected a background of three finite numbers"):
            render(gaussians, camera, colour, backend=backend)


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits", "sh"])
def test_a_parameter_that_is_not_finite_is_named(name):
    gaussians = random_gaussians(6, 1)
    gaussians.attributes[name][4] = float("nan")
    for backend in ("kernels", "reference"):
        with pytest.raises(ValueError, match=f"expected finite {name}, got .*nan.* at Gaussian 4"):
            render(gaussians, random_camera(16, 12), backend=backend)
