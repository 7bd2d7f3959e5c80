"""Information of views and gains of candidates against dense Jacobians in float64."""

import numpy as np
import pytest
import torch
from scipy.linalg import null_space

from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS
from splat.curvature.linearize import LinearizedView
from splat.curvature.scores.information import COLUMNS, FISHERRF_LAMBDA, GAINS, PRIOR, gains, information, prior_of
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.render.backend import backend_of
from tests.splat.held_scenes import BACKGROUND
from tests.splat.random_scenes import random_camera, random_gaussians

CAMERAS = [random_camera(30, 22, seed=seed, focal=28.0) for seed in (1, 2, 5)]


def toy() -> Gaussians:
    gaussians = random_gaussians(6, sh_degree=1, seed=4, logit=0.0, spread=0.5).to(torch.float64)
    gaussians.sh[:, 0] = gaussians.sh[:, 0].abs() + 0.5  # no channel is clamped
    gaussians.quats.div_(gaussians.quats.norm(dim=1, keepdim=True))
    return gaussians


def jacobian(gaussians: Gaussians, camera) -> np.ndarray:
    """(p, 3, pixels)"""
    loss = backend_of(gaussians.flat).view_loss(
        torch.zeros(3, 22, 30), LossSettings("l2", ssim_weight=0), gaussians.flat
    )
    view = LinearizedView(gaussians, camera, loss, BACKGROUND)
    return view.jvp(torch.eye(gaussians.flat.numel(), dtype=torch.float64))[:, :3].flatten(2).numpy()


def dense(gaussians: Gaussians, camera) -> list[dict[str, np.ndarray]]:
    """Of every Gaussian: its block across the quaternion's length, its SH diagonal, and that of the channels' sum."""
    J, found = jacobian(gaussians, camera), []
    rows = {name: np.arange(len(J))[span].reshape(len(gaussians), -1) for name, span in gaussians.blocks.items()}
    for i, q in enumerate(gaussians.quats.numpy()):
        w, x, y, z = q
        turns = np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])
        assert np.allclose(turns @ turns.T, null_space(q[None]) @ null_space(q[None]).T)
        E = np.zeros((11, 10))
        E[:6, :6], E[6:10, 6:9], E[10, 9] = np.eye(6), turns, 1
        own = E.T @ J[np.concatenate([rows[name][i] for name in GEOMETRY_COLUMNS])].reshape(11, -1)
        sh = (J[rows["sh"][i]] ** 2).sum(axis=(1, 2))
        summed = (own.reshape(10, 3, -1).sum(axis=1) ** 2).sum(axis=1)[[0, 1, 2, 3, 4, 5, 9]]  # FisherRF's: no rotation
        found.append({"block": own @ own.T, "sh": sh, "summed": np.concatenate([summed, sh])})
    return found


@pytest.fixture(scope="module")
def views() -> list[list[dict[str, np.ndarray]]]:
    return [dense(toy(), camera) for camera in CAMERAS]


def test_information_is_that_of_the_dense_jacobian(views):
    for camera, expected in zip(CAMERAS, views, strict=True):
        found = information(toy(), camera, BACKGROUND)
        for name, own in {"block": found.geometry, "sh": found.sh.flatten(1), "summed": found.summed}.items():
            exact = np.stack([each[name] for each in expected])
            assert np.abs(own.numpy() - exact).max() <= 1e-10 * np.abs(exact).max(), name


def test_gains_are_those_of_dense_matrices(views):
    infos = [information(toy(), camera, BACKGROUND) for camera in CAMERAS]
    seen, candidate = infos[0] + infos[1], infos[2]
    found = gains(seen, prior_of(seen), candidate)
    B = np.stack([a["block"] + b["block"] for a, b in zip(*views[:2], strict=True)])
    sh = np.stack([a["sh"] + b["sh"] for a, b in zip(*views[:2], strict=True)])
    prior = np.zeros(10)
    for columns in COLUMNS.values():
        prior[columns] = PRIOR * B[:, range(10), range(10)][:, columns].mean()
    expected, scale = dict.fromkeys(GAINS, 0.0), np.diag(prior**-0.5)
    for i, c in enumerate(views[2]):
        b, s = B[i] + np.diag(prior), sh[i] + PRIOR * sh.mean()
        expected["d"] += np.linalg.slogdet(b + c["block"])[1] - np.linalg.slogdet(b)[1] + np.log1p(c["sh"] / s).sum()
        expected["t"] += np.trace(np.linalg.inv(b) @ c["block"]) + (c["sh"] / s).sum()
        least = [np.linalg.eigvalsh(scale @ M @ scale)[0] for M in (b, b + c["block"])]
        expected["e"] += np.log(least[1] / least[0])
        expected["d_diagonal"] += np.log1p(np.diag(c["block"]) / np.diag(b)).sum() + np.log1p(c["sh"] / s).sum()
        summed = views[0][i]["summed"] + views[1][i]["summed"]
        expected["published"] += (c["summed"] / (summed + FISHERRF_LAMBDA)).sum()
    assert list(found) == list(GAINS)
    for name in GAINS:
        assert found[name] == pytest.approx(expected[name], rel=1e-9), name


def test_a_view_that_sees_nothing_adds_nothing_and_a_view_again_adds_less():
    gaussians = toy()
    seen = information(gaussians, CAMERAS[0], BACKGROUND)
    far = gaussians.with_flat(gaussians.flat.clone())
    far.means[:] = torch.tensor([0.0, 0.0, -50.0], dtype=torch.float64)
    nothing = gains(seen, prior_of(seen), information(far, CAMERAS[0], BACKGROUND))
    assert all(abs(value) < 1e-9 for value in nothing.values())
    again, other = (
        gains(seen, prior_of(seen), information(gaussians, camera, BACKGROUND))["d"] for camera in CAMERAS[:2]
    )
    assert 0 < again < other
