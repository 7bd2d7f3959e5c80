"""Steps of second order: each is the dense float64 solution of its model, and none is taken that does not lower the loss."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.render.render import render
from splat.training.loop import train
from splat.training.methods.second_order.damped_blocks import absolute
from splat.training.methods.second_order.solvers import GaussNewtonCG, NewtonBlocks, minimum
from splat.training.methods.second_order.steps import FALLS, RISES, LocalModel, SecondOrder
from splat.training.state import Training
from tests.oracles import absolute_matrix
from tests.refusals import refused
from tests.splat.tiny import EXTENT, ended, tiny_config, tiny_gaussians, tiny_views

L2, SSIM = LossSettings("l2", ssim_weight=0.0), LossSettings("l2", ssim_weight=0.3)
GN, HESSIAN = NewtonBlocks(floor=0.3), NewtonBlocks(floor=0.3, curvature="hessian")
N, LAMBDA = 6, 0.4


def local(settings: SecondOrder, loss: LossSettings = L2) -> LocalModel:
    double = torch.float64
    scene = SceneObjective(tiny_gaussians(N, dtype=double), tiny_views(double)[:2], loss, torch.zeros(3, dtype=double))
    assert len(scene.active) == N
    return LocalModel(scene, settings)


def dense(local: LocalModel, settings: SecondOrder) -> Tensor:
    """S P H P S, from the scene's Hessian alone."""
    scene, S = local.objective, torch.diag(local.metric.scale)
    quats = scene.active.quats
    P = torch.eye(scene.active.flat.numel(), dtype=torch.float64)
    for i, q in enumerate(quats):
        rows = slice(scene.blocks["quats"].start + 4 * i, scene.blocks["quats"].start + 4 * i + 4)
        P[rows, rows] -= torch.outer(q, q)
    H = SceneHessian(scene, gauss_newton=settings.curvature == "gauss-newton", keep_null=True)
    return S @ P @ H.apply(torch.eye(len(P), dtype=torch.float64)) @ P @ S


def rows_of(i: int, local: LocalModel) -> list[int]:
    """A Gaussian's unknowns but those of its SH."""
    blocks = local.objective.blocks
    widths = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1}
    return [blocks[name].start + width * i + k for name, width in widths.items() for k in range(width)]


def inverted(A: Tensor, local: LocalModel, damping: float = LAMBDA) -> Tensor:
    """M of `damped_blocks.py`, from the dense A."""
    M = torch.zeros_like(A)
    for i in range(N):
        rows = rows_of(i, local)
        block = absolute_matrix(A[rows][:, rows].numpy()) + damping * np.eye(11)
        M[np.ix_(rows, rows)] = torch.from_numpy(np.linalg.inv(block))
    sh = local.objective.blocks["sh"]
    M[sh, sh] = torch.diag(1 / (A.diagonal()[sh].abs() + damping))
    return M


@pytest.mark.parametrize("loss", [L2, SSIM])
@pytest.mark.parametrize("settings", [GN, HESSIAN])
def test_the_preconditioner_is_the_dense_inverse_of_damped_absolute_blocks(settings, loss):
    model = local(settings, loss)
    A, v = dense(model, settings), torch.linspace(-1, 1, model.A.dim, dtype=torch.float64)
    v = model.metric.project(v[:, None])[:, 0]
    assert (model.metric.inverse(LAMBDA)(v) - inverted(A, model) @ v).abs().max() < 1e-10
    jacobi = v / (A.diagonal().abs() + LAMBDA)
    if settings == GN and loss == L2:  # |A| = A, whose diagonal is then that of |A|
        jacobi = model.metric.project(jacobi[:, None])[:, 0]
        assert (model.metric.inverse(LAMBDA, diagonal=True)(v) - jacobi).abs().max() < 1e-10


@pytest.mark.parametrize("settings", [GN, HESSIAN])
def test_a_newton_step_is_the_dense_one_with_the_exact_length(settings):
    settings = replace(settings, momentum=False)
    model = local(settings)
    A = dense(model, settings)
    y = inverted(A, model) @ model.b
    along = y @ A @ y + LAMBDA * y @ y
    y = (y @ model.b) / along.abs() * y
    found = settings.create(0).propose(model, LAMBDA)
    assert (found.y - y).abs().max() < 1e-10 * y.abs().max()
    assert found.fall == pytest.approx(float(model.b @ y - y @ A @ y / 2), rel=1e-9) and found.fall > 0


def test_with_momentum_the_step_is_the_lowest_in_the_plane_of_both_directions():
    model, method = local(GN), GN.create(0)
    method.last = torch.linspace(-0.01, 0.02, model.A.dim, dtype=torch.float64)
    found = method.propose(model, LAMBDA)
    rest = model.b - dense(model, GN) @ found.y - LAMBDA * found.y
    for direction in (model.metric.inverse(LAMBDA)(model.b), model.in_unknowns(method.last)):
        assert abs(rest @ direction) < 1e-10 * rest.norm() * direction.norm()
    alone = replace(GN, momentum=False).create(0).propose(model, LAMBDA)
    assert found.fall > alone.fall


