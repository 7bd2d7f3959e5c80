"""The compositing kernels for GPUs against the float64 specification; on a machine without one, by Triton's interpreter."""

import os
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the kernels for GPUs need triton; pip install -e '.[gpu]'")

from splat.gpu.raster.raster import TOGETHER, CudaRaster, reduce_sums
from splat.model.settings import Accumulation, RenderSettings
from splat.projection.reference import Splats
from splat.render import autograd as functions
from splat.render.backend import plain_gradient
from splat.render.formulas import SPLAT
from tests.splat.gpu.interpreted import emulate
from tests.splat.render.compositing_cases import BACKGROUND, BLOCKS, CASES, TINY, plain_jvp, plain_product, truth
from tests.splat.tolerances import DERIVATIVE, DTYPES, IMAGE, relative_error

ALL = torch.cuda.is_available() or "LANDSCAPE_ALL_CASES" in os.environ  # ten minutes without a GPU
each_case = pytest.mark.parametrize("name", [*CASES, *TINY] if ALL else TINY)
each_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])


def vectors(name: str) -> int:
    """How many tangents a case is tested with: a full launch, and one more."""
    return TOGETHER + 1 if ALL or name == "tiny equal depths" else TOGETHER


@dataclass(frozen=True)
class Results:
    """All that the kernels compute of a case."""

    raster: CudaRaster
    gradient: Tensor
    jvp: Tensor
    curvature: Tensor


def raster_of(name: str, dtype: torch.dtype, device: torch.device, how: Accumulation = "deterministic") -> CudaRaster:
    expected = truth(name)
    splats, depths = expected.splats.to(device), expected.depths.to(device, dtype)
    settings = replace(expected.case.settings, accumulation=how)
    drawn, background = expected.drawn.to(device), BACKGROUND.to(device)
    return CudaRaster(splats, depths, drawn, background, *expected.case.size, settings)


@cache
def results(name: str, dtype: torch.dtype, device: torch.device, how: Accumulation = "deterministic") -> Results:
    expected, K = truth(name), vectors(name)
    raster = raster_of(name, dtype, device, how)
    adjoint = raster.backward(expected.G.to(device))
    tangent = plain_jvp(raster, expected.U[:, :K].to(device))
    product = plain_product(raster, tangent, adjoint, expected.dG[:K].to(device))
    return Results(raster, plain_gradient(raster.splats, adjoint.moments), tangent.planes, product)


def errors(got: Tensor, expected: Tensor) -> dict[str, float]:
    """The relative error of every attribute of splats (n, ..., 9)."""
    return {name: relative_error(got[..., rows].cpu(), expected[..., rows]) for name, rows in BLOCKS.items()}


def at_most(bound: float) -> dict[str, object]:
    return dict.fromkeys(BLOCKS, pytest.approx(0, abs=bound))


@each_dtype
@each_case
def test_colour_and_alpha_are_those_of_the_specification(name, dtype, device):
    expected, planes = truth(name), results(name, dtype, device).raster.planes.cpu()
    assert planes.dtype == dtype
    assert relative_error(planes * expected.decided, expected.planes * expected.decided) < IMAGE[dtype]


@each_dtype
@each_case
def test_the_gradient_is_that_of_the_specification(name, dtype, device):
    got = results(name, dtype, device).gradient
    assert got.dtype == torch.float64 and errors(got, truth(name).gradient) == at_most(DERIVATIVE[dtype])


@each_dtype
@each_case
def test_tangents_and_curvature_are_those_of_the_specification(name, dtype, device):
    expected, got, K = truth(name), results(name, dtype, device), vectors(name)
    jvp = got.jvp.cpu() * expected.decided
    assert relative_error(jvp, expected.jvp[:K] * expected.decided) < DERIVATIVE[dtype]
    assert errors(got.curvature, expected.curvature[:, :K]) == at_most(DERIVATIVE[dtype])


def test_the_cases_stop_pixels_leave_intersections_unreached_and_reach_the_cap(device):
    walled = results("tiny walled", torch.float64, device).raster
    assert walled.intersections_reached < walled.intersections
    for name in ("tiny capped", "tiny through the cap"):
        mx, my, a, b, c, opacity = truth(name).splats[:, :6].T[:, :, None, None]
        width, height = truth(name).case.size
        dx, dy = torch.arange(width) + 0.5 - mx, torch.arange(height)[:, None] + 0.5 - my
        alpha = opacity * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        assert (alpha > truth(name).case.settings.alpha_max).sum() >= 3
    for name in TINY:
        assert truth(name).planes[3].max() > 0.2 and truth(name).decided.double().mean() > 0.9


