"""Projection and SH colour: the specification against the textbook, the kernels against the specification."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from splat.backend.cpu.threads import over_range
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.harmonics import harmonics
from splat.model.settings import Antialias, RenderSettings
from splat.projection.cpu import attribute_arrays, project_adjoint, project_arrays, width_array
from splat.projection.formulas import GEOMETRY, lens_of
from splat.projection.linear_cpu import CpuProjection
from splat.projection.reference import Splats, project, rotation_matrices
from splat.render.backend import moments_of, plain_tangents
from tests.oracles import (
    central_difference,
    hessian_in_many_digits,
    real_harmonics,
    splat_in_many_digits,
    splat_of_gaussian,
)
from tests.splat.random_scenes import ANTIALIASED, MODES, filtered, random_camera, random_gaussians, random_like
from tests.splat.tolerances import DERIVATIVE, DTYPES, IMAGE, NUMPY, errors_by_block, relative_error

N, K, SETTINGS = 80, 3, RenderSettings(fov_clamp=0.9)
SPLAT_BLOCKS = {"means": slice(0, 2), "conics": slice(2, 5), "opacities": slice(5, 6), "colours": slice(6, 9)}
each_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
each_degree = pytest.mark.parametrize("degree", [0, 1, 2, 3])
each_case = pytest.mark.parametrize(
    ("degree", "mode"), [*((degree, "none") for degree in range(4)), *((3, m) for m in ANTIALIASED)]
)
THINNED = 6  # Gaussians of a scene that are too small for a pixel, where it is antialiased


def joined(splats: Splats) -> Tensor:
    """(n, 9), zero where a Gaussian is not drawn."""
    parts = (splats.means, splats.conics, splats.opacities[:, None], splats.colours)
    return torch.cat(parts, dim=1) * splats.drawn[:, None]


def camera_and_gaussians(degree: int, mode: Antialias = "none") -> tuple[Camera, Gaussians]:
    """Gaussians in front of the camera and behind it, inside the field of view and outside, some with a black channel."""
    gaussians = random_gaussians(N, degree, spread=2.5)
    gaussians.sh[:, 0] *= 4
    if mode != "none":
        gaussians.log_scales[:THINNED] -= torch.linspace(1, 6, THINNED)[:, None]
    return random_camera(75, 53, focal=60.0), filtered(gaussians, mode).to(torch.float32).to(torch.float64)


def settings_of(mode: Antialias) -> RenderSettings:
    return replace(MODES[mode], fov_clamp=SETTINGS.fov_clamp)


@dataclass(frozen=True)
class Truth:
    """Splats, gradient of bar . splats, and for K tangents U and cotangents C: P' U and P'^T C + (bar . P'') U."""

    splats: Tensor
    bar: Tensor
    gradient: Tensor
    U: Tensor
    C: Tensor
    pushed: Tensor
    pulled: Tensor


@cache
def truth(degree: int, mode: Antialias = "none") -> Truth:
    camera, gaussians = camera_and_gaussians(degree, mode)
    flat = gaussians.flat.clone().requires_grad_()
    splats = joined(project(gaussians.with_flat(flat), camera, settings_of(mode)))
    scale = torch.tensor([1, 1, 100, 100, 100, 1, 1, 1, 1], dtype=torch.float64)
    bar = (random_like((N, 9), 1) * scale).float().double().requires_grad_()
    C = (random_like((N, K, 9), 2) * scale).float().double()
    U = random_like((flat.numel(), K), 3).float().double()
    (gradient,) = torch.autograd.grad(splats, flat, bar, create_graph=True)
    pushed, pulled = [], []
    for k in range(K):
        second, forward = torch.autograd.grad((gradient * U[:, k]).sum(), (flat, bar), retain_graph=True)
        (first,) = torch.autograd.grad(splats, flat, C[:, k], retain_graph=True)
        pushed.append(forward)
        pulled.append(second + first)
    return Truth(
        splats.detach(), bar.detach(), gradient.detach(), U, C, torch.stack(pushed, dim=1), torch.stack(pulled, dim=1)
    )


def test_the_scene_has_clamped_hidden_and_black_gaussians():
    camera, gaussians = camera_and_gaussians(3)
    x, y, z = ((gaussians.means - camera.centre) @ camera.rotation.T).unbind(1)
    limit_x, limit_y = SETTINGS.fov_clamp * 75 / 2 / camera.fx, SETTINGS.fov_clamp * 53 / 2 / camera.fy
    drawn = z > SETTINGS.near
    assert (~drawn).any() and (drawn & (x / z > limit_x)).any() and (drawn & (x / z < -limit_x)).any()
    assert (drawn & (y / z > limit_y)).any() and (drawn & (y / z < -limit_y)).any()
    assert (truth(3).splats[drawn][:, 6:] == 0).any()


@each_degree
def test_the_specification_projects_as_the_textbook_does(degree):
    camera, gaussians = camera_and_gaussians(degree)
    splats = project(gaussians, camera, SETTINGS)
    clamp = SETTINGS.fov_clamp * 75 / 2 / camera.fx, SETTINGS.fov_clamp * 53 / 2 / camera.fy
    pinhole = (camera.fx, camera.fy, camera.cx, camera.cy)
    means, log_scales, quats, _, sh = (value.numpy() for value in gaussians.attributes.values())
    for i in torch.nonzero(splats.drawn)[:, 0].tolist():
        mean, covariance, colour, depth = splat_of_gaussian(
            means[i], log_scales[i], quats[i], sh[i], camera.rotation.numpy(), camera.centre.numpy(), pinhole, clamp,
            SETTINGS.blur,
        )  # fmt: skip
        conic = np.linalg.inv(covariance)[[0, 0, 1], [0, 1, 1]]
        assert relative_error(splats.means[i], mean) < 1e-12
        assert relative_error(splats.conics[i], conic) < 1e-13 * np.linalg.cond(covariance) + 1e-12
        assert relative_error(splats.colours[i], colour) < 1e-12
        assert splats.depths[i].item() == pytest.approx(depth, rel=1e-13)


def test_harmonics_are_those_of_legendre_with_the_condon_shortley_phase():
    directions = random_like((50, 3), 0)
    directions /= directions.norm(dim=1, keepdim=True)
    for degree in range(4):
        assert relative_error(harmonics(directions, degree), real_harmonics(directions.numpy(), degree)) < 1e-14


def test_rotations_do_not_depend_on_a_quaternions_length_or_sign():
    quats = random_like((20, 4), 0)
    rotations = rotation_matrices(quats)
    assert relative_error(rotation_matrices(-3.7 * quats), rotations) < 1e-15
    identity = torch.eye(3, dtype=torch.float64).expand(20, 3, 3)
    assert relative_error(rotations @ rotations.mT, identity) < 1e-15
    assert relative_error(torch.linalg.det(rotations), torch.ones(20)) < 1e-15


@each_dtype
@each_case
def test_the_kernel_projects_as_the_specification_does(degree, mode, dtype):
    camera, gaussians = camera_and_gaussians(degree, mode)
    splats, depths, drawn = project_arrays(gaussians.to(dtype), lens_of(camera, settings_of(mode)))
    expected = project(gaussians, camera, settings_of(mode))
    assert (drawn == expected.drawn.numpy()).all()
    errors = errors_by_block(torch.from_numpy(splats).T, truth(degree, mode).splats.T, SPLAT_BLOCKS)
    assert max(errors.values()) < IMAGE[dtype]
    assert relative_error(depths[drawn], expected.depths[expected.drawn]) < IMAGE[dtype]


@each_dtype
@each_case
def test_the_adjoint_is_the_gradient_of_the_specification(degree, mode, dtype):
    camera, gaussians = camera_and_gaussians(degree, mode)
    gaussians = gaussians.to(dtype)
    lens = lens_of(camera, settings_of(mode))
    splats, _, drawn = project_arrays(gaussians, lens)
    gradient, unmoved = (gaussians.with_flat(torch.full_like(gaussians.flat, torch.nan)) for _ in range(2))
    inputs = (*attribute_arrays(gaussians), width_array(gaussians, lens))
    bar = truth(degree, mode).bar.to(dtype).numpy()
    over_range(N, project_adjoint, lens, *inputs, splats, drawn, bar, *attribute_arrays(gradient))
    errors = errors_by_block(gradient.flat, truth(degree, mode).gradient, gaussians.blocks)
    assert max(errors.values()) < DERIVATIVE[dtype], errors
    over_range(N, project_adjoint, lens, *inputs, splats, drawn, 0 * bar, *attribute_arrays(unmoved))
    assert not unmoved.flat.any()


def linearized(degree: int, dtype: torch.dtype, mode: Antialias = "none") -> tuple[CpuProjection, Gaussians, Tensor]:
    """The projection at the truth's adjoint, its Gaussians, and the splats."""
    camera, gaussians = camera_and_gaussians(degree, mode)
    gaussians = gaussians.to(dtype)
    lens = lens_of(camera, settings_of(mode))
    splats, _, drawn = map(torch.from_numpy, project_arrays(gaussians, lens))
    moments = moments_of(splats, truth(degree, mode).bar.detach()).to(dtype)
    return CpuProjection(gaussians, lens, splats, moments, drawn.nonzero()[:, 0]), gaussians, splats


