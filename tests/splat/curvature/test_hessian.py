"""The Hessian of a scene as an operator: what is removed, what is averaged, what is refused."""

import gc
from dataclasses import replace
from weakref import ref

import pytest
import torch
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.checks import check_operator
from splat.backend.memory import free_memory
from splat.curvature.hessian import SceneHessian, ViewSum
from splat.curvature.linearize import LinearizedView
from splat.curvature.objective import SceneObjective
from splat.losses.cpu.loss import CpuViewLoss
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.projection.reference import project
from splat.render.reference import rasterize_reference
from splat.render.render import render
from tests.refusals import misused, refused
from tests.splat.held_scenes import BACKGROUND, gradient_and_products, mean_loss, two_views
from tests.splat.random_scenes import random_gaussians, random_like
from tests.splat.tolerances import errors_by_block, relative_error

LOSS = LossSettings("charbonnier")


def partly_hidden() -> tuple[Gaussians, Tensor]:
    """Some Gaussians behind the cameras, outside their images, too faint, or behind walls; and which they are."""
    gaussians = random_gaussians(30, 1, logit=1.0)
    gaussians.means[0, 2] = -6.0
    gaussians.means[1, 0] = 40.0
    gaussians.opacity_logits[2] = -7.0
    hidden = torch.zeros(30, dtype=torch.bool)
    hidden[:3] = True
    # four walls over the whole of both images
    gaussians.means[3:7] = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    gaussians.log_scales[3:7] = 3.0
    gaussians.opacity_logits[3:7] = 8.0
    gaussians.means[7:12, 2] = 9.0
    hidden[7:12] = True
    visible = ~hidden
    visible[3:7] = False
    gaussians.means[visible, 2] = gaussians.means[visible, 2].clamp(1.2, 1.8)
    return gaussians, hidden


def objective(gaussians: Gaussians, loss: LossSettings = LOSS, **options) -> SceneObjective:
    return SceneObjective(gaussians, two_views(), loss, BACKGROUND, **options)


def touched_by_the_specification(gaussians: Gaussians) -> Tensor:
    """Which Gaussians' colours show in some pixel."""
    seen = torch.zeros(len(gaussians), dtype=torch.bool)
    for view in two_views():
        camera, splats = view.camera, project(gaussians, view.camera)
        colours = splats.colours.detach().requires_grad_()
        image, _, _ = rasterize_reference(replace(splats, colours=colours), BACKGROUND, camera.width, camera.height)
        seen |= (torch.autograd.grad(image.sum(), colours)[0] > 0).any(dim=1)
    return seen


def test_exactly_the_gaussians_that_touch_no_pixel_are_removed():
    gaussians, hidden = partly_hidden()
    scene = objective(gaussians)
    assert torch.equal(scene.mask, touched_by_the_specification(gaussians))
    # the second wall would take the transmittance to the floor itself, and ends the pixel: one wall hides all behind it
    assert not scene.mask[hidden].any() and scene.mask[3:7].sum() == 1 and 5 < scene.mask.sum() < 25
    left = gaussians.select(scene.mask)
    for view in two_views():
        seen = render(gaussians, view.camera, BACKGROUND).image
        assert torch.equal(render(left, view.camera, BACKGROUND).image, seen)
        held = LinearizedView(gaussians, view.camera, CpuViewLoss(view.image.double(), LOSS, torch.float64), BACKGROUND)
        for product in (held.gradient, held.hvp(random_like((gaussians.flat.numel(), 1), 1))[:, 0]):
            for value in gaussians.with_flat(product.contiguous()).attributes.values():
                assert not value[~scene.mask].any()
    assert scene.counts.gaussians == 30 and scene.counts.visible_gaussians == int(scene.mask.sum()) == len(scene.active)


def test_counts_say_what_is_left():
    scene = objective(random_gaussians(10, 2, spread=0.3), sh_degree=1)
    counts, left = scene.counts, len(scene.active)
    assert (counts.sh_degree_stored, counts.sh_degree_active, counts.views) == (2, 1, 2)
    assert counts.parameters == 10 * (11 + 27)
    assert counts.active_parameters == left * (11 + 12) - left


def test_bands_that_are_not_in_use_are_removed_from_picture_and_operator():
    gaussians = random_gaussians(20, 2, logit=1.0)
    scene = objective(gaussians, sh_degree=0)
    assert scene.active.sh_degree == 0 and scene.blocks["sh"].stop - scene.blocks["sh"].start == 3 * len(scene.active)
    flat = gaussians.select(torch.arange(20), 0)
    assert scene.loss(scene.active.flat) == pytest.approx(float(mean_loss(flat, two_views(), LOSS)), rel=1e-12)


def test_quaternions_get_unit_length_and_the_given_ones_stay():
    gaussians = random_gaussians(20, logit=1.0)
    before = gaussians.flat.clone()
    scene = objective(gaussians)
    assert torch.equal(gaussians.flat, before)
    assert relative_error(scene.active.quats.norm(dim=1), torch.ones(len(scene.active))) < 1e-15
    assert scene.loss(scene.active.flat) == pytest.approx(float(mean_loss(gaussians, two_views(), LOSS)), rel=1e-12)


