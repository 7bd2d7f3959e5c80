"""A view held still, against the specification, dense matrices and finite differences."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splat.backend.cpu.memory import PIXEL_ROWS, TILE_HEIGHT
from splat.backend.cpu.simd import lanes_of
from splat.curvature.hessian import SceneHessian
from splat.curvature.linearize import LinearizedView
from splat.curvature.objective import SceneObjective
from splat.losses.cpu.loss import CpuViewLoss
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.settings import Antialias, RenderSettings
from splat.projection.reference import project
from splat.render.render import render
from splat.scenes.view import View
from tests.oracles import central_difference
from tests.refusals import misused, refused
from tests.splat.held_scenes import BACKGROUND, gradient_and_products, mean_loss, two_views
from tests.splat.photometric import photometric_loss
from tests.splat.random_scenes import ANTIALIASED, MODES, filtered, random_camera, random_gaussians, random_like
from tests.splat.tiny import SMOOTH
from tests.splat.tolerances import DERIVATIVE, DTYPES, IMAGE, NUMPY, errors_by_block, relative_error

LOSSES = [
    LossSettings(),
    LossSettings("charbonnier"),
    LossSettings("l2", ssim_weight=0.5, literal=True),
    LossSettings("l2", ssim_weight=0),
]
each_loss = pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: f"{loss.pixel} {loss.ssim_weight}")
each_mode = pytest.mark.parametrize("mode", MODES)
each_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
OPAQUE = RenderSettings(contour_sigma=3.0)


def smooth(mode: Antialias) -> RenderSettings:
    return replace(SMOOTH, antialias=MODES[mode].antialias, blur=MODES[mode].blur)


def hold(
    gaussians: Gaussians,
    view: View,
    loss: LossSettings,
    dtype: torch.dtype = torch.float64,
    settings: RenderSettings = RenderSettings(),
) -> LinearizedView:
    target = CpuViewLoss(view.image.to(dtype), loss, dtype)
    return LinearizedView(gaussians.to(dtype), view.camera, target, BACKGROUND, settings)


@pytest.mark.parametrize(("degree", "mode"), [*((d, "none") for d in range(4)), *((1, mode) for mode in ANTIALIASED)])
@each_loss
def test_value_gradient_and_hessian_products_are_those_of_the_specification(loss, degree, mode):
    gaussians, view = filtered(random_gaussians(40, degree, logit=1.0), mode), two_views()[0]
    gaussians.log_scales[:3] -= torch.tensor([[2.0], [4.0], [6.0]])  # C at its floor, where there is one
    settings, U = MODES[mode], random_like((gaussians.flat.numel(), 3), 1)
    gradient, products = gradient_and_products(gaussians, [view], loss, U, settings)
    held = hold(gaussians, view, loss, settings=settings)
    assert held.value == pytest.approx(float(mean_loss(gaussians, [view], loss, settings)), rel=1e-13)
    assert max(errors_by_block(held.gradient, gradient, gaussians.blocks).values()) < 1e-12
    for k in (1, 3):
        errors = errors_by_block(held.hvp(U[:, :k]), products[:, :k], gaussians.blocks)
        assert max(errors.values()) < 1e-12, errors


@pytest.mark.parametrize(
    ("settings", "logit"), [(OPAQUE, 4.0), (SMOOTH, 0.0), (RenderSettings(gradient_through_cap=True), 6.0)]
)
def test_every_kind_of_threshold_is_held_as_the_specification_holds_it(settings, logit):
    gaussians, view = random_gaussians(60, 1, logit=logit, spread=0.8), two_views()[1]
    loss = LossSettings("charbonnier")
    U = random_like((gaussians.flat.numel(), 2), 1)
    gradient, products = gradient_and_products(gaussians, [view], loss, U, settings)
    held = hold(gaussians, view, loss, settings=settings)
    assert max(errors_by_block(held.gradient, gradient, gaussians.blocks).values()) < 1e-12
    assert max(errors_by_block(held.hvp(U), products, gaussians.blocks).values()) < 1e-12


@each_mode
def test_float32_keeps_its_digits_through_the_whole_chain(mode):
    # no thresholds and no kinks: both precisions make the same decisions
    loss, settings = LossSettings("l2"), smooth(mode)
    gaussians, view = (
        filtered(random_gaussians(40, 3, logit=-1.0), mode).to(torch.float32).to(torch.float64),
        two_views()[0],
    )
    U = random_like((gaussians.flat.numel(), 3), 1).float().double()
    gradient, products = gradient_and_products(gaussians, [view], loss, U, settings)
    held = hold(gaussians, view, loss, torch.float32, settings)
    image = render(gaussians, view.camera, BACKGROUND, settings, backend="reference").image
    assert relative_error(held.image, image) < IMAGE[torch.float32]
    assert max(errors_by_block(held.gradient, gradient, gaussians.blocks).values()) < DERIVATIVE[torch.float32]
    assert max(errors_by_block(held.hvp(U.float()), products, gaussians.blocks).values()) < DERIVATIVE[torch.float32]


def test_float32_keeps_its_digits_in_needles_too():
    """Lines across the image, most of them longer than wide by a factor of 15."""
    gaussians, generator = random_gaussians(40, 1, logit=-1.0), torch.Generator().manual_seed(0)
    share = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    gaussians.log_scales[:] = share * torch.tensor([1.5, 0.5, 0.5]) - torch.tensor([1.5, 6.0, 6.0])
    gaussians = gaussians.to(torch.float32).to(torch.float64)
    view = View("", random_camera(120, 90, seed=1, focal=112.0), torch.rand(3, 90, 120, generator=generator))
    a, b, c = project(gaussians, view.camera, SMOOTH).conics.T
    ratios = torch.linalg.cond(torch.stack([a, b, b, c], dim=1).view(-1, 2, 2)).sqrt()
    assert ratios.median() > 15 and ratios.max() > 50
    U = random_like((gaussians.flat.numel(), 3), 1).float()
    single, double = (hold(gaussians, view, LossSettings("l2"), dtype, SMOOTH) for dtype in DTYPES)
    found = [(single.image, double.image), (single.gradient, double.gradient), (single.hvp(U), double.hvp(U.double()))]
    blocks = [held.block_diagonals(approximate=True)[0].diagonals for held in (single, double)]
    found += [(blocks[0][name], diagonal) for name, diagonal in blocks[1].items()]
    assert max(relative_error(one, other) for one, other in found) < DERIVATIVE[torch.float32]


def image_and_alpha(gaussians: Gaussians, view: View, flat: Tensor, settings: RenderSettings) -> Tensor:
    rendering = render(gaussians.with_flat(flat), view.camera, BACKGROUND, settings, backend="reference")
    return torch.cat([rendering.image, rendering.alpha[None]])


@each_mode
@each_loss
def test_gauss_newton_is_the_dense_product_of_its_three_factors(loss, mode):
    gaussians, view = filtered(random_gaussians(4, 1, logit=1.0, spread=0.4), mode), two_views(7, 6)[0]
    held = hold(gaussians, view, loss, settings=MODES[mode])
    identity = torch.eye(gaussians.flat.numel(), dtype=torch.float64)
    J = torch.autograd.functional.jacobian(lambda x: image_and_alpha(gaussians, view, x, MODES[mode]), gaussians.flat)
    assert relative_error(held.jvp(identity), J.movedim(-1, 0)) < 1e-12  # pyright: ignore
    cotangents = random_like((2, 4, 6, 7), 1)
    assert relative_error(held.vjp(cotangents), torch.einsum("chwp,kchw->pk", J, cotangents)) < 1e-12
    J = J[:3].reshape(-1, len(identity))
    middle = torch.autograd.functional.hessian(
        lambda image: photometric_loss(image, view.image.double(), loss), held.image
    ).reshape(len(J), len(J))  # pyright: ignore
    assert relative_error(held.ggn(identity), J.T @ middle @ J) < 1e-12


@each_mode
@each_loss
def test_the_hessian_is_that_of_dense_autograd_column_by_column(loss, mode):
    gaussians, view = filtered(random_gaussians(3, 1, logit=1.0, spread=0.4), mode), two_views(14, 11)[0]
    identity = torch.eye(gaussians.flat.numel(), dtype=torch.float64)
    _, dense = gradient_and_products(gaussians, [view], loss, identity, MODES[mode])
    H = hold(gaussians, view, loss, settings=MODES[mode]).hvp(identity)
    scale = dense.norm()
    for column, expected in zip(H.T, dense.T, strict=True):
        assert (column - expected).norm() < 1e-13 * scale
    assert (H - H.T).norm() < 1e-13 * scale


@each_mode
def test_products_agree_with_finite_differences_of_the_kernels_own_gradient(mode):
    loss, settings = LossSettings("charbonnier", eps=0.1), smooth(mode)
    gaussians, view = filtered(random_gaussians(20, 2, logit=-1.0, spread=0.7), mode), two_views()[0]
    direction = 0.1 * random_like(gaussians.flat.shape, 1)

    def at(t: float) -> LinearizedView:
        return hold(gaussians.with_flat(gaussians.flat + t * direction), view, loss, settings=settings)

    held, step = at(0.0), 3e-3
    slope = central_difference(lambda t: np.array(at(t).value), step)
    assert float(held.gradient @ direction) == pytest.approx(float(slope), rel=1e-8)
    bend = central_difference(lambda t: at(t).gradient.numpy(), step)
    assert relative_error(held.hvp(direction[:, None])[:, 0], bend) < 1e-7


@each_mode
@each_dtype
def test_products_are_symmetric_to_round_off(dtype, mode):
    gaussians, view = filtered(random_gaussians(60, 3, logit=2.0), mode), two_views()[0]
    held = hold(gaussians, view, LossSettings("charbonnier"), dtype, MODES[mode])
    U = random_like((gaussians.flat.numel(), 2), 1).to(dtype)
    for product in (held.hvp(U), held.ggn(U)):
        one, other = (U[:, 1] * product[:, 0]).double(), (U[:, 0] * product[:, 1]).double()
        # a random sum of terms with relative errors of a few eps each
        bound = 30 * float(np.finfo(NUMPY[dtype]).eps) * float(one.norm() + other.norm())
        assert abs(float(one.sum() - other.sum())) < bound


def test_a_columns_product_does_not_depend_on_its_neighbours():
    gaussians, view = random_gaussians(40, 1, logit=3.0), two_views()[0]
    held = hold(gaussians, view, LossSettings(), torch.float32)
    U = random_like((gaussians.flat.numel(), 4), 1).float()
    block = held.hvp(U)
    for k in range(4):
        assert relative_error(block[:, k], held.hvp(U[:, k : k + 1])[:, 0]) < DERIVATIVE[torch.float32]


def test_a_product_repeats_to_the_last_bit():
    gaussians, view = random_gaussians(40, 1, logit=3.0), two_views()[0]
    held = hold(gaussians, view, LossSettings(), torch.float32)
    U = random_like((gaussians.flat.numel(), 3), 1).float()
    first = held.hvp(U)
    assert torch.equal(first, held.hvp(U)) and torch.equal(held.ggn(U), held.ggn(U))
    assert torch.equal(first, hold(gaussians, view, LossSettings(), torch.float32).hvp(U))


def test_what_a_product_takes_is_free_before_its_result_is_made():
    gaussians, view = random_gaussians(4000, 3), two_views()[0]
    held = hold(gaussians, view, LossSettings(), torch.float32)
    U = random_like((gaussians.flat.numel(), 4), 8).float()
    result = held.hvp(U)  # the first one makes what is kept
    peaks = []
    for _ in range(3):  # other threads of the process can only add to what is traced
        tracemalloc.start()
        held.hvp(U)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    peak = min(peaks)
    cotangents = 4 * 9 * U.shape[1] * len(gaussians)  # of the splats: what the result is made of
    assert result.nbytes + cotangents <= peak <= result.nbytes + 1.5 * cotangents


def test_gaussians_vectors_and_images_of_another_dtype_are_refused():
    gaussians, views = random_gaussians(8, sh_degree=1, seed=4).to(torch.float32), two_views()
    objective = SceneObjective(gaussians, views, LossSettings(), BACKGROUND.float())
    double = objective.active.to(torch.float64)
    view = objective.linearizer(objective.active)(0)
    vectors = torch.ones(len(double.flat), 1, dtype=torch.float64)
    calls = [
        lambda: objective.linearizer(double)(0),
        lambda: objective.loss(double.flat),
        lambda: objective.evaluate_view(0, double),
        lambda: view.hvp(vectors),
        lambda: view.ggn(vectors),
        lambda: view.jvp(vectors),
        lambda: view.vjp(view.image.new_ones(1, 4, *view.image.shape[1:], dtype=torch.float64)),
        lambda: SceneHessian(objective).apply(vectors),
    ]
    for call in calls:
        misused(r"expected .*torch\.float32.* got .*torch\.float64", call)


def test_what_no_pixel_sees_has_no_derivative():
    gaussians = random_gaussians(12, 1, logit=2.0)
    gaussians.means[3, 2] = -5.0
    gaussians.opacity_logits[5] = -9.0
    held = hold(gaussians, two_views()[0], LossSettings("l2"))
    U = random_like((gaussians.flat.numel(), 2), 1)
    for product in (held.gradient[:, None], held.hvp(U), held.ggn(U)):
        for name, value in gaussians.with_flat(product[:, 0].contiguous()).attributes.items():
            assert not value[3].any() and not value[5].any(), name
    assert held.touched <= 10


def test_a_gaussian_that_is_not_finite_is_named():
    gaussians = random_gaussians(5)
    gaussians.log_scales[2, 1] = float("nan")
    refused(r"expected finite log_scales, got .*nan.* at Gaussian 2", hold, gaussians, two_views()[0], LossSettings())


def test_tiles_are_dark_where_the_picture_is_met_exactly_and_the_loss_does_not_couple_pixels():
    gaussians, view = random_gaussians(40, 1, logit=1.0), two_views(45, 37)[0]
    # behind the others one that fills the picture: no tile is empty, however many pixels wide the machine's registers are
    gaussians.means[0], gaussians.log_scales[0] = torch.tensor([0.0, 0.0, 9.0], dtype=torch.float64), 3.0
    met = hold(gaussians, view, LossSettings()).image[:, :TILE_HEIGHT]  # a row of tiles
    view = replace(view, image=torch.cat([met, view.image[:, TILE_HEIGHT:].double()], dim=1))
    alone, coupled = (hold(gaussians, view, LossSettings(ssim_weight=weight)) for weight in (0.0, 0.2))
    first_row = -(-45 // lanes_of(np.float64)) * PIXEL_ROWS
    lists = alone._raster.lists  # pyright: ignore[reportAttributeAccessIssue]
    assert (np.diff(lists.start)[:first_row] > 0).all()
    assert alone.dark_tiles == first_row and coupled.dark_tiles == 0