@pytest.mark.parametrize("preconditioner", ["blocks", "diagonal"])
def test_conjugate_gradients_give_the_dense_damped_gauss_newton_step(preconditioner):
    settings = GaussNewtonCG(rtol=1e-12, products=200, preconditioner=preconditioner, floor=0.3)
    model = local(settings, SSIM)
    A = dense(model, settings)
    damping = 0.1 - min(float(torch.linalg.eigvalsh(A)[0]), 0.0)  # SSIM's part may be indefinite
    y = torch.linalg.solve(A + damping * torch.eye(len(A)).double(), model.b)
    found = settings.create(0).propose(model, damping)
    assert (found.y - y).norm() < 1e-9 * y.norm() and not found.negative
    assert found.fall == pytest.approx(float(model.b @ y - y @ A @ y / 2), rel=1e-8)


def test_negative_curvature_is_met_and_raises_the_damping():
    settings = GaussNewtonCG(curvature="hessian", damping=1e-6, rtol=1e-9, products=200)
    model, method = local(settings), settings.create(0)
    assert torch.linalg.eigvalsh(dense(model, settings))[0] < -1e-3
    found = method.propose(model, method.damping)
    assert found.negative and found.y @ model.b > 0
    method._adapt(1.0, found.negative)
    assert method.damping == 1e-6 * RISES


@pytest.mark.parametrize(
    ("ratio", "factor"), [(0.9, FALLS), (0.76, FALLS), (0.5, 1.0), (0.2, RISES), (0.0, RISES), (-1.0, RISES)]
)
def test_the_damping_follows_the_ratio(ratio, factor):
    method = GN.create(0)
    method._adapt(ratio, False)
    assert method.damping == GN.damping * factor


def steps(settings: SecondOrder, gaussians: Gaussians, count: int, fitted: bool = False, **changes) -> Training:
    """fitted: on views that show the start itself, to the last bit."""
    config = replace(tiny_config(count), method=settings, loss=L2, random_background=False, **changes)
    training, views = Training.start(gaussians, EXTENT, config), tiny_views()
    if fitted:
        views = [replace(view, image=render(training.gaussians, view.camera).image.detach()) for view in views]
    return ended(training, views)


@pytest.mark.parametrize("settings", [NewtonBlocks(curvature="hessian"), GaussNewtonCG()])
def test_the_loss_never_rises_and_only_what_is_seen_moves_on_unit_quaternions(settings):
    start = tiny_gaussians()
    start.means[3] = torch.tensor([0.0, 0.0, -9.0])  # behind all cameras
    training = steps(replace(settings, damping=1e-3), start, 8, sh_degree=0)
    losses = [row["loss"] for row in training.method.history]
    assert all(b < a for a, b in pairwise(losses)) and losses[-1] < 0.3 * losses[0]
    assert len(training.gaussians) == len(start)
    for name, value in training.gaussians.attributes.items():
        assert torch.equal(value[3], start.attributes[name][3])
        assert not torch.equal(value[0], start.attributes[name][0])
    seen = torch.arange(len(start)) != 3
    assert (training.gaussians.quats[seen].norm(dim=1) - 1).abs().max() < 3e-7


def test_no_step_is_taken_where_none_lowers_the_loss():
    start = tiny_gaussians(seed=1)
    start.quats[:] = 0.5  # of length 1 to the last bit, so that the loss of the start's own renders is exactly 0
    training = steps(GaussNewtonCG(), start, 2, fitted=True, sh_degree=0)
    assert [(row["loss"], row["ratio"]) for row in training.method.history] == [(0.0, 0.0)] * 2
    assert torch.equal(training.gaussians.flat, start.flat)


def test_the_loss_of_a_step_is_the_mean_over_all_views_with_a_smooth_l1():
    config = replace(tiny_config(1), method=GaussNewtonCG(), random_background=False)
    training = Training.start(tiny_gaussians(), EXTENT, config)
    smooth = SceneObjective(training.gaussians, tiny_views(), LossSettings("charbonnier"))
    (done,) = train(training, tiny_views())
    assert done.loss == pytest.approx(smooth.loss(smooth.active.flat), rel=1e-6)


def test_a_clamped_image_is_refused():
    refused("expected clamp_image=false for gn-cg", steps, GaussNewtonCG(), tiny_gaussians(), 1, clamp_image=True)


def test_absolute_values_are_those_of_eigenvalues_and_leave_what_is_positive():
    C = torch.randn(5, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    C = C + C.mT
    C[0] = C[0] @ C[0]
    found = absolute(C)
    assert torch.equal(found[0], C[0])
    for one, other in zip(found, C, strict=True):
        assert np.abs(one.numpy() - absolute_matrix(other.numpy())).max() < 1e-12
    assert minimum(torch.zeros(2, 2).double() + torch.eye(2) * 1e-30, torch.ones(2).double()).isfinite().all()