def each_converted(convert: Callable[[Tensor, Tensor], Tensor], splats: Tensor, numbers: Tensor) -> Tensor:
    """Tangents or adjoints (n, k, 9) in other coordinates."""
    return torch.stack([convert(splats, each.contiguous()) for each in numbers.unbind(1)], dim=1)


@each_dtype
@each_case
def test_jacobian_and_curvature_are_those_of_the_specification(degree, mode, dtype):
    projection, gaussians, splats = linearized(degree, dtype, mode)
    expected = truth(degree, mode)
    U, C = expected.U.to(dtype), each_converted(moments_of, splats, expected.C).to(dtype)
    pushed = each_converted(plain_tangents, splats, projection.jvp(U))
    errors = errors_by_block(pushed.permute(2, 0, 1), expected.pushed.permute(2, 0, 1), SPLAT_BLOCKS)
    assert max(errors.values()) < DERIVATIVE[dtype], errors
    errors = errors_by_block(projection.vjp(C, U), expected.pulled, gaussians.blocks)
    assert max(errors.values()) < DERIVATIVE[dtype], errors


@each_dtype
@pytest.mark.parametrize("mode", MODES)
def test_pulling_back_without_directions_is_the_transpose_of_pushing_forward(mode, dtype):
    projection, _, _ = linearized(3, dtype, mode)
    U, C = truth(3).U.to(dtype), truth(3).C.to(dtype)
    there, back = (projection.jvp(U) * C).double(), (projection.vjp(C) * U).double()
    eps = 30 * float(np.finfo(NUMPY[dtype]).eps)
    assert abs(there.sum() - back.sum()) < eps * (np.linalg.norm(there) + np.linalg.norm(back))


