"""The bridge against double backward in float64, and against the exact operators of a trained scene of splats in float32."""

from collections.abc import Callable
from dataclasses import replace
from math import sqrt

import pytest
import torch
from torch import Tensor

from landscape.errors import InputError
from landscape.operators import renderer
from landscape.operators.renderer import RendererHessian
from notebooks.renderer.scenes import demo, directions
from tests.landscape.foreign import Bumps
from tests.refusals import refused


def vectors(dim: int, count: int = 3, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(dim, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)


def error(found: Tensor, exact: Tensor) -> float:
    return float((found.double() - exact).norm() / exact.norm())


def gauss_newton(bumps: Bumps) -> Tensor:
    """J^T l'' J of every view, dense."""
    total = torch.zeros(24, 24, dtype=torch.float64)
    for view in bumps.views:
        theta = torch.cat([value.detach() for value in bumps.named.values()])

        def image(theta: Tensor, view: float = view) -> Tensor:
            return bumps.image(dict(zip(bumps.named, theta.split(6), strict=True)), view)

        J = torch.autograd.functional.jacobian(image, theta)
        curvature = torch.autograd.functional.hessian(lambda x, view=view: bumps.loss(x, view), image(theta))
        total += J.T @ curvature @ J / len(bumps.views)
    return total


def test_products_value_and_gradient_are_those_of_double_backward():
    bumps = Bumps()
    H, exact, V = bumps.hessian(), bumps.exact(), vectors(24)
    assert error(H.apply(V), exact.apply(V)) < 1e-6
    assert error(H.gauss_newton.apply(V), gauss_newton(bumps) @ V) < 1e-6
    assert H.value == pytest.approx(exact.value, rel=1e-14)
    assert error(H.gradient, exact.gradient) < 1e-14
    assert H.blocks["depths"] == slice(6, 12) and H.deterministic


def test_the_error_in_float32_is_within_the_stated_one():
    single, exact, V = Bumps(torch.float32).hessian(), Bumps().exact(), vectors(24, 8)
    found = single.apply(V.float()).double()
    errors, stated = (found - exact.apply(V)).norm(dim=0), single.error(V.float())
    assert (errors < stated.total).all()
    assert stated.total.norm() < 0.02 * found.norm()


def test_a_product_with_several_vectors_is_that_with_each():
    H, V = Bumps().hessian(), vectors(24)
    assert torch.equal(H.apply(V), torch.cat([H.apply(v[:, None]) for v in V.T], dim=1))
    assert H.apply(V[:, :0]).shape == (24, 0) and not H.apply(torch.zeros(24, 1).double()).any()


def failing(bumps: Bumps, last: int) -> Callable[[Tensor], Tensor]:
    def change(image: Tensor) -> Tensor:
        if bumps.renders >= last:
            raise ZeroDivisionError
        return image

    return change


def test_parameters_come_back_to_the_bit_after_an_exception_too():
    bumps = Bumps(torch.float32)
    H, before = bumps.hessian(), {name: value.detach().clone() for name, value in bumps.named.items()}
    H.apply(vectors(24, dtype=torch.float32))
    for last in range(1, 12):
        bumps.renders = 0
        bumps.change = failing(bumps, last)
        with pytest.raises(ZeroDivisionError):
            H.apply(vectors(24, dtype=torch.float32))
        assert all(torch.equal(bumps.named[name], before[name]) for name in before)


def test_products_cost_the_passes_that_are_stated():
    bumps, pulled = Bumps(), []

    def counted(image: Tensor) -> Tensor:
        if image.requires_grad:
            image.register_hook(lambda _: pulled.append(1))
        return image

    bumps.change = counted
    H = bumps.hessian()
    for operator in (H, H.gauss_newton):
        bumps.renders = 0
        pulled.clear()
        operator.apply(vectors(24, 2))
        assert (bumps.renders, len(pulled)) == operator.passes(vectors=2)


def test_without_memory_for_the_gradients_of_views_products_are_the_same_for_a_pass_more(monkeypatch):
    kept = Bumps().hessian()
    assert kept.passes(vectors=1) == (3 * 3 + 2, 3 * 3)
    monkeypatch.setattr(renderer, "KEPT", 24 * 8)  # one view
    fewer, V = Bumps().hessian(), vectors(24)
    assert torch.equal(fewer.apply(V), kept.apply(V)) and fewer.passes(vectors=1) == (3 * 3 + 2, 3 * 3 + 2)


def test_products_at_other_parameters_are_refused():
    bumps = Bumps()
    H = bumps.hessian()
    with torch.no_grad():
        bumps.named["depths"] += 1e-3
    for operator in (H, H.gauss_newton):
        refused("parameters that the operator was made at", operator.apply, vectors(24))


def test_jumps_of_the_image_are_left_out(monkeypatch):
    """Weights under 0.3 are dropped.  With central differences, the products at the same steps are all jumps."""
    H, exact = Bumps(torch.float32, cut=0.3).hessian(noise=3e-6), Bumps(cut=0.3).exact()
    V = vectors(24, 8, torch.float32)
    assert error(H.apply(V), exact.apply(V.double())) < 0.05
    monkeypatch.setattr(renderer, "one_sided", lambda ahead, behind: ((ahead + behind) / 2, torch.zeros(40) > 0))
    assert error(H.apply(V), exact.apply(V.double())) > 1


def test_a_view_that_a_vector_does_not_change_adds_nothing():
    seen = {0: torch.ones(2, dtype=torch.float64, requires_grad=True), 1: torch.ones(2, dtype=torch.float64)}
    seen[1].requires_grad_()
    H = RendererHessian(
        lambda view: seen[view] ** 2, {"a": seen[0], "b": seen[1]}, lambda image, _: image.square().sum(), [0, 1]
    )
    exact = torch.eye(4, dtype=torch.float64) * 12 / 2  # of x^4, over two views
    assert (H.apply(torch.eye(4, dtype=torch.float64)) - exact).norm() < 1e-6 * exact.norm()


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_a_view_that_changes_by_its_noise_alone_adds_nothing_and_finds_no_step(noise):
    seen, generator = [torch.ones(2, dtype=torch.float64, requires_grad=True) for _ in range(2)], torch.Generator()

    def render(view: int) -> Tensor:
        return (seen[view] ** 2).repeat(200) + noise * torch.randn(400, generator=generator, dtype=torch.float64)

    H = RendererHessian(render, {"a": seen[0], "b": seen[1]}, lambda image, _: image.square().sum() / 200, [0, 1])
    V = torch.eye(4, dtype=torch.float64)[:, 2:]  # the second view alone
    found, stated = H.measured(V)
    exact = torch.eye(4, dtype=torch.float64)[:, 2:] * 12 / 2
    assert ((found - exact).norm(dim=0) <= stated.total + 10 * noise).all() and stated.total.max() < 20 * sqrt(noise)
    assert (found - exact).norm() < 3 * sqrt(noise) * exact.norm()


def test_noise_lengthens_the_steps_and_enters_the_error():
    bumps, generator = Bumps(), torch.Generator().manual_seed(0)
    bumps.change = lambda image: image + 1e-4 * torch.randn(40, generator=generator, dtype=torch.float64)
    H, V = bumps.hessian(), vectors(24, 4)
    size = float(torch.stack([bumps.image(bumps.named, 0.0)]).detach().square().mean().sqrt())
    assert not H.deterministic and 0.5e-4 < H.noise * size < 2e-4 and H.change == sqrt(H.noise)
    exact, stated = bumps.exact().apply(V), H.error(V)
    assert (stated.noise > 0).all()
    assert ((H.apply(V) - exact).norm(dim=0) < stated.total).all()
    assert (H.apply(V) - exact).norm() < 0.3 * exact.norm()


def test_a_stated_noise_is_taken_where_it_is_more():
    assert Bumps().hessian(noise=0.25).change == 0.5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda image: image / 0 * 0, "finite image of view 0, got NaN or infinity in 40 of its 40"),
        (lambda image: image.detach(), "depends on the parameters, got a tensor without a gradient for view 0"),
        (lambda image: image.detach().numpy(), "depends on the parameters, got ndarray for view 0"),
    ],
)
def test_an_image_that_cannot_be_used_is_refused(change, words):
    refused(words, Bumps(change=change).hessian)


