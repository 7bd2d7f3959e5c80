"""The compositing kernels against the float64 specification, in both precisions."""

import numpy as np
import pytest
import torch

from splat.backend.cpu.planes import TILE_ROWS
from splat.model.settings import RenderSettings
from splat.raster.cpu.raster import Raster
from tests.oracles import central_difference
from tests.splat.random_scenes import DERIVATIVE, DTYPES, IMAGE, NUMPY, relative_error
from tests.splat.raster.compositing_cases import BLOCKS, CASES, truth

each_case = pytest.mark.parametrize("name", CASES)
each_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])


def errors(got, expected) -> dict[str, float]:
    """The relative error of every attribute of splats (n, ..., 9)."""
    return {name: relative_error(got[..., rows], expected[..., rows]) for name, rows in BLOCKS.items()}


def at_most(bound: float) -> dict[str, object]:
    return dict.fromkeys(BLOCKS, pytest.approx(0, abs=bound))


@each_case
def test_float32_decides_as_float64_but_for_a_few_pixels(name):
    assert truth(name).decided.double().mean() > 0.9


def test_the_cases_stop_pixels_reach_the_cap_and_draw_something():
    stops = truth("opaque").raster(torch.float64).pixels.stop
    assert (stops < 1e29).mean() > 0.05
    for name in ("opaque", "capped", "through the cap"):
        assert (truth(name).splats[:, 5] > 0.99).double().mean() > 0.2
    for name in CASES:
        assert truth(name).planes[3].max() > 0.2


@each_dtype
@each_case
def test_colour_and_alpha_are_those_of_the_specification(name, dtype):
    expected = truth(name)
    raster = expected.raster(dtype)
    planes = torch.from_numpy(raster.crop(raster.planes).astype(np.float64))
    assert relative_error(planes * expected.decided, expected.planes * expected.decided) < IMAGE[dtype]


@each_dtype
@each_case
def test_the_gradient_is_that_of_the_specification(name, dtype):
    expected = truth(name)
    raster = expected.raster(dtype)
    gradient = raster.backward(raster.pad(expected.G.numpy())).gradient
    assert errors(gradient, expected.gradient) == at_most(DERIVATIVE[dtype])


@pytest.mark.parametrize("K", [1, 3, 4])
@each_dtype
@each_case
def test_tangents_and_curvature_are_those_of_the_specification(name, dtype, K):
    expected = truth(name)
    raster = expected.raster(dtype)
    adjoint = raster.backward(raster.pad(expected.G.numpy()))
    tangent = raster.jvp(expected.U[:, :K].numpy())
    planes = torch.from_numpy(raster.crop(tangent.planes).astype(np.float64)) * expected.decided
    assert relative_error(planes, expected.jvp[:K] * expected.decided) < DERIVATIVE[dtype]
    product = tangent.curvature(adjoint, raster.pad(expected.dG[:K].numpy()))
    assert errors(product, expected.curvature[:, :K]) == at_most(DERIVATIVE[dtype])


def held(splats: np.ndarray, name: str, settings: RenderSettings) -> Raster:
    expected = truth(name)
    width, height = expected.case.size
    background = np.array([0.3, 0.1, 0.7])
    return Raster(splats, expected.depths.numpy(), expected.drawn.numpy(), background, width, height, settings)


def test_tangents_and_curvature_agree_with_finite_differences():
    expected, settings = truth("smooth"), CASES["smooth"].settings
    splats, direction, step = expected.splats.numpy().copy(), expected.U[:, 0].numpy(), 2e-3
    splats[:, 5] = np.minimum(splats[:, 5], 0.9)  # the cap stays out of reach
    G = expected.G.numpy()
    raster = held(splats, "smooth", settings)
    tangent = raster.jvp(direction[:, None])
    product = tangent.curvature(raster.backward(raster.pad(G)), np.zeros_like(tangent.planes))[:, 0]

    def image(t: float) -> np.ndarray:
        moved = held(splats + t * direction, "smooth", settings)
        return moved.crop(moved.planes)

    def gradient(t: float) -> np.ndarray:
        moved = held(splats + t * direction, "smooth", settings)
        return moved.backward(moved.pad(G)).gradient

    # the error of the difference: step^4 = 2e-11 times a fifth derivative, and round-off 1e-16 / step
    assert relative_error(raster.crop(tangent.planes[0]), central_difference(image, step)) < 1e-8
    assert errors(product, central_difference(gradient, step)) == at_most(1e-8)