@pytest.mark.parametrize("loss", [LOSS, LossSettings(), LossSettings("l2", ssim_weight=0)], ids=lambda loss: loss.pixel)
def test_loss_gradient_and_products_are_means_over_the_views(loss):
    scene = objective(random_gaussians(40, 1, logit=1.0), loss)
    active = scene.active
    U = random_like((active.flat.numel(), 3), 1)
    gradient, products = gradient_and_products(active, two_views(), loss, U)
    assert scene.loss(active.flat) == pytest.approx(float(mean_loss(active, two_views(), loss)), rel=1e-13)
    assert max(errors_by_block(scene.gradient, gradient, active.blocks).values()) < 1e-12
    errors = errors_by_block(SceneHessian(scene, keep_null=True).apply(U), products, active.blocks)
    assert max(errors.values()) < 1e-12


def radial_directions(gaussians: Gaussians) -> Tensor:
    """One column a Gaussian: its own quaternion."""
    n = len(gaussians)
    columns = torch.zeros(n, gaussians.flat.numel(), dtype=torch.float64)
    for i in range(n):
        gaussians.with_flat(columns[i]).quats[i] = gaussians.quats[i]
    return columns.T.contiguous()


def test_the_length_of_quaternions_is_projected_out():
    scene = objective(random_gaussians(15, 0, logit=1.0))  # at degree 0 every view sees all of the colour
    H, Q = SceneHessian(scene), radial_directions(scene.active)
    V = random_like((H.dim, 3), 1)
    kept, tangent = V.clone(), V - Q @ (Q.T @ V)
    product = H.apply(V)
    assert torch.equal(V, kept)
    assert H.apply(Q).norm() < 1e-13 * product.norm() and (Q.T @ product).norm() < 1e-13 * product.norm()
    assert relative_error(H.project(V), tangent) < 1e-14
    assert relative_error(product, H.project(SceneHessian(scene, keep_null=True).apply(tangent))) < 1e-13


@pytest.mark.parametrize("gauss_newton", [False, True])
def test_what_is_projected_out_is_null_and_as_large_as_the_rank_says(gauss_newton):
    scene = objective(random_gaussians(12, 2, logit=1.0))
    H = SceneHessian(scene, gauss_newton=gauss_newton)
    P = H.project(torch.eye(H.dim, dtype=torch.float64))
    assert (P - P.T).norm() < 1e-12 * P.norm() and (P @ P - P).norm() < 1e-12 * P.norm()
    assert H.rank == round(float(P.trace())) < H.dim
    out = torch.eye(H.dim, dtype=torch.float64) - P
    if not gauss_newton:  # a quaternion's length is null only where the gradient vanishes
        out[:, H.blocks["quats"]] = 0
    full = SceneHessian(scene, gauss_newton=gauss_newton, keep_null=True)
    size = full.apply(random_like((H.dim, 1), 2)).norm()
    assert out.norm() > 1 and full.apply(out).norm() < 1e-10 * size


def test_along_its_length_a_quaternions_curvature_is_minus_its_gradient():
    scene = objective(random_gaussians(15, 1, logit=1.0))
    full, Q = SceneHessian(scene, keep_null=True), radial_directions(scene.active)
    along = full.apply(Q)
    gradient = scene.active.with_flat(torch.zeros(full.dim, dtype=torch.float64))
    for i in range(len(scene.active)):  # the loss is homogeneous of degree 0 in each quaternion: H q = -grad
        gradient.flat.zero_()
        gradient.quats[i] = -scene.active.with_flat(scene.gradient).quats[i]
        assert (along[:, i] - gradient.flat).norm() < 1e-13 * along.norm()
    gauss_newton = SceneHessian(scene, gauss_newton=True, keep_null=True)
    assert gauss_newton.apply(Q).norm() < 1e-13 * gauss_newton.apply(random_like(Q.shape, 2)).norm()


def test_the_operator_passes_the_checks_of_any_operator():
    scene = objective(random_gaussians(20, 1, logit=1.0))
    for operator in (SceneHessian(scene), SceneHessian(scene, gauss_newton=True)):
        assert set(operator.blocks) == {"means", "log_scales", "quats", "opacity_logits", "sh"}
        assert operator.dtype == torch.float64 and operator.dim == scene.active.flat.numel()
        check = check_operator(operator, torch.Generator().manual_seed(0), tolerance=1e-12)
        assert check.passed, check


def test_a_sum_over_some_views_takes_the_first_of_them():
    scene = objective(random_gaussians(20, 1, logit=1.0))
    first, second = scene.linearized
    V = random_like((scene.active.flat.numel(), 2), 3)
    assert torch.equal(ViewSum(scene, indices=[0]).apply(V), first.hvp(V))
    assert torch.equal(ViewSum(scene, gauss_newton=True).apply(V), first.ggn(V) + second.ggn(V))


