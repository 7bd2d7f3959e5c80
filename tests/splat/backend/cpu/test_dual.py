"""Dual numbers against torch's derivatives."""

import numba
import numpy as np
import pytest
import torch

from splat.backend.cpu.dual import DIRECTIONS, dual, exp, sqrt, tangent_of, value_of, variable
from splat.backend.cpu.simd import store
from tests.splat.tolerances import DTYPES, NUMPY


def formula(x, y, root, power):
    """Every operator, with a number on either side."""
    a = (x + y) * (x - 2.0) / (1.5 + y * y) - 3.0 * x
    b = 1.0 / y + x / 2.0 - (4.0 - x) * y + (1.0 + x)
    a += x * y
    a -= y
    a *= b
    return -a + root(b * b + 1.0) * power(x / y - 1.0)


compiled = numba.njit(formula)


@numba.njit
def along(x, y, dx, dy):
    result = compiled(dual(x, dx), dual(y, dy), sqrt, exp)
    return value_of(result), tangent_of(result)


@numba.njit
def in_every_direction(x, y, like, out):
    result = compiled(variable(like, x, 2), variable(like, y, 5), sqrt, exp)
    store(out, 0, tangent_of(result))
    return value_of(result)


def exact(x: float, y: float) -> tuple[float, float, float]:
    """Value and both partial derivatives, by torch."""
    p, q = (torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (x, y))
    value = formula(p, q, torch.sqrt, torch.exp)
    slopes = torch.autograd.grad(value, (p, q))
    return float(value.detach()), float(slopes[0]), float(slopes[1])


POINTS = [(0.7, 1.3), (-1.2, 0.6), (2.0, -0.8)]


@pytest.mark.parametrize(("x", "y"), POINTS)
def test_a_dual_carries_the_directional_derivative(x, y):
    value, slope_x, slope_y = exact(x, y)
    assert along(x, y, 0.3, -2.0) == pytest.approx((value, 0.3 * slope_x - 2.0 * slope_y), rel=1e-13)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("x", "y"), POINTS)
def test_variables_carry_the_whole_gradient_in_the_precision_of_their_tangents(x, y, dtype):
    value, slope_x, slope_y = exact(x, y)
    out = np.full(DIRECTIONS, np.nan, NUMPY[dtype])
    assert in_every_direction(x, y, out, out) == pytest.approx(value, rel=1e-13)  # the value stays in double precision
    expected = np.zeros(DIRECTIONS)
    expected[2], expected[5] = slope_x, slope_y
    scale = 20 * float(np.finfo(NUMPY[dtype]).eps) * max(abs(slope_x), abs(slope_y))
    assert out == pytest.approx(expected, rel=0, abs=scale)


def test_plain_numbers_pass_through_the_same_functions():
    value = exact(0.7, 1.3)[0]
    assert numba.njit(lambda x, y: value_of(compiled(x, y, sqrt, exp)))(0.7, 1.3) == pytest.approx(value, rel=1e-13)
