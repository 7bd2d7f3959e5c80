"""The compositing kernels against the float64 specification, in both precisions."""

import numpy as np
import pytest
import torch
from torch import Tensor

from splat.backend.cpu.memory import PIXEL_ROWS, TILE_HEIGHT
from splat.backend.cpu.simd import lanes_of
from splat.model.settings import RenderSettings
from splat.render.backend import plain_gradient
from splat.render.cpu.raster import CpuRaster
from tests.oracles import central_difference
from tests.splat.render.compositing_cases import BLOCKS, CASES, plain_jvp, plain_product, truth
from tests.splat.tolerances import DERIVATIVE, DTYPES, IMAGE, NUMPY, relative_error

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
    planes = raster.crop(raster.planes).double()
    assert relative_error(planes * expected.decided, expected.planes * expected.decided) < IMAGE[dtype]


@each_dtype
@each_case
def test_the_gradient_is_that_of_the_specification(name, dtype):
    expected = truth(name)
    raster = expected.raster(dtype)
    gradient = plain_gradient(raster.splats, raster.backward(raster.pad(expected.G)).moments)
    assert errors(gradient, expected.gradient) == at_most(DERIVATIVE[dtype])


@pytest.mark.parametrize("K", [1, 3, 4])
@each_dtype
@each_case
def test_tangents_and_curvature_are_those_of_the_specification(name, dtype, K):
    expected = truth(name)
    raster = expected.raster(dtype)
    adjoint = raster.backward(raster.pad(expected.G))
    tangent = plain_jvp(raster, expected.U[:, :K])
    planes = raster.crop(tangent.planes).double() * expected.decided
    assert relative_error(planes, expected.jvp[:K] * expected.decided) < DERIVATIVE[dtype]
    product = plain_product(raster, tangent, adjoint, raster.pad(expected.dG[:K]))
    assert errors(product, expected.curvature[:, :K]) == at_most(DERIVATIVE[dtype])


def rasterized(splats: Tensor, name: str) -> CpuRaster:
    expected, background = truth(name), torch.tensor([0.3, 0.1, 0.7], dtype=torch.float64)
    return CpuRaster(splats, expected.depths, expected.drawn, background, *expected.case.size, expected.case.settings)


def test_tangents_and_their_adjoints_agree_with_finite_differences():
    expected, step = truth("smooth"), 2e-3
    splats, direction = expected.splats.clone(), expected.U[:, 0]
    splats[:, 5].clamp_(max=0.9)  # the cap stays out of reach
    raster = rasterized(splats, "smooth")
    tangent = plain_jvp(raster, direction[:, None])
    adjoint = raster.backward(raster.pad(expected.G))
    product = plain_product(raster, tangent, adjoint, torch.zeros_like(tangent.planes))[:, 0]

    def image(t: float) -> np.ndarray:
        moved = rasterized(splats + t * direction, "smooth")
        return moved.crop(moved.planes).numpy()

    def gradient(t: float) -> np.ndarray:
        moved = rasterized(splats + t * direction, "smooth")
        return plain_gradient(moved.splats, moved.backward(moved.pad(expected.G)).moments).numpy()

    # the error of the difference: step^4 = 2e-11 times a fifth derivative, and round-off 1e-16 / step
    assert relative_error(raster.crop(tangent.planes[0]), central_difference(image, step)) < 1e-8
    assert errors(product, central_difference(gradient, step)) == at_most(1e-8)


@each_dtype
@pytest.mark.parametrize("name", ["typical", "opaque", "capped", "smooth"])
def test_the_adjoint_is_the_transpose_of_the_tangent_and_curvature_is_symmetric(name, dtype):
    expected = truth(name)
    raster = expected.raster(dtype)
    G, U = expected.G, expected.U[:, :2]
    adjoint = raster.backward(raster.pad(G))
    tangent = plain_jvp(raster, U)
    product = plain_product(raster, tangent, adjoint, torch.zeros_like(tangent.planes))
    pushed, pulled = G * raster.crop(tangent.planes[0]), U[:, 0] * plain_gradient(raster.splats, adjoint.moments)
    one, other = U[:, 1] * product[:, 0], U[:, 0] * product[:, 1]
    # round-off of a sum of n terms of either sign: eps times the root of n times their root mean square, a few times over
    eps = 30 * np.finfo(NUMPY[dtype]).eps
    assert abs(pushed.sum() - pulled.sum()) < eps * np.linalg.norm(pulled) + eps * np.linalg.norm(pushed)
    assert abs(one.sum() - other.sum()) < eps * (np.linalg.norm(one) + np.linalg.norm(other))


