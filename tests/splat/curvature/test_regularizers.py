"""Regularisers of opacities and scales in the loss of a scene: every product against double autograd of the written formula."""

import pytest
import torch

from analysis.measures.gradient_check import check_against_gradient
from splat.curvature.fields import scene_fields
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import block_traces, exact_traces
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from tests.splat.held_scenes import BACKGROUND, gradient_and_products, mean_loss, two_views
from tests.splat.random_scenes import random_gaussians, random_like
from tests.splat.tolerances import errors_by_block, relative_error

BOTH = LossSettings("charbonnier", opacity_reg=0.7, scale_reg=0.4)
EACH = [BOTH, LossSettings(opacity_reg=0.7), LossSettings("l2", ssim_weight=0, scale_reg=0.4)]


def scene(loss: LossSettings = BOTH) -> tuple[Gaussians, SceneObjective]:
    """Some Gaussians of which three are behind the cameras."""
    gaussians = random_gaussians(20, 1, logit=1.0)
    gaussians.quats.div_(gaussians.quats.norm(dim=1, keepdim=True))
    gaussians.means[:3, 2] = -6.0
    objective = SceneObjective(gaussians, two_views(), loss, BACKGROUND)
    assert not objective.mask[:3].any()
    return gaussians, objective


def seen(gaussians: Gaussians, objective: SceneObjective, rows: torch.Tensor) -> torch.Tensor:
    """Rows over all Gaussians' parameters as rows over those of the active ones."""
    return torch.stack([gaussians.with_flat(row.contiguous()).select(objective.mask).flat for row in rows.T], dim=1)


@pytest.mark.parametrize("loss", EACH, ids=["both", "opacity", "scale"])
def test_loss_gradient_and_products_are_those_of_the_whole_scenes_mean(loss):
    gaussians, objective = scene(loss)
    U = random_like((gaussians.flat.numel(), 3), 1)
    for part in gaussians.blocks.values():  # nothing moves out of sight: the active Gaussians' part of H
        U[part].view(len(gaussians), -1, 3)[~objective.mask] = 0
    gradient, products = gradient_and_products(gaussians, two_views(), loss, U)
    active, expected = objective.active, float(mean_loss(gaussians, two_views(), loss))
    assert objective.loss(active.flat) == pytest.approx(expected, rel=1e-13)
    assert float(objective.losses.mean()) == pytest.approx(expected, rel=1e-13)
    wanted = seen(gaussians, objective, gradient[:, None])[:, 0]
    assert max(errors_by_block(objective.gradient, wanted, active.blocks).values()) < 1e-12
    found = SceneHessian(objective, keep_null=True).apply(seen(gaussians, objective, U))
    errors = errors_by_block(found, seen(gaussians, objective, products), active.blocks)
    assert max(errors.values()) < 1e-12, errors
    bare = SceneHessian(scene(LossSettings(loss.pixel, loss.ssim_weight))[1], keep_null=True)
    assert relative_error(found, bare.apply(seen(gaussians, objective, U))) > 1e-4


def test_a_vector_that_moves_only_what_one_view_does_not_draw_is_curved_all_the_same():
    gaussians, _ = scene()
    gaussians.means[3:] += torch.tensor([0.0, 0.0, 20.0], dtype=torch.float64)
    away = two_views()[1]
    away.camera.rotation.mul_(torch.tensor([[-1.0], [1.0], [-1.0]], dtype=torch.float64))  # looks back
    gaussians.means[0] = torch.tensor([0.0, 0.0, -4.0], dtype=torch.float64)
    objective = SceneObjective(gaussians, [two_views()[0], away], BOTH, BACKGROUND)
    U = torch.zeros_like(objective.active.flat)
    objective.active.with_flat(U).opacity_logits[0] = 1.0
    H = SceneHessian(objective, keep_null=True)
    forms = H.by_view(U[:, None])[:, 0]
    omega = objective.active.opacity_logits[0].sigmoid()
    R = float(0.7 / len(gaussians) * omega * (1 - omega) * (1 - 2 * omega))
    assert float(U @ H.apply(U[:, None])[:, 0]) == pytest.approx(float(forms.mean()), rel=1e-12)
    assert min(abs(float(form) - R) for form in forms) < 1e-12 * abs(R) and objective.counts.views == 2


def test_blocks_and_traces_are_those_of_the_dense_hessian_and_gauss_newton_has_none():
    objective, bare = scene()[1], scene(LossSettings("charbonnier"))[1]
    identity = torch.eye(objective.active.flat.numel(), dtype=torch.float64)
    H = SceneHessian(objective, keep_null=True).apply(identity)
    logits, scales = objective.blocks["opacity_logits"], objective.blocks["log_scales"]
    exact, gauss_newton = objective.exact_blocks, objective.exact_gauss_newton_blocks
    for blocks in (exact, objective.approximate_blocks[0]):
        added = blocks.geometry - (bare.exact_blocks if blocks is exact else bare.approximate_blocks[0]).geometry
        difference = H - SceneHessian(bare, keep_null=True).apply(identity)
        torch.testing.assert_close(added[:, 10, 10], difference.diagonal()[logits], rtol=1e-9, atol=1e-15)
        torch.testing.assert_close(
            added.diagonal(dim1=1, dim2=2)[:, 3:6].reshape(-1), difference.diagonal()[scales], rtol=1e-9, atol=1e-15
        )
    diagonal = exact.diagonals
    torch.testing.assert_close(diagonal["opacity_logits"][:, 0], H.diagonal()[logits], rtol=1e-10, atol=1e-14)
    assert torch.equal(gauss_newton.geometry, bare.exact_gauss_newton_blocks.geometry)
    assert torch.equal(*(SceneHessian(x, gauss_newton=True, keep_null=True).apply(identity) for x in (objective, bare)))
    traces = exact_traces(objective, torch.Generator().manual_seed(0), samples=64)
    for name, trace in block_traces(objective).items():
        projected = SceneHessian(objective).apply(identity).diagonal()[objective.blocks[name]].sum()
        if name != "sh":  # whose null space the traces leave in
            assert trace.value == pytest.approx(float(projected), rel=1e-9)
        assert traces[name].low <= trace.value <= traces[name].high
    fields = scene_fields(objective)[0]
    total = float(block_traces(objective)["opacity_logits"].value)
    assert float(fields["trace_opacity_logits"].sum()) == pytest.approx(total, rel=1e-12)


def test_differences_of_the_gradient_agree_and_the_active_gaussians_alone_have_their_share():
    gaussians, objective = scene()
    check = check_against_gradient(SceneHessian(objective), torch.Generator().manual_seed(0))
    assert check.error < 1e-4
    alone = SceneObjective(gaussians.select(objective.mask), two_views(), objective.loss_of_active, BACKGROUND)
    torch.testing.assert_close(alone.gradient, objective.gradient, rtol=1e-12, atol=1e-16)
    single = SceneObjective(gaussians.to(torch.float32), two_views(), BOTH, BACKGROUND.float())
    assert check_against_gradient(SceneHessian(single), torch.Generator().manual_seed(0)).error < 1e-3