@pytest.mark.parametrize("mode", MODES)
def test_jacobian_and_curvature_agree_with_finite_differences(mode):
    camera, gaussians = camera_and_gaussians(3, mode)
    visible = project(gaussians, camera, SETTINGS)
    inside = visible.drawn & (visible.colours > 0.05).all(dim=1)
    x, y, z = ((gaussians.means - camera.centre) @ camera.rotation.T).unbind(1)
    for ratio, limit in ((x / z, 75 / camera.fx), (y / z, 53 / camera.fy)):
        inside &= ((ratio.abs() - SETTINGS.fov_clamp * limit / 2).abs() > 0.02) & (z > 1)
    gaussians = gaussians.select(inside)
    assert len(gaussians) > 20
    gaussians.log_scales[:] = gaussians.log_scales.clamp_min(-4)  # a step would cross the floor
    lens, bar = lens_of(camera, settings_of(mode)), truth(3).bar[inside].numpy()
    direction = random_like(gaussians.flat.shape, 4) * 0.3

    def splats(t: float) -> np.ndarray:
        return project_arrays(gaussians.with_flat(gaussians.flat + t * direction), lens)[0]

    def gradient(t: float) -> np.ndarray:
        moved = gaussians.with_flat(gaussians.flat + t * direction)
        result = moved.with_flat(torch.zeros_like(moved.flat))
        inputs = (*attribute_arrays(moved), width_array(moved, lens))
        values, _, drawn = project_arrays(moved, lens)
        arguments = (lens, *inputs, values, drawn, bar, *attribute_arrays(result))
        over_range(len(moved), project_adjoint, *arguments)
        return result.flat.numpy()

    at = torch.from_numpy(splats(0.0))
    moments = moments_of(at, torch.from_numpy(bar))
    projection, U = CpuProjection(gaussians, lens, at, moments, torch.arange(len(gaussians))), direction[:, None]
    pushed = projection.jvp(U)
    curvature = projection.vjp(torch.zeros_like(pushed), U)
    # step^4 = 1e-12 times a fifth derivative, and round-off 1e-16 / step
    assert relative_error(plain_tangents(at, pushed[:, 0]), central_difference(splats, 1e-3)) < 1e-9
    assert relative_error(curvature[:, 0], central_difference(gradient, 1e-3)) < 1e-9


