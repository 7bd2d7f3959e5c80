"""Whitened coordinates: splats are round in them, and what is carried there and back is what it was."""

from typing import Any

import numpy as np
import pytest

from splat.backend.cpu.jit import kernel
from splat.projection import whitening as formulas
from splat.projection.whitening import LOG2_E

_formulas: list[Any] = [
    formulas.plain,
    formulas.plain_adjoint,
    formulas.whitened,
    formulas.whitened_adjoint,
    formulas.whitening,
]
plain, plain_adjoint, whitened, whitened_adjoint, whitening = [kernel(each.py_func) for each in _formulas]
EPS = np.finfo(np.float64).eps
ANGLES = np.linspace(0.05, 3.05, 7)
AXES = [(1.0, 1.0), (0.7, 30.0), (0.55, 500.0)]  # px
each_splat = pytest.mark.parametrize("axes", AXES, ids=str)


def conic_of(axes: tuple[float, float], angle: float) -> np.ndarray:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ np.diag(np.array(axes) ** -2.0) @ turn.T


def splat_of(axes: tuple[float, float], angle: float) -> np.ndarray:
    Q = conic_of(axes, angle)
    return np.array([10.0, 20.0, Q[0, 0], Q[0, 1], Q[1, 1], 0.5, 0.1, 0.2, 0.3])


def matrix(function, W) -> np.ndarray:
    """The linear map of five numbers."""
    return np.array([function(W, column) for column in np.eye(5)]).T


@each_splat
@pytest.mark.parametrize("angle", ANGLES)
def test_the_whitening_is_a_square_root_of_the_conic(axes, angle):
    along, across, shear = whitening(splat_of(axes, angle))
    W, Q = np.array([[along, 0.0], [across * shear, across]]), LOG2_E / 2 * conic_of(axes, angle)
    assert np.abs(W.T @ W - Q).max() < 8 * EPS * Q.max()
    # a - b^2 / c loses the squared ratio of the axes, and W with it
    root = np.linalg.inv(W)
    assert np.abs(root.T @ Q @ root - np.eye(2)).max() < 8 * EPS * (axes[1] / axes[0]) ** 2


@each_splat
@pytest.mark.parametrize("angle", ANGLES)
def test_a_whitened_tangent_is_that_of_the_exponent(axes, angle):
    splat, tangent = splat_of(axes, angle), np.random.default_rng(0).normal(size=5)
    along, across, shear = whitening(splat)
    u, v, uu, uv, vv = whitened((along, across, shear), tangent)
    for dx, dy in ((3.0, -2.0), (0.4, 7.0)):
        x, y = along * dx, across * (shear * dx + dy)
        a, b, c = tangent[2:]
        terms = np.array([a * dx * dx, 2 * b * dx * dy, c * dy * dy])
        assert (
            abs(uu * x * x + 2 * uv * x * y + vv * y * y - terms.sum())
            < 64 * EPS * (1 + shear**2) * np.abs(terms).sum()
        )
    # a move of the mean is an offset
    np.testing.assert_allclose([u, v], [along * tangent[0], across * (shear * tangent[0] + tangent[1])], rtol=8 * EPS)


@each_splat
@pytest.mark.parametrize("angle", ANGLES)
def test_plain_undoes_whitened_and_adjoints_are_the_transposes(axes, angle):
    W = whitening(splat_of(axes, angle))
    there, back = matrix(whitened, W), matrix(plain, W)
    size = np.abs(there) @ np.abs(back)
    assert (np.abs(there @ back - np.eye(5)) <= 16 * EPS * size).all()
    np.testing.assert_allclose(matrix(plain_adjoint, W), there.T, rtol=16 * EPS)
    np.testing.assert_allclose(matrix(whitened_adjoint, W), back.T, rtol=16 * EPS)


def test_a_splat_that_is_not_drawn_and_a_needle_beyond_double_precision_have_finite_whitenings():
    assert whitening(np.zeros(9)) == (1.0, 1.0, 0.0)
    endless = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.5, 0.0, 0.0, 0.0])  # a - b^2 / c = 0
    along, across, shear = whitening(endless)
    assert 0 < along < 1e-7 and across == np.sqrt(LOG2_E / 2) and shear == 1.0
