"""The steepest directions of single Gaussians: their curvatures are the scene's, and Lanczos is quicker from them."""

import pytest
import torch

from landscape.eigen import EigenSettings, extreme_eigenpairs
from splat.curvature import SceneHessian, SceneObjective
from splat.losses import LossSettings
from splat.own_directions import steepest_own
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians


@pytest.fixture(scope="module")
def objective() -> SceneObjective:
    return SceneObjective(random_gaussians(40, 1, logit=1.0), two_views(), LossSettings(ssim_weight=0.0), BACKGROUND)


def test_the_curvature_along_them_is_the_largest_and_least_of_any_gaussian_alone(objective):
    H = SceneHessian(objective)
    dense, n = H.apply(torch.eye(H.dim, dtype=H.dtype)), len(objective.active)
    # of one Gaussian: rows of its mean, log-scales, quaternion and logit
    widths = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1}
    values = []
    for i in range(n):
        rows = torch.cat([torch.arange(k) + objective.blocks[name].start + i * k for name, k in widths.items()])
        values.append(torch.linalg.eigvalsh(dense[rows][:, rows]))
    values = torch.cat(values).sort().values
    V = steepest_own(objective, objective.block_diagonal(), 3, 2)
    assert torch.allclose(V.norm(dim=0), torch.ones(5, dtype=V.dtype))
    assert torch.allclose(H.project(V), V, atol=1e-12)
    found = (V * H.apply(V)).sum(dim=0)
    expected = torch.cat([values[-3:].flip(0), values[:2]])
    assert torch.allclose(found, expected, rtol=1e-8, atol=1e-10 * float(values.abs().max()))


def test_lanczos_needs_fewer_products_from_them(objective):
    H, settings = SceneHessian(objective), EigenSettings(2, 1, rtol=1e-2)
    cold = extreme_eigenpairs(H, torch.Generator().manual_seed(0), settings)
    warm = extreme_eigenpairs(
        H, torch.Generator().manual_seed(0), settings, steepest_own(objective, objective.block_diagonal(), 2, 1)
    )
    assert warm.matvecs < cold.matvecs
    for pairs, others in ((cold.largest, warm.largest), (cold.smallest, warm.smallest)):
        assert torch.allclose(pairs.values, others.values, rtol=1e-2)