@each_dtype
@pytest.mark.parametrize("name", ["typical", "opaque", "capped", "smooth"])
def test_the_adjoint_is_the_transpose_of_the_tangent_and_curvature_is_symmetric(name, dtype):
    expected = truth(name)
    raster = expected.raster(dtype)
    G, U = expected.G.numpy(), expected.U[:, :2].numpy()
    adjoint = raster.backward(raster.pad(G))
    tangent = raster.jvp(U)
    product = tangent.curvature(adjoint, np.zeros_like(tangent.planes)).astype(np.float64)
    pushed, pulled = G * raster.crop(tangent.planes[0]), U[:, 0] * adjoint.gradient
    one, other = U[:, 1] * product[:, 0], U[:, 0] * product[:, 1]
    # round-off of a sum of n terms of either sign: eps times the root of n times their root mean square, a few times over
    eps = 30 * np.finfo(NUMPY[dtype]).eps
    assert abs(pushed.sum() - pulled.sum()) < eps * np.linalg.norm(pulled) + eps * np.linalg.norm(pushed)
    assert abs(one.sum() - other.sum()) < eps * (np.linalg.norm(one) + np.linalg.norm(other))


@each_dtype
def test_nothing_drawn_is_the_background_and_has_no_derivative(dtype):
    expected = truth("one")
    width, height = expected.case.size
    splats, depths = np.zeros((3, 9), NUMPY[dtype]), np.ones(3, NUMPY[dtype])
    background = np.array([0.25, 0.5, 0.75])
    raster = Raster(splats, depths, np.zeros(3, np.bool_), background, width, height, RenderSettings())
    planes = raster.crop(raster.planes)
    assert (planes[:3] == background[:, None, None]).all() and (planes[3] == 0).all()
    adjoint = raster.backward(raster.pad(expected.G.numpy()))
    tangent = raster.jvp(np.ones((3, 2, 9)))
    assert not adjoint.gradient.any() and not tangent.planes.any()
    assert not tangent.curvature(adjoint, raster.pad(expected.dG[:2].numpy())).any()


def test_a_view_of_no_gaussians_at_all_is_the_background():
    none = np.zeros((0, 9), np.float32)
    raster = Raster(none, none[:, 0], np.zeros(0, np.bool_), np.ones(3), 20, 10, RenderSettings())
    assert (raster.crop(raster.planes)[:3] == 1).all()
    assert raster.backward(raster.planes).gradient.shape == (0, 9)


def test_padding_outside_the_image_carries_no_derivative():
    expected = truth("less than a tile")
    raster = expected.raster(torch.float64)
    padded = raster.pad(np.ones((4, raster.height, raster.width)))
    assert padded.sum() == 4 * raster.height * raster.width


@pytest.mark.parametrize("K", [1, 3])
def test_tiles_with_a_cotangent_of_zero_are_left_out_and_add_nothing(monkeypatch, K):
    def poisoned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        return np.full(shape, np.nan, dtype)

    monkeypatch.setattr("splat.backend.cpu.planes.aligned", poisoned)  # what a tile leaves unwritten shows
    expected = truth("typical")
    raster = expected.raster(torch.float64)
    tangent = raster.jvp(expected.U[:, :K].numpy())
    lit = np.zeros((raster.height, raster.width))
    lit[:TILE_ROWS, :] = 1  # the first row of tiles
    lit[-1, -1] = 1  # and one pixel of the last
    curvature = np.random.default_rng(0).random((3, *raster.plane))
    index = np.arange(len(expected.splats))
    results = []
    for part in (np.ones_like(lit), lit, 1 - lit):
        adjoint = raster.backward(raster.pad(part * expected.G.numpy()))
        product = tangent.curvature(adjoint, raster.pad(part * expected.dG[:K].numpy()))
        own = raster.gaussian_blocks(adjoint, raster.pad(part) * curvature, index, False)
        results.append((adjoint.gradient, product, np.tril(own)))
    for whole, one, other in zip(*results, strict=True):
        assert np.abs(one).max() > 0 and relative_error(one + other, whole) < 1e-13


def test_a_cotangent_that_is_not_a_number_is_not_taken_for_zero():
    raster = truth("typical").raster(torch.float64)
    cotangent = raster.pad(np.zeros((4, raster.height, raster.width)))
    cotangent[1, 20, 30] = np.nan
    assert np.isnan(raster.backward(cotangent).gradient).any()
