"""H v against differences of the gradient: what of the views is compared."""

import pytest
import torch

from analysis.measures.gradient_check import check_against_gradient
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians

LOSS = LossSettings("charbonnier")


@pytest.mark.parametrize("views", [1, None])
def test_the_exact_product_agrees_with_the_gradient_of_the_views_compared(views) -> None:
    hessian = SceneHessian(SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LOSS, BACKGROUND))
    counted: list[int] = []
    check = check_against_gradient(
        hessian, torch.Generator().manual_seed(0), lambda done, *_: counted.append(done), views
    )
    assert check.error < 1e-4 and counted


def test_a_wrong_view_is_found_where_it_is_among_those_compared(monkeypatch) -> None:
    hessian = SceneHessian(SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LOSS, BACKGROUND))
    first, second = hessian.objective.linearized
    monkeypatch.setattr(second, "hvp", lambda V: 2 * type(second).hvp(second, V))
    errors = [
        check_against_gradient(hessian, torch.Generator().manual_seed(0), views=views).error for views in (1, None)
    ]
    assert errors[0] < 1e-4 and errors[1] > 0.1
    monkeypatch.setattr(first, "hvp", lambda V: 2 * type(first).hvp(first, V))
    assert check_against_gradient(hessian, torch.Generator().manual_seed(0), views=1).error > 0.1
