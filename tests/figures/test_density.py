from types import SimpleNamespace

import numpy as np
import pytest

from figures import density
from tests.figures.test_figures import require_layout
from tests.recorded import synthetic


def test_a_density_stays_inside_its_column():
    require_layout(density.draw_density(SimpleNamespace(**synthetic()[1]["spectrum"])))  # pyright: ignore[reportArgumentType]


def test_the_smooth_density_has_the_moments_of_the_quadrature():
    random = np.random.default_rng(0)
    nodes, weights = random.standard_normal((3, 20)), random.dirichlet(np.ones(20), 3)
    curvature, height, sigma = density.smooth_density(nodes, weights)
    step = curvature[1] - curvature[0]
    assert np.sum(height) * step == pytest.approx(1, abs=1e-6)
    assert np.sum(height * curvature) * step == pytest.approx(np.sum(nodes * weights) / 3, abs=1e-6)
    assert np.sum(height * curvature**2) * step == pytest.approx(np.sum(nodes**2 * weights) / 3 + sigma**2, abs=1e-6)


def test_equal_eigenvalues_have_a_density():
    curvature, height, sigma = density.smooth_density(np.full((1, 3), 2.0), np.full((1, 3), 1 / 3))
    assert curvature[height.argmax()] == pytest.approx(2, abs=sigma)