@each_dtype
def test_conics_of_needles_keep_their_digits(dtype):
    n = 200
    generator = torch.Generator().manual_seed(0)
    gaussians = random_gaussians(n, spread=0.3)
    length = torch.linspace(-4, 2.8, n, dtype=torch.float64)
    gaussians.log_scales[:] = torch.stack([length, torch.full_like(length, -7), torch.full_like(length, -6)], dim=1)
    gaussians.quats[:] = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    gaussians = gaussians.to(torch.float32).to(torch.float64)
    camera = random_camera(504, 378, focal=400.0)
    pinhole = (camera.fx, camera.fy, camera.cx, camera.cy)
    clamp = (1.3 * 504 / 2 / camera.fx, 1.3 * 378 / 2 / camera.fy)
    splats = project_arrays(gaussians.to(dtype), lens_of(camera, RenderSettings()))[0].astype(np.float64)
    means, log_scales, quats, _, sh = (value.numpy() for value in gaussians.attributes.values())
    kappas = []
    for i in range(n):
        _, covariance, _, _ = splat_of_gaussian(
            means[i], log_scales[i], quats[i], sh[i], camera.rotation.numpy(), camera.centre.numpy(), pinhole, clamp, 0.3
        )  # fmt: skip
        a, b, c = np.linalg.inv(covariance)[[0, 0, 1], [0, 1, 1]]
        kappas.append(np.linalg.cond(covariance))
        # the oracle's own inverse loses kappa digits
        bound = 1e-6 if dtype == torch.float32 else 1e-15 * kappas[-1] + 1e-12
        assert np.abs((splats[i, 2:5] - [a, b, c]) / [a, np.sqrt(a * c), c]).max() < bound
    assert max(kappas) > 1e6 and min(kappas) < 10


def test_the_near_plane_hides_what_is_nearer_and_nothing_else():
    camera = Camera(torch.eye(3).double(), torch.zeros(3).double(), 10.0, 10.0, 5.0, 5.0, 10, 10)
    gaussians = random_gaussians(3)
    gaussians.means[:] = torch.tensor([[0, 0, 0.4999], [0, 0, 0.5001], [0, 0, -1.0]], dtype=torch.float64)
    settings = replace(RenderSettings(), near=0.5)
    splats, depths, drawn = project_arrays(gaussians, lens_of(camera, settings))
    assert drawn.tolist() == [False, True, False] == project(gaussians, camera, settings).drawn.tolist()
    assert not splats[[0, 2]].any() and splats[1].any() and depths[1] == 0.5001


HUGE = {
    "needle": (30.0, -1.5, -1.0), "pancake": (30.0, 29.0, -1.0), "ball": (30.0, 30.5, 30.0), "thin": (3.0, -10.8, -10.8),
}  # fmt: skip


@each_dtype
@pytest.mark.parametrize("mode", ["none", "mip-plain"])
@pytest.mark.parametrize("shape", HUGE)
def test_the_curvature_of_splats_beyond_all_measure_keeps_its_digits(shape, mode, dtype):
    camera, bar = random_camera(focal=50.0), random_like((1, 9), 3).to(dtype).numpy()
    gaussians = random_gaussians(1, spread=0.2)
    gaussians.log_scales[:] = torch.tensor(HUGE[shape])
    gaussians.quats[:] = torch.tensor([0.7, -0.4, 0.5, 0.3])
    gaussians = gaussians.to(dtype)
    lens = lens_of(camera, MODES[mode])
    splats = torch.from_numpy(project_arrays(gaussians, lens)[0])
    moments = moments_of(splats, torch.from_numpy(bar)).to(dtype)
    packed = (
        CpuProjection(gaussians, lens, splats, moments, torch.arange(1)).jacobian.curvature[0].numpy().astype(float)
    )
    curvature = np.zeros((GEOMETRY, GEOMETRY))
    curvature[np.tril_indices(GEOMETRY)] = packed
    pinhole = (camera.fx, camera.fy, camera.cx, camera.cy)

    opacity = float(gaussians.opacity_logits.double().sigmoid())
    factor_bar = 0.0 if mode == "none" else opacity * float(bar[0, 5])

    def along(point: list) -> object:
        splat = splat_in_many_digits(point, camera.rotation.numpy(), camera.centre.numpy(), pinhole, MODES[mode].blur)
        weights = [*map(float, bar[0, :5]), factor_bar]
        return sum(b * y for b, y in zip(weights, splat, strict=True))

    point = [*gaussians.means[0].tolist(), *gaussians.log_scales[0].tolist(), *gaussians.quats[0].tolist()]
    expected = np.tril(hessian_in_many_digits(along, point, 160))
    assert relative_error(curvature, expected) < DERIVATIVE[dtype]


def test_a_splat_too_large_for_its_derivatives_is_named():
    camera, gaussians = random_camera(focal=50.0), random_gaussians(5).to(torch.float32)
    lens = lens_of(camera, RenderSettings())
    gaussians.log_scales[3, 1] = 38.0
    gaussians.means[3] = torch.tensor([0.0, 0.0, 4.0])
    project_arrays(gaussians, lens)
    gaussians.log_scales[3, 1] = 40.0
    with pytest.raises(ValueError, match=r"expected log_scales of at most 3\d\.\d at depth .* at Gaussian 3 \(1 of 5"):
        project_arrays(gaussians, lens)
    gaussians.means[3, 2] = -4.0  # behind the camera it is not drawn
    project_arrays(gaussians, lens)
