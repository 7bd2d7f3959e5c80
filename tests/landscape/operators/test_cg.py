"""Conjugate gradients: the dense solution, the model's fall, and what happens at negative curvature."""

import pytest
import torch
from torch import Tensor

from landscape.operators.cg import conjugate_gradients
from landscape.operators.operator import CountingOperator, DenseOperator
from tests.oracles import symmetric_matrix

B = torch.linspace(-1.0, 2.0, 12, dtype=torch.float64)


def matrix(low: float, high: float) -> Tensor:
    return torch.from_numpy(symmetric_matrix(torch.linspace(low, high, 12).double().numpy(), 0))


def plain(r: Tensor) -> Tensor:
    return r


@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_the_solution_is_the_dense_one_and_products_are_counted(damping):
    whole = matrix(0.1, 5.0)
    A = CountingOperator(DenseOperator(whole))
    found = conjugate_gradients(A, B, plain, damping, rtol=1e-13, most=40)
    dense = torch.linalg.solve(whole + damping * torch.eye(12).double(), B)
    assert (found.x - dense).norm() < 1e-11 * dense.norm()
    assert found.reason == "tolerance" and found.products == A.matvecs <= 16
    assert torch.allclose(found.Ax, B, rtol=0, atol=1e-10)


def test_the_exact_inverse_as_preconditioner_needs_one_product():
    A = matrix(0.1, 5.0)
    found = conjugate_gradients(DenseOperator(A), B, lambda r: torch.linalg.solve(A, r), rtol=1e-10)
    assert found.products == 1 and (A @ found.x - B).norm() < 1e-12


def test_the_model_falls_with_every_product_and_the_residual_is_said():
    A, falls = matrix(0.1, 5.0), [0.0]
    for most in range(1, 8):
        found = conjugate_gradients(DenseOperator(A), B, plain, rtol=0.0, most=most)
        assert found.products == most and found.reason == "budget"
        assert found.residual == pytest.approx(float((B - A @ found.x).norm() / B.norm()), rel=1e-9)
        falls.append(float(B @ found.x - found.x @ A @ found.x / 2))
    assert falls == sorted(falls) and falls[1] > 0


def test_at_negative_curvature_the_search_ends_with_a_step_downhill():
    late = conjugate_gradients(DenseOperator(matrix(-0.2, 5.0)), B, plain, rtol=1e-12, most=40)
    assert late.reason == "negative curvature" and late.products > 1 and late.x @ B > 0
    first = conjugate_gradients(DenseOperator(-matrix(0.1, 5.0)), B, lambda r: 2 * r)
    assert first.reason == "negative curvature" and first.products == 1
    assert torch.equal(first.x, 2 * B) and torch.allclose(first.Ax, -matrix(0.1, 5.0) @ first.x)
