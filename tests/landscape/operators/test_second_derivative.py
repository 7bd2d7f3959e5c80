"""Objectives that torch cannot differentiate twice are refused in words; kinks alone never are."""

import numpy as np
import pytest
import torch
from torch.autograd.function import once_differentiable

from landscape.errors import InputError
from landscape.operators.objective import ObjectiveHessian
from landscape.operators.operator import CountingOperator, DenseOperator
from landscape.operators.second_derivative import require_hessian
from tests.refusals import refused

X = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)


def square(double_backward):
    """A function x^2 whose backward pass is 2 x grad, as `double_backward` computes it from x and grad."""

    class Square(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            ctx.save_for_backward(x)
            return x.detach() ** 2

        @staticmethod
        def backward(ctx, grad):
            return double_backward(ctx.saved_tensors[0], grad)

    return Square.apply


class TwiceWrong(torch.autograd.Function):
    """2 x grad, whose own backward pass leaves out the derivative in x."""

    @staticmethod
    def forward(ctx, x, grad):
        ctx.save_for_backward(x)
        return 2 * x * grad

    @staticmethod
    def backward(ctx, grad):
        return None, 2 * ctx.saved_tensors[0] * grad


def straight_through(x):
    return x + (torch.round(4 * x) / 4 - x).detach()


@torch.no_grad()
def weights_of(x):
    return torch.exp(-x)


BACKWARDS = {
    "once differentiable": once_differentiable(lambda x, grad: 2 * x * grad),  # pyright: ignore
    "numpy": lambda x, grad: torch.from_numpy(2 * x.detach().numpy() * grad.detach().numpy()),
    "None for the second derivative": lambda x, grad: TwiceWrong.apply(x, grad),
}
PARTS = {
    **{name: lambda x, backward=backward: (square(backward)(x) ** 2).sum() for name, backward in BACKWARDS.items()},
    "a straight-through estimator": lambda x: (straight_through(x) ** 2).sum(),
    "torch.no_grad in a part": lambda x: (weights_of(x) * x**2).sum(),
    "an average of its own point": lambda x: ((x - 0.9 * x.detach()) ** 3).sum(),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("part", PARTS)
def test_a_backward_pass_without_a_derivative_is_refused(part, dtype):
    refused(r"expected products H v .*; take \.detach", ObjectiveHessian, PARTS[part], X.to(dtype) + 0.03)


def test_a_function_with_a_right_second_derivative_passes():
    H = ObjectiveHessian(lambda x: (square(lambda x, grad: 2 * x * grad)(x) ** 2).sum(), X)
    assert torch.equal(H.apply(torch.eye(3, dtype=X.dtype)), torch.diag(12 * X**2))


def test_a_part_of_a_thousandth_that_is_missing_is_seen_in_float64():
    refused(r"got ones 0\.1% off", ObjectiveHessian, lambda x: (x**2).sum() + 2e-3 * (x.detach() * x).sum(), X)


def relu_net(points, width):
    def loss(x):
        first, second = x[: 3 * width].view(width, 3), x[3 * width :].view(1, width)
        return ((torch.relu(points @ first.T) @ second.T) ** 2).mean()

    return loss, 4 * width


def l1_fit(points, width):
    """An l1 norm of as many residuals as there are points, near 0 like those of a fit."""
    matrix = torch.randn(3, width, dtype=points.dtype, generator=torch.Generator().manual_seed(1))
    noise = torch.randn(len(points), dtype=points.dtype, generator=torch.Generator().manual_seed(2)) / 20
    target = torch.tanh(points @ matrix @ POINT(width, points.dtype)) + noise
    return lambda x: (torch.tanh(points @ matrix @ x) - target).abs().mean(), width


def POINT(n, dtype):
    return torch.randn(n, dtype=dtype, generator=torch.Generator().manual_seed(3)) / 3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("points", [10, 1_000, 30_000])
@pytest.mark.parametrize("kinked", [relu_net, l1_fit])
def test_kinks_are_no_missing_derivative(kinked, points, dtype):
    drawn = torch.randn(points, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))
    loss, n = kinked(drawn, 8)
    assert ObjectiveHessian(loss, POINT(n, dtype)).dim == n


def test_a_missing_derivative_is_seen_beside_kinks():
    drawn = torch.randn(1000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    loss, n = l1_fit(drawn, 8)
    with pytest.raises(InputError, match="derivatives of the gradient"):
        ObjectiveHessian(lambda x: loss(x) + (x.detach() * x).sum(), POINT(n, torch.float64))


def test_a_point_on_a_kink_and_one_beside_the_end_of_the_domain_pass():
    assert not ObjectiveHessian(lambda x: (x - X).abs().sum(), X).apply(torch.ones(3, 1, dtype=X.dtype)).any()
    H = ObjectiveHessian(lambda x: -(x - 1 + 1e-9).log().sum(), X)
    assert torch.allclose(H.apply(torch.eye(3, dtype=X.dtype)).diag(), (X - 1 + 1e-9) ** -2)


def test_a_loss_that_draws_random_numbers_or_changes_its_own_state_is_refused():
    state = torch.ones(())

    def sampled(x):
        return (torch.rand(3) * x**2).sum()

    def averaged(x):
        state.mul_(0.9).add_(0.1 * x.detach().mean())
        return state * (x**2).sum()

    for loss in (sampled, averaged):
        refused("expected one gradient at one point, got two", ObjectiveHessian, loss, X)


def test_an_asymmetric_operator_is_refused():
    skew = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 0]], dtype=torch.float64)

    class Skewed(DenseOperator):
        def apply(self, V):
            return (self.matrix + skew) @ V

    refused("of a symmetric H", require_hessian, Skewed(torch.eye(3, dtype=X.dtype)), lambda x: x, X, X)


def test_the_check_takes_the_products_and_gradients_that_it_names():
    calls = []

    def counted(gradient):
        def call(x):
            calls.append(1)
            return gradient(x)

        return call

    H = CountingOperator(DenseOperator(torch.diag(12 * X**2)))
    assert require_hessian(H, counted(lambda x: 4 * x**3), X, 4 * X**3)
    assert H.matvecs == 2 and len(calls) == 3
    calls.clear()

    def rough(x):  # jumps between any two points, so that no step settles
        return 4 * x**3 + 1e-2 * torch.sin(1e15 * (x - X)) * (x != X)

    assert not require_hessian(H, counted(rough), X, 4 * X**3)
    assert len(calls) == 16


def test_a_derivative_is_confirmed_in_either_dtype_and_hidden_by_kinks():
    points = torch.from_numpy(np.linspace(-1, 1, 101))

    def gradient(x):
        x = x.detach().requires_grad_()
        return torch.autograd.grad((points.to(x.dtype) - x.mean()).abs().mean(), x)[0]

    for dtype in (torch.float32, torch.float64):
        zero, center = DenseOperator(torch.zeros(3, 3, dtype=dtype)), torch.full((3,), 0.013, dtype=dtype)
        assert require_hessian(zero, gradient, center, gradient(center))
