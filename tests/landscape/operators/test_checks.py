import numpy as np
import pytest
import torch

from landscape.operators.checks import check_operator
from landscape.operators.operator import CountingOperator, DenseOperator
from tests.landscape.spectra import generator
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


def test_products_that_are_not_finite_fail():
    check = check_operator(Any(lambda V: A @ V / 0), generator())
    assert not check.finite and not check.passed


def test_the_zero_operator_passes():
    assert check_operator(Any(lambda V: 0 * V), generator()).passed


def test_one_vector_cannot_show_symmetry():
    misused("at least 2 vectors", check_operator, DenseOperator(A), generator(), vectors=1)