def test_the_smooth_piece_changes_where_the_order_does_and_only_there():
    scene = objective(random_gaussians(20, logit=1.0, spread=0.5))
    flat = scene.active.flat.clone()
    same, swapped = flat.clone(), flat.clone()
    order = torch.argsort(scene.active.means[:, 2])
    means = scene.active.with_flat(swapped).means
    means[order[0]] = means[order[-1]] + torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    at, at_same, at_swapped = (scene.evaluate(each)[1] for each in (flat, same, swapped))
    assert at == at_same != at_swapped


def test_what_cannot_be_an_objective_is_refused():
    gaussians = random_gaussians(5)
    refused("expected at least one view, got none", SceneObjective, gaussians, [], LOSS)
    refused("expected at least one Gaussian, got none", objective, gaussians.select(torch.arange(0)))
    with pytest.raises(InputError, match="expected a background of three finite numbers"):
        SceneObjective(gaussians, two_views(), LOSS, torch.full((3,), float("inf")))
    behind = random_gaussians(5)
    behind.means[:, 2] = -9.0
    refused("expected Gaussians in sight, got 5 that no view sees", objective, behind)
    broken = random_gaussians(5, 1)
    broken.sh[4, 1, 2] = float("inf")
    refused(r"expected finite sh, got .*inf.* at Gaussian 4", objective, broken)
    H = SceneHessian(objective(gaussians))
    misused(r"use V\[:, None\]", H.apply, torch.zeros(H.dim, dtype=torch.float64))


def test_parameters_that_require_a_gradient_are_taken_as_numbers():
    gaussians, U = random_gaussians(5, 1), None
    products = []
    for flat in (gaussians.flat, gaussians.flat.clone().requires_grad_()):
        H = SceneHessian(objective(gaussians.with_flat(flat)))
        U = random_like((H.dim, 1), 3)
        products.append(H.apply(U))
    assert torch.equal(*products) and not products[1].requires_grad


@pytest.mark.parametrize("gauss_newton", [False, True])
def test_a_view_that_draws_no_moved_gaussian_is_left_out_exactly(gauss_newton, monkeypatch):
    """Two cameras at one place, back to back, each with Gaussians of its own."""
    gaussians, view = random_gaussians(12, 1, logit=1.0), two_views()[0]
    about_y = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    behind = torch.arange(12) < 4
    gaussians.means[behind] = 2 * view.camera.centre - gaussians.means[behind]
    views = [view, replace(view, camera=replace(view.camera, rotation=about_y @ view.camera.rotation))]
    scene = SceneObjective(gaussians, views, LOSS, BACKGROUND)
    hessian = SceneHessian(scene, gauss_newton=gauss_newton, keep_null=True)
    U = random_like((hessian.dim, 2), 5)
    only_behind = scene.active.with_flat(torch.zeros(hessian.dim, dtype=torch.float64))
    for part in only_behind.attributes.values():
        part[behind[scene.mask]] = 1
    made, kind = [], "ggn" if gauss_newton else "hvp"
    whole = getattr(LinearizedView, kind)
    monkeypatch.setattr(LinearizedView, kind, lambda view, *more, **how: made.append(view) or whole(view, *more, **how))
    for columns, products in ((U, 2), (U * only_behind.flat[:, None], 1), (torch.zeros_like(U), 0)):
        made.clear()
        product = hessian.apply(columns)
        assert len(made) == products
        each = [held.ggn(columns) if gauss_newton else held.hvp(columns) for held in scene.linearized]
        assert torch.equal(product, (each[0] + each[1]) / 2)


def test_free_memory_of_a_gpu_is_also_what_torch_holds_for_tensors_to_come(monkeypatch):
    for name, found in {"mem_get_info": (100, 1000), "memory_reserved": 70, "memory_allocated": 30}.items():
        monkeypatch.setattr(torch.cuda, name, lambda _device, found=found: found)
    assert free_memory(torch.device("cuda")) == 140
    assert free_memory(torch.device("cpu")) > 1000


def test_what_was_linearized_is_freed_with_its_objective():
    """Training makes a new objective at every diagnosis: in a circle of references they would pile up."""

    def used() -> list[ref]:
        scene = objective(random_gaussians(6, 1, logit=1.0))
        hessian = SceneHessian(scene)
        hessian.apply(random_like((hessian.dim, 1), 0))
        scene.block_diagonal()
        return [ref(scene), ref(scene.linearized.first), ref(hessian)]

    used()  # what is compiled at first refers to its arguments
    gc.disable()
    try:
        assert [left() for left in used()] == [None, None, None]
    finally:
        gc.enable()


def test_released_views_are_made_anew():
    objective = SceneObjective(random_gaussians(30), two_views(16, 12))
    hessian, V = SceneHessian(objective), torch.randn(len(objective.active.flat), 2).double()
    before, view = hessian.apply(V), ref(objective.linearized.first)
    objective.release()
    assert view() is None
    assert torch.equal(hessian.apply(V), before)
