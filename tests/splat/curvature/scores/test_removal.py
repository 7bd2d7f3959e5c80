"""Scores for pruning against dense float64 computations and true removals."""

import numpy as np
import pytest
import torch
from scipy.linalg import null_space

from splat.curvature.objective import SceneObjective
from splat.curvature.scores.removal import SCORES, removal_errors, removal_scores
from splat.losses.reference import LossSettings
from splat.scenes.view import View
from tests.splat.held_scenes import BACKGROUND, mean_loss, two_views
from tests.splat.random_scenes import random_camera, random_gaussians
from tests.splat.tiny import SMOOTH

L2 = LossSettings("l2", ssim_weight=0)


def toy(loss: LossSettings, views: int = 2) -> SceneObjective:
    gaussians = random_gaussians(8, sh_degree=1, seed=4, logit=-0.5, spread=0.5).to(torch.float64)
    third = View("3", random_camera(30, 22, seed=5, focal=28.0), torch.rand(3, 22, 30))
    return SceneObjective(gaussians, [*two_views(), third][:views], loss, BACKGROUND, SMOOTH)


def along_removal(objective: SceneObjective, gaussian: int) -> float:
    """L'(0) + L''(0) / 2 along the path omega (1 - t), by double backward through the specification."""
    active = objective.active
    row = objective.blocks["opacity_logits"].start + gaussian
    t = torch.zeros((), dtype=torch.float64, requires_grad=True)
    flat = active.flat.clone()
    flat[row] = torch.logit(active.opacity_logits[gaussian].sigmoid() * (1 - t))
    loss = mean_loss(active.with_flat(flat), objective.views, objective.loss_settings, SMOOTH)
    (slope,) = torch.autograd.grad(loss, t, create_graph=True)
    (curvature,) = torch.autograd.grad(slope, t)
    return float((slope + curvature / 2).detach())


LOSSES = [LossSettings(), LossSettings("charbonnier", ssim_weight=0.4), LossSettings(opacity_reg=3.0, scale_reg=0.1)]


@pytest.mark.parametrize("loss", LOSSES, ids=["3DGS", "smooth", "MCMC"])
def test_the_predicted_rise_is_the_second_order_of_removal(loss):
    objective = toy(loss)
    rise = removal_scores(objective, toy(L2))["removal_error"]
    exact = np.array([along_removal(objective, i) for i in range(len(rise))])
    assert np.abs(rise.numpy() - exact).max() <= 1e-10 * np.abs(exact).max()


def test_for_squared_errors_the_prediction_is_the_true_rise():
    objective = toy(L2)
    rise = removal_scores(objective, objective)["removal_error_l2"]
    true = removal_errors(objective, torch.arange(len(rise)))
    assert (true.abs() > 0).all() and (rise - true).abs().max() <= 1e-10 * true.abs().max()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("logit", [15.0, 38.0, 120.0])
def test_opaque_gaussians_are_scored_by_their_removal(logit, dtype):
    gaussians = random_gaussians(8, sh_degree=1, seed=4, logit=-0.5, spread=0.5).to(dtype)
    gaussians.opacity_logits[:4] = logit
    objective = SceneObjective(gaussians, two_views(), L2, BACKGROUND.to(dtype), SMOOTH)
    rise = removal_scores(objective, objective)["removal_error_l2"]
    true = removal_errors(objective, torch.arange(len(rise)))
    # 1 - omega at the logit OPAQUE, and twice its rounding in single precision; the loss is known to round-off
    bound = 1e-3 * true.abs() + 100 * torch.finfo(dtype).eps * objective.loss(objective.active.flat)
    assert (true[:4].abs() > 10 * bound[:4]).all() and ((rise - true).abs() <= bound).all(), (rise, true)


def test_log_determinants_are_those_of_the_dense_jacobian():
    objective = toy(L2, 3)  # two views leave some blocks singular
    scores, active = removal_scores(objective, objective), objective.active
    assert tuple(scores) == SCORES
    unit = torch.eye(active.flat.numel(), dtype=torch.float64)
    J = torch.cat([view.jvp(unit)[:, :3].flatten(1) for view in objective.linearized], dim=1).numpy()
    G = 2 * J @ J.T / J.shape[1]
    for i, q in enumerate(active.quats.numpy()):
        names = ("means", "log_scales", "quats", "opacity_logits")
        own = np.concatenate([np.arange(len(G))[objective.blocks[name]].reshape(len(active), -1)[i] for name in names])
        B, E = G[np.ix_(own, own)], np.zeros((11, 10))
        E[:6, :6], E[6:10, 6:9], E[10, 9] = np.eye(6), null_space(q[None]), 1
        across = np.eye(11)
        across[6:10, 6:10] -= np.outer(q, q)
        expected = {
            "log_det_6": np.linalg.slogdet(B[:6, :6])[1],
            "log_det_11": np.linalg.slogdet(E.T @ B @ E)[1],
            "gn_diagonal": np.log(np.diag(across @ B @ across)).sum(),
        }
        for name, value in expected.items():
            assert abs(float(scores[name][i]) - value) <= 1e-10 * abs(value), name