@pytest.mark.parametrize("name", [*CASES, *TINY] if ALL else ["tiny equal depths"])
def test_atomic_accumulation_differs_from_deterministic_by_round_off(name, device):
    one, other = results(name, torch.float64, device), results(name, torch.float64, device, how="atomic")
    assert torch.equal(one.raster.planes, other.raster.planes) and torch.equal(one.jvp, other.jvp)
    assert relative_error(one.gradient, other.gradient) < 1e-14
    assert relative_error(one.curvature, other.curvature) < 1e-13


@pytest.mark.parametrize("name", CASES if ALL else ["tiny equal depths"])
def test_results_are_the_same_to_the_last_bit_when_repeated(name, device):
    one, other = results(name, torch.float32, device), results.__wrapped__(name, torch.float32, device)
    assert torch.equal(one.gradient, other.gradient) and torch.equal(one.curvature, other.curvature)


@each_dtype
def test_own_blocks_are_those_of_the_cpu(dtype, device):
    expected, got = truth("tiny walled"), results("tiny walled", dtype, device).raster
    cpu, index = expected.raster(dtype), torch.arange(expected.case.n)
    h = torch.rand(3, got.height, got.width, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for gauss_newton in (False, True) if dtype == torch.float64 else (False,):
        adjoint = cpu.backward(cpu.pad(expected.G))
        want = cpu.gaussian_blocks(adjoint, cpu.pad(h), index, gauss_newton)
        blocks = got.gaussian_blocks(got.backward(expected.G.to(device)), h.to(device), index.to(device), gauss_newton)
        assert relative_error(blocks, want) < DERIVATIVE[dtype]


def test_a_splat_that_passes_to_the_next_tile_changes_the_draw_order(device):
    splats = torch.tensor([[8.0, 8.0, 9.0, 0.0, 9.0, 0.9, 1, 1, 1]] * 3, dtype=torch.float64)
    splats[:, 0] = torch.tensor([8.0, 15.0, 24.0])
    moved = splats.clone()
    moved[1, 0] = 17.0  # from the end of one tile's list to the start of the next one's
    depths, drawn = torch.tensor([1.0, 2.0, 3.0], device=device), torch.ones(3, dtype=torch.bool, device=device)
    one, same, other = (
        CudaRaster(each.to(device), depths, drawn, torch.zeros(3, device=device), 32, 16, RenderSettings())
        for each in (splats, splats, moved)
    )
    assert one.lists.splat.tolist() == other.lists.splat.tolist() == [0, 1, 2]
    assert one.draw_order == same.draw_order != other.draw_order


@each_dtype
def test_nothing_drawn_is_the_background_and_has_no_derivative(dtype, device):
    background = torch.tensor([0.25, 0.5, 0.75], device=device)
    splats, depths = torch.zeros(3, 9, device=device), torch.ones(3, dtype=dtype, device=device)
    for n in (3, 0):
        drawn = torch.zeros(n, dtype=torch.bool, device=device)
        raster = CudaRaster(splats[:n], depths[:n], drawn, background, 7, 5, RenderSettings())
        assert (raster.planes[:3] == background[:, None, None]).all() and (raster.planes[3] == 0).all()
        adjoint, tangent = raster.backward(raster.planes), raster.jvp(torch.ones(n, 2, 9, device=device))
        product = tangent.backward_tangent(adjoint, torch.zeros_like(tangent.planes))
        assert not adjoint.moments.any() and not tangent.planes.any() and not product.any()
        assert adjoint.moments.shape == (n, 9) and product.shape == (n, 2, 9)
        assert raster.intersections == len(raster.touched) == 0


def test_tiles_with_a_cotangent_of_zero_add_nothing(device):
    expected, raster = truth("tiny equal depths"), raster_of("tiny equal depths", torch.float64, device)
    tangent = plain_jvp(raster, expected.U[:, :1].to(device))
    whole = results("tiny equal depths", torch.float64, device)
    lit = torch.zeros(raster.height, raster.width, device=device, dtype=torch.float64)
    lit[:, :16] = 1  # the first of two tiles
    gradients, products = [], []
    for part in (lit, 1 - lit):
        adjoint = raster.backward(part * expected.G.to(device))
        curvature = (1 - part).expand(3, -1, -1)
        assert (raster.dark_tiles(adjoint, 0 * curvature), raster.dark_tiles(adjoint, curvature)) == (1, 0)
        gradients.append(plain_gradient(raster.splats, adjoint.moments))
        products.append(plain_product(raster, tangent, adjoint, part * expected.dG[:1].to(device)))
    assert min(gradient.abs().max() for gradient in gradients) > 0
    assert relative_error(gradients[0] + gradients[1], whole.gradient) < 1e-13
    assert relative_error(products[0] + products[1], whole.curvature[:, :1]) < 1e-13


def test_tiles_in_which_no_splat_is_moved_are_left_out(device):
    expected, raster = truth("tiny equal depths"), raster_of("tiny equal depths", torch.float64, device)
    # it alone is in the second of two tiles
    assert raster.lists.start.tolist() == [0, 4, 5] and raster.lists.splat[4] == 3
    U, dG = expected.U[:, : TOGETHER + 1].to(device), expected.dG[: TOGETHER + 1].to(device)
    moved, lit = torch.ones_like(U), torch.ones_like(dG)
    moved[[0, 3]], moved[:, 0], moved[:, TOGETHER, :6], lit[..., 16:] = 0, 0, 0, 0
    adjoint = raster.backward(expected.G.to(device))

    def products(U: Tensor, dG: Tensor) -> tuple[Tensor, Tensor]:
        tangent = plain_jvp(raster, U)
        return tangent.planes, plain_product(raster, tangent, adjoint, dG)

    part, rest = products(moved * U, dG), products((1 - moved) * U, 0 * dG)
    whole = results("tiny equal depths", torch.float64, device)
    for one, other, both in zip(part, rest, (whole.jvp, whole.curvature), strict=True):
        assert relative_error(one + other, both) < 1e-13
    within = products(moved * U, lit * dG)
    raster.params[0], raster.lists.splat[4] = torch.nan, 0  # whoever goes through the second tile comes upon this
    assert all(torch.equal(*pair) for pair in zip(within, products(moved * U, lit * dG), strict=True))
    assert all(product.isnan().any() for product in products(U, dG))


def test_a_cotangent_that_is_not_a_number_is_not_taken_for_zero(device):
    raster = raster_of("tiny smooth", torch.float64, device)
    cotangent = torch.zeros_like(raster.planes)
    cotangent[1, raster.planes[3].argmax() // raster.width, raster.planes[3].argmax() % raster.width] = torch.nan
    assert raster.backward(cotangent).moments.isnan().any()


def test_the_touched_splats_are_those_with_accumulators(device):
    raster = results("tiny walled", torch.float64, device).raster
    found = raster.accumulators
    assert raster.touched.tolist() == (found.last > found.first).nonzero()[:, 0].tolist()
    assert 0 < len(raster.touched) < len(raster.splats)
    assert raster.bytes > raster.params.nbytes


def test_accumulators_are_summed_however_many_a_splat_has(device):
    numbers, K, width = torch.tensor([0, 1, 40, 16, 0, 3]), 2, SPLAT
    last = numbers.cumsum(0)
    sums = torch.randn(int(last[-1]), K, width, generator=torch.Generator().manual_seed(0))
    totals = torch.full((len(numbers), K, width), torch.nan, dtype=torch.float64, device=device)
    reduce_sums((last - numbers).to(device), last.to(device), sums.to(device), totals)
    expected = torch.stack([part.double().sum(0) for part in sums.split(numbers.tolist())])
    assert torch.allclose(totals.cpu(), expected, rtol=0, atol=1e-14)


def test_as_a_torch_function_it_has_the_derivatives_of_the_cpu(device, monkeypatch):
    expected = truth("tiny equal depths")
    splats = expected.splats.to(device)
    drawn = (expected.depths.to(device), expected.drawn.to(device))
    found = []
    for where, emulated in ((torch.device("cpu"), False), (device, device.type == "cpu")):
        emulate(monkeypatch, emulated)
        parts = [part.to(where).requires_grad_() for part in splats.split((2, 3, 1, 3), dim=1)]
        shown = Splats(parts[0], parts[1], parts[2][:, 0], parts[3], *(tensor.to(where) for tensor in drawn))
        about = BACKGROUND.to(where), *expected.case.size, expected.case.settings
        image, alpha = functions.rasterize_by_kernel(shown, *about)
        loss = image.square().sum() + (alpha * image[0]).sum()
        gradient = torch.cat(torch.autograd.grad(loss, parts, create_graph=True), dim=1)
        product = torch.autograd.grad((gradient * expected.U[:, 0].to(where)).sum(), parts)
        found.append((gradient.detach().cpu(), torch.cat(product, dim=1).cpu()))
    for one, other in zip(*found, strict=True):
        assert relative_error(one, other) < DERIVATIVE[torch.float64]
