from math import inf

import numpy as np
import pytest
import torch

from landscape.operators.checks import check_gradient, check_objective, check_operator
from landscape.operators.objective import ObjectiveHessian
from landscape.operators.operator import CountingOperator, DenseOperator, ScaledOperator
from tests.oracles import symmetric_matrix
from tests.refusals import misused

N = 60
A = torch.from_numpy(symmetric_matrix(np.linspace(-1, 2, N), seed=0))


class Any:
    """Any function of V in the place of an operator."""

    def __init__(self, function, dtype=torch.float64):
        self.function, self.dtype, self.dim, self.blocks = function, dtype, N, {"all": slice(0, N)}

    def apply(self, V):
        return self.function(V)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_symmetric_matrix_passes_at_the_dtypes_round_off(dtype):
    check = check_operator(DenseOperator(A.to(dtype)), generator())
    assert check.passed
    assert 0 < check.noise < 10 * torch.finfo(dtype).eps
    assert check.symmetry < 10 * torch.finfo(dtype).eps


def test_the_asymmetry_is_the_frobenius_norm_of_the_antisymmetric_part():
    skew = torch.randn(N, N, generator=generator(1), dtype=torch.float64)
    matrix = A + 1e-3 * (skew - skew.T)
    check = check_operator(Any(lambda V: matrix @ V), generator(), vectors=32)
    expected = float((matrix - matrix.T).norm() / matrix.norm())
    # 496 pairs, each the square of a nearly normal number: relative error of the root sqrt(2 / 496) / 2
    assert check.symmetry == pytest.approx(expected, rel=4 * 0.5 * (2 / 496) ** 0.5)
    assert not check.passed


def test_noise_that_changes_from_matvec_to_matvec_is_measured():
    source = generator(2)

    def noisy(V):
        exact = A @ V
        return exact + 1e-4 * exact.norm(dim=0) / N**0.5 * torch.randn(V.shape, generator=source, dtype=V.dtype)

    check = check_operator(Any(noisy), generator())
    # the difference of two noisy products, of 60 entries each
    assert check.noise == pytest.approx(2**0.5 * 1e-4, rel=4 / (2 * N) ** 0.5)
    assert not check.passed


def test_the_check_costs_one_product_more_than_it_has_vectors():
    operator = CountingOperator(DenseOperator(A))
    assert check_operator(operator, generator(), vectors=3).matvecs == operator.matvecs == 4


def test_products_that_are_not_linear_fail():
    assert not check_operator(Any(lambda V: (A @ V) * V.norm(dim=0)), generator()).passed


def test_products_that_are_not_finite_fail_and_record_no_number():
    check = check_operator(Any(lambda V: A @ V / 0), generator())
    assert not check.finite and not check.passed
    assert check.record()["symmetry"] is None


def test_the_zero_operator_passes():
    assert check_operator(Any(lambda V: 0 * V), generator()).passed


def loss(x):
    return torch.cosh(x).sum() + (A @ x).square().sum() ** 2 / 100


def gradient(x):
    x = x.clone().requires_grad_()
    return torch.autograd.grad(loss(x), x)[0]


POINT = torch.randn(N, generator=generator(3), dtype=torch.float64) / 5
DIRECTION = torch.nn.functional.normalize(torch.randn(N, generator=generator(4), dtype=torch.float64), dim=0)
H = ObjectiveHessian(loss, POINT)


def test_the_true_hessian_agrees_with_differences_of_the_gradient():
    # at h = 1e-5: truncation of the order h^2 = 1e-10, round-off of eps / h = 2e-11, both times a constant of the loss
    assert check_gradient(H, gradient, POINT, DIRECTION).error < 1e-8


def test_the_true_hessian_agrees_with_second_differences_of_the_loss():
    # at h = 1e-3: truncation of the order h^2 = 1e-6, round-off of eps |L| / h^2 = 2e-8
    assert check_objective(H, loss, POINT, DIRECTION).error < 1e-5


def test_a_hessian_that_is_one_percent_too_long_is_seen():
    longer = ScaledOperator(H, torch.full((N,), 1.01**0.5, dtype=torch.float64))
    by_gradient = check_gradient(longer, gradient, POINT, DIRECTION, steps=(1e-5,))
    by_loss = check_objective(longer, loss, POINT, DIRECTION, steps=(1e-3,))
    assert by_gradient.error == pytest.approx(0.01 / 1.01, abs=1e-8)  # the bounds of the two tests above
    assert by_loss.error == pytest.approx(0.01 / 1.01, abs=1e-5)


def test_steps_to_another_smooth_piece_are_skipped():
    def smooth_piece(x):
        return bool((x - POINT) @ DIRECTION > 5e-4)

    check = check_gradient(H, gradient, POINT, DIRECTION, steps=(1e-2, 1e-3, 1e-4, 1e-5), smooth_piece=smooth_piece)
    assert check.skipped == 2 and check.steps == (1e-4, 1e-5) and check.error < 1e-8


def test_no_further_step_is_tried_once_one_is_good_enough():
    steps = (1e-2, 1e-3, 1e-5, 1e-6)
    every = check_gradient(H, gradient, POINT, DIRECTION, steps)
    first = check_gradient(H, gradient, POINT, DIRECTION, steps, enough=every.errors[1])
    assert first.steps == steps[:2] and first.error == every.errors[1] and first.skipped == every.skipped == 0


def test_where_every_step_is_skipped_there_is_no_number():
    check = check_gradient(H, gradient, POINT, DIRECTION, smooth_piece=lambda x: float(x.sum()))
    assert check.skipped == 5 and check.record()["error"] is None


def test_steps_must_be_positive():
    misused("positive steps", check_gradient, H, gradient, POINT, DIRECTION, steps=(0.1, 0.0))


def test_one_vector_cannot_show_symmetry():
    misused("at least 2 vectors", check_operator, H, generator(), vectors=1)


def test_a_step_where_the_loss_is_not_finite_proves_nothing():
    def walled(x):
        return loss(x) if float((x - POINT) @ DIRECTION) < 5e-3 else torch.tensor(torch.nan)

    def steep(x):
        return gradient(x) * (1.0 if float((x - POINT) @ DIRECTION) < 5e-3 else torch.nan)

    by_loss, by_gradient = check_objective(H, walled, POINT, DIRECTION), check_gradient(H, steep, POINT, DIRECTION)
    assert by_loss.error < 1e-5 and by_loss.errors[:2] == (inf, inf)
    assert by_gradient.error < 1e-8 and by_gradient.errors[0] == inf
    enough = check_gradient(H, steep, POINT, DIRECTION, enough=by_gradient.errors[2])
    assert enough.steps == (1e-2, 1e-3, 1e-4)
