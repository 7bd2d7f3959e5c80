"""The variance of pixels against J B^-1 J^T of dense matrices in float64."""

import pytest
import torch

from splat.curvature.fields import complement
from splat.curvature.linearize import LinearizedView
from splat.curvature.scores.information import information, pixel_variance, prior_of, pushed
from splat.losses.reference import LossSettings
from splat.render.backend import backend_of
from tests.splat.held_scenes import BACKGROUND
from tests.splat.random_scenes import random_camera, random_gaussians


@pytest.mark.parametrize("diagonal", [False, True])
def test_variances_are_those_of_the_dense_covariance(diagonal):
    cameras = [random_camera(30, 22, seed=seed, focal=28.0) for seed in (1, 2)]
    gaussians = random_gaussians(6, sh_degree=1, seed=4, spread=0.5).to(torch.float64)
    gaussians.quats.div_(gaussians.quats.norm(dim=1, keepdim=True))
    seen = information(gaussians, cameras[0], BACKGROUND)
    total = seen + prior_of(seen)
    loss = backend_of(gaussians.flat).view_loss(
        torch.zeros(3, 22, 30), LossSettings("l2", ssim_weight=0), gaussians.flat
    )
    view = LinearizedView(gaussians, cameras[1], loss, BACKGROUND)
    J = view.jvp(torch.eye(gaussians.flat.numel(), dtype=torch.float64))[:, :3]
    exact, rows = torch.zeros(22, 30, dtype=torch.float64), gaussians.blocks
    for i, E in enumerate(complement(gaussians.quats)):
        names = ("means", "log_scales", "quats", "opacity_logits")
        own = torch.cat([torch.arange(len(J))[rows[name]].view(6, -1)[i] for name in names])
        B = total.geometry[i].diagonal().diag() if diagonal else total.geometry[i]
        exact += torch.einsum("icyx,ij,jcyx->yx", J[own], E @ B.inverse() @ E.T, J[own])
        sh = torch.arange(len(J))[rows["sh"]].view(6, -1)[i]
        exact += torch.einsum("icyx,i->yx", J[sh].square(), 1 / total.sh[i].flatten())
    n, q = 6, 10 + total.sh[0].numel()
    every = torch.stack([torch.eye(n * q, dtype=torch.float64)[i * q : i * q + q] for i in range(n)])
    whole = torch.einsum("pcyx,pk->kcyx", J, pushed(total, gaussians, every, diagonal=diagonal))
    assert (whole.square().sum(dim=(0, 1)) - exact).abs().max() <= 1e-10 * exact.max()
    sampled = pixel_variance(view, total, torch.Generator().manual_seed(0), 400, diagonal=diagonal)
    off = ((sampled - exact) / exact.clamp_min(1e-12))[exact > 1e-6 * exact.max()]
    assert off.abs().max() < 6 * (2 / 400) ** 0.5 and off.square().mean().sqrt() < (2 / 400) ** 0.5 * 1.3