@each_dtype
def test_nothing_drawn_is_the_background_and_has_no_derivative(dtype):
    expected = truth("one")
    width, height = expected.case.size
    splats, depths = torch.zeros(3, 9), torch.ones(3, dtype=dtype)
    background = torch.tensor([0.25, 0.5, 0.75])
    raster = CpuRaster(splats, depths, torch.zeros(3, dtype=torch.bool), background, width, height, RenderSettings())
    planes = raster.crop(raster.planes)
    assert (planes[:3] == background[:, None, None]).all() and (planes[3] == 0).all()
    adjoint = raster.backward(raster.pad(expected.G))
    tangent = raster.jvp(torch.ones(3, 2, 9))
    assert not adjoint.moments.any() and not tangent.planes.any()
    assert not tangent.backward_tangent(adjoint, raster.pad(expected.dG[:2])).any()


def test_a_view_of_no_gaussians_at_all_is_the_background():
    none = torch.zeros(0, 9)
    raster = CpuRaster(none, none[:, 0], none[:, 0].bool(), torch.ones(3), 20, 10, RenderSettings())
    assert (raster.crop(raster.planes)[:3] == 1).all()
    assert raster.backward(raster.planes).moments.shape == (0, 9)


def test_padding_outside_the_image_carries_no_derivative():
    expected = truth("less than a tile")
    raster = expected.raster(torch.float64)
    padded = raster.pad(torch.ones(4, raster.height, raster.width))
    assert padded.sum() == 4 * raster.height * raster.width


@pytest.mark.parametrize("K", [1, 3])
def test_tiles_with_a_cotangent_of_zero_are_left_out_and_add_nothing(monkeypatch, K):
    def poisoned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        return np.full(shape, np.nan, dtype)

    monkeypatch.setattr("splat.backend.cpu.memory.aligned", poisoned)  # what a tile leaves unwritten shows
    expected = truth("typical")
    raster = expected.raster(torch.float64)
    tangent = plain_jvp(raster, expected.U[:, :K])
    lit = torch.zeros(raster.height, raster.width, dtype=torch.float64)
    lit[:TILE_HEIGHT, :] = 1  # the first row of tiles
    lit[-1, -1] = 1  # and one pixel of the last
    curvature = torch.rand(3, *raster.plane, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    index = torch.arange(len(expected.splats))
    results = []
    for part in (torch.ones_like(lit), lit, 1 - lit):
        adjoint = raster.backward(raster.pad(part * expected.G))
        product = tangent.backward_tangent(adjoint, raster.pad(part * expected.dG[:K]))
        own = raster.gaussian_blocks(adjoint, raster.pad(part) * curvature, index, False)
        results.append((adjoint.moments, product, torch.tril(own)))
    for whole, one, other in zip(*results, strict=True):
        assert one.abs().max() > 0 and relative_error(one + other, whole) < 1e-13


def test_a_cotangent_that_is_not_a_number_is_not_taken_for_zero():
    raster = truth("typical").raster(torch.float64)
    cotangent = raster.pad(torch.zeros(4, raster.height, raster.width))
    cotangent[1, 20, 30] = torch.nan
    assert raster.backward(cotangent).moments.isnan().any()


@pytest.mark.parametrize("shift", [0.0, 2.0])
def test_a_splat_that_passes_to_the_next_tile_changes_the_draw_order(shift):
    tile = lanes_of(np.float64) // PIXEL_ROWS
    splats = torch.tensor([[tile / 2, 8.0, 9.0, 0.0, 9.0, 0.9, 1, 1, 1]] * 3, dtype=torch.float64)
    splats[:, 0] = torch.tensor([tile / 2, tile - 1.0, tile * 1.5])
    depths, drawn = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.ones(3, dtype=torch.bool)
    moved = splats.clone()
    moved[1, 0] += shift  # from the end of one tile's list to the start of the next one's

    def raster(splats: Tensor) -> CpuRaster:
        return CpuRaster(splats, depths, drawn, torch.zeros(3), 2 * tile, TILE_HEIGHT, RenderSettings())

    one, other = raster(splats), raster(moved)
    assert one.lists.splat.tolist() == other.lists.splat.tolist() == [0, 1, 2]
    assert (one.draw_order == other.draw_order) == (shift == 0)
