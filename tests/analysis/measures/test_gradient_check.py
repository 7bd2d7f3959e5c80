"""H v against differences of the gradient: what of the views is compared."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from analysis.measures import gradient_check
from analysis.measures.gradient_check import ENOUGH, check_against_gradient
from splat.curvature.hessian import SceneHessian
from splat.curvature.linearize import LinearizedView
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.render.render import render
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians

LOSS = LossSettings("charbonnier")


@pytest.mark.parametrize("views", [1, 2])
def test_the_exact_product_agrees_with_the_gradient_of_the_views_compared(views) -> None:
    hessian = SceneHessian(SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LOSS, BACKGROUND))
    counted: list[int] = []
    check = check_against_gradient(hessian, torch.Generator().manual_seed(0), lambda n, *_: counted.append(n), views)
    assert check.error < 1e-4 and check.rounding == 0 and counted


def twice(view: LinearizedView) -> Callable[..., torch.Tensor]:
    """Its products, wrong by a factor of 2."""
    right = view.hvp

    def wrong(V: torch.Tensor, total: torch.Tensor | None = None, *, ssim_window: bool = True) -> torch.Tensor:
        product = 2 * right(V, ssim_window=ssim_window)
        return product if total is None else total.add_(product)

    return wrong


def test_a_wrong_view_is_found_where_it_is_among_those_compared(monkeypatch) -> None:
    hessian = SceneHessian(SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LOSS, BACKGROUND))
    first, second = hessian.objective.linearized
    monkeypatch.setattr(second, "hvp", twice(second))
    errors = [check_against_gradient(hessian, torch.Generator().manual_seed(0), views=views).error for views in (1, 2)]
    assert errors[0] < 1e-4 and errors[1] > 0.1
    monkeypatch.setattr(first, "hvp", twice(first))
    assert check_against_gradient(hessian, torch.Generator().manual_seed(0), views=1).error > 0.1


def test_an_order_that_only_double_tells_apart_is_no_error() -> None:
    gaussians, views = random_gaussians(60, 1, logit=1.0).to(torch.float32), two_views()[:1]
    camera = views[0].camera
    depths = (gaussians.means - camera.centre.float()) @ camera.forward.float()
    gaussians.means.sub_((depths - depths.mean())[:, None] * camera.forward.float())  # a wall, to single precision
    hessian = SceneHessian(SceneObjective(gaussians, views, LOSS, BACKGROUND))
    check = check_against_gradient(hessian, torch.Generator().manual_seed(0))
    assert check.error < 1e-4 and check.rounding == 0


def test_residuals_keep_the_sign_that_single_precision_gives_them_and_are_counted() -> None:
    gaussians, view = random_gaussians(15, 1, logit=1.0).to(torch.float32), two_views()[0]
    fitted = render(gaussians, view.camera, BACKGROUND.float()).image
    hessian = SceneHessian(SceneObjective(gaussians, [replace(view, image=fitted)], LossSettings("l1"), BACKGROUND))
    check = check_against_gradient(hessian, torch.Generator().manual_seed(0))
    assert check.rounding == 0 and check.signs > 0 and check.error < 1e-3


def test_a_residual_next_to_zero_changes_its_sign_and_is_no_error() -> None:
    """Without the signs of theta, the gradient would jump there by more than all that H v is."""
    gaussians, view = random_gaussians(15, 1, logit=1.0), two_views()[0]
    close = render(gaussians, view.camera, BACKGROUND).image + 0.1
    close[:, 5, 5] -= 0.1 - 1e-12
    objective = SceneObjective(gaussians, [replace(view, image=close)], LossSettings("l1"), BACKGROUND)
    check = check_against_gradient(SceneHessian(objective), torch.Generator().manual_seed(0))
    assert (check.views, check.left_out) == (1, 0) and check.signs > 0 and check.error < 1e-4


def test_a_splat_at_its_threshold_makes_a_step_shorter_or_leaves_the_view_out(monkeypatch) -> None:
    gaussians, views = random_gaussians(15, 1, logit=1.0), two_views()
    objective = SceneObjective(gaussians, views, LOSS, BACKGROUND)
    whole = check_against_gradient(SceneHessian(objective), torch.Generator().manual_seed(0))
    render_at = gradient_check._Gradient.__call__

    def jumping(self, theta):
        """A pixel of the first view jumps at steps above the third."""
        gradient, image = render_at(self, theta)
        far = float((theta - objective.active.flat).abs().max())
        if self.camera is views[0].camera and far > reach:
            image[0, 0, 0] += 1e-3 * float(theta[0] > objective.active.flat[0])
        return gradient, image

    monkeypatch.setattr(gradient_check._Gradient, "__call__", jumping)
    for reach, left_out in ((1e-10, 0), (0.0, 1)):  # noqa: B007 (used by `jumping`)
        check = check_against_gradient(SceneHessian(objective), torch.Generator().manual_seed(0))
        assert (check.views, check.left_out) == (2 - left_out, left_out) and check.error < 1e-3
    assert whole.step == 1e-10


def test_single_precision_that_passes_is_closer_than_a_thousandth():
    assert ENOUGH < 1e-3