def test_an_image_that_changes_its_size_or_becomes_nan_is_refused():
    bumps = Bumps()
    H = bumps.hessian()
    bumps.renders = 0
    bumps.change = lambda image: image if bumps.renders < 8 else image[:39]
    refused("images of one size for view 0", H.apply, vectors(24))
    bumps.change = lambda image: image if image.requires_grad else image * torch.nan
    refused("finite image of view 0 in every render", H.apply, vectors(24))


@pytest.mark.parametrize("loss", [lambda i, _: i.square(), lambda i, _: i.sum().item(), lambda i, _: i.sum() / 0])
def test_a_loss_that_cannot_be_used_is_refused(loss):
    bumps = Bumps()
    with pytest.raises(InputError, match="finite scalar tensor that depends on the image as loss of view 0"):
        RendererHessian(bumps.render, bumps.named, loss, bumps.views)


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ({}, "got dict without any"),
        ({"a": torch.ones(2)}, "leaf tensors that require a gradient as parameters, got another as 'a'"),
        ({"a": torch.full((2,), torch.nan, requires_grad=True)}, "finite parameters, got NaN or infinity in 'a'"),
        (
            {"a": torch.ones(2, requires_grad=True), "b": torch.ones(2, requires_grad=True, dtype=torch.float64)},
            "of one type on one device",
        ),
    ],
)
def test_parameters_that_cannot_be_moved_are_refused(named, words):
    refused(words, RendererHessian, lambda _: torch.ones(1), named, lambda image, _: image.sum(), [0])


def test_no_view_and_a_negative_noise_are_refused():
    bumps = Bumps(views=())
    refused("at least one view", bumps.hessian)
    refused("noise of 0 or more", Bumps().hessian, noise=-1.0)


def test_on_a_trained_scene_of_splats_in_float32_the_stated_errors_hold():
    """L1 + SSIM, jumps at 1/255 and in the depth order: a naive difference is off by more than the product's length."""
    scene = replace(demo(), dtype=torch.float32)
    H = scene.foreign()
    _, V = directions(H.blocks, H.dim, each=4)
    for operator, exact, bound in ((H, scene.exact, 0.25), (H.gauss_newton, scene.exact_gauss_newton, 0.05)):
        truth = exact.apply(V).clone()
        errors, stated = (operator.apply(V.float()) - truth).norm(dim=0), operator.error(V.float())
        assert errors.norm() < bound * truth.norm()
        assert int((errors < stated.total).sum()) >= 0.9 * len(errors)
        assert stated.total.norm() < 2 * bound * truth.norm()
        assert (stated.kinks[-4:] < 1e-3).all()  # colours move no edge
