"""The share of H within the Gaussians' blocks against dense matrices in float64."""

from math import isnan

import numpy as np
import pytest
import torch

from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS
from splat.curvature.hessian import ViewSum
from splat.curvature.objective import SceneObjective
from splat.curvature.scores.shares import block_shares
from splat.losses.reference import LossSettings
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians

SSIM = LossSettings("charbonnier", ssim_weight=0.4)


def toy(loss: LossSettings) -> SceneObjective:
    gaussians = random_gaussians(6, sh_degree=1, seed=4, logit=1.0, spread=0.5).to(torch.float64)
    return SceneObjective(gaussians, two_views(), loss, BACKGROUND)


def dense(objective: SceneObjective, gauss_newton: bool, coupled: bool) -> np.ndarray:
    """P H P as a matrix, of the products that `test_hessian.py` holds to the specification, and of J."""
    active, unit = objective.active, torch.eye(objective.active.flat.numel(), dtype=torch.float64)
    H = ViewSum(objective, gauss_newton=gauss_newton).apply(unit)
    if not coupled:  # J^T l'' J is exchanged for J^T D J
        H -= ViewSum(objective, gauss_newton=True).apply(unit)
        for view in objective.linearized:
            J, D = view.jvp(unit)[:, :3].flatten(1), view._raster.crop(view._loss.diagonal).flatten()
            H += (J * D) @ J.T
    H /= len(objective.views)
    P = unit.clone()
    start = objective.blocks["quats"].start
    for i, q in enumerate(active.quats):
        rows = slice(start + 4 * i, start + 4 * i + 4)
        P[rows, rows] -= torch.outer(q, q)
    return (P @ H @ P).numpy()


def expected(objective: SceneObjective, H: np.ndarray) -> list[float]:
    """Shares of the blocks, of the attributes' blocks, and of the diagonal."""
    n, kept = len(objective.active), [np.eye(len(H), dtype=bool) for _ in range(3)]
    index = {name: np.arange(len(H))[objective.blocks[name]].reshape(n, -1) for name in GEOMETRY_COLUMNS}
    for i in range(n):
        own = np.concatenate([index[name][i] for name in index])
        kept[0][np.ix_(own, own)] = True
        for name in index:
            kept[1][np.ix_(index[name][i], index[name][i])] = True
    return [float((H[mask] ** 2).sum() / (H**2).sum()) for mask in kept]


@pytest.mark.parametrize("loss", [LossSettings("l2", ssim_weight=0), SSIM], ids=["a sum over pixels", "with SSIM"])
def test_shares_are_those_of_dense_matrices(loss):
    objective = toy(loss)
    found = block_shares(objective, torch.Generator().manual_seed(0), samples=512)
    assert len(found) == (4 if objective.couples_pixels else 2)
    for one in found:
        H = dense(objective, one.gauss_newton, one.ssim_window)
        assert one.error < 0.06
        assert abs(one.norm / (H**2).sum() - 1) < 4 * one.error
        # numerators are exact: their ratios have no error
        shares, exact = [one.blocks, one.attributes, one.diagonal], expected(objective, H)
        assert np.allclose(np.array(shares) * one.norm, np.array(exact) * (H**2).sum(), rtol=1e-10)


def test_the_error_of_few_samples_covers_the_truth():
    """Of 16 estimates from 8 samples each, no more than a few are off by over two standard errors, and none by five."""
    objective = toy(LossSettings("l2", ssim_weight=0))
    truth = float((dense(objective, True, True) ** 2).sum())
    found = [block_shares(objective, torch.Generator().manual_seed(seed), samples=8)[1] for seed in range(16)]
    off = np.array([(one.norm - truth) / (one.error * one.norm) for one in found])
    assert (np.abs(off) > 2).sum() <= 4 and np.abs(off).max() < 5
    assert np.abs(off).mean() > 0.3  # an error is no bound


def test_an_operator_that_is_zero_has_no_share():
    found = block_shares(toy(LossSettings("l1", ssim_weight=0)), torch.Generator().manual_seed(0))
    assert not isnan(found[0].blocks) and isnan(found[1].blocks) and found[1].norm == 0
