from itertools import pairwise

import numpy as np
import pytest
import torch

from landscape.density import FAR, absolute_bounds, absolute_sum, spectral_density
from landscape.probes import draw_probes
from tests.landscape.spectra import SPECTRA, N, eigenvalues, generator, operator
from tests.oracles import absolute_matrix


@pytest.mark.parametrize("name", SPECTRA)
def test_moments_below_twice_the_steps_are_those_of_the_start_vectors(name):
    H, steps = operator(name), 6
    density = spectral_density(H, generator(), starts=3, steps=steps, batch=2)
    Z = draw_probes(N, 3, generator(), torch.float64, "rademacher") / N**0.5
    scale = max(1.0, float(H.matrix.norm()))
    power = Z
    for degree in range(2 * steps):
        exact = (Z * power).sum(dim=0)
        by_rule = (density.weights * density.nodes**degree).sum(dim=1)
        assert torch.allclose(by_rule, exact, rtol=0, atol=1e-13 * scale**degree), degree
        power = H.matrix @ power


@pytest.mark.parametrize("name", SPECTRA)
def test_as_many_steps_as_rows_give_the_measure_itself(name):
    H = operator(name)
    density = spectral_density(H, generator(), starts=2, steps=N)
    Z = draw_probes(N, 2, generator(), torch.float64, "rademacher") / N**0.5
    values, vectors = torch.linalg.eigh(H.matrix)
    for level in (-0.151, 0.051, 0.51):
        exact = torch.where(values[:, None] < level, (vectors.T @ Z).square(), 0.0).sum(dim=0)
        by_rule = torch.where(density.nodes < level, density.weights, 0.0).sum(dim=1)
        assert torch.allclose(by_rule, exact, rtol=0, atol=1e-10)


@pytest.mark.parametrize("steps", [2, 3, 8, 15, 30])
@pytest.mark.parametrize("name", SPECTRA)
def test_the_sum_of_magnitudes_of_each_start_vector_lies_within_its_bounds(name, steps):
    H = operator(name)
    density = spectral_density(H, generator(), starts=4, steps=steps)
    Z = draw_probes(N, 4, generator(), torch.float64, "rademacher") / N**0.5
    exact = (Z * (torch.from_numpy(absolute_matrix(H.matrix.numpy())) @ Z)).sum(dim=0)
    # the bounds are square roots of quantities of the size of |H|^2: round-off of the root of eps
    rounding = float(H.matrix.norm()) / FAR  # what a node that is left out, so far away, may add
    for nodes, weights, truth in zip(density.nodes, density.weights, exact, strict=True):
        low, high = absolute_bounds(nodes, weights)
        assert low - rounding <= truth <= high + rounding
        assert low <= high


def test_the_bounds_of_the_sum_of_magnitudes_are_reached_by_measures_of_the_same_moments():
    """Lemma: of mean mu and variance 1, E |x| is at least |mu| and at most sqrt(mu^2 + 1)."""
    for mu in (0.0, 0.3, -2.0, 40.0):
        nodes = torch.tensor([mu - 1, mu + 1], dtype=torch.float64)
        low, high = absolute_bounds(nodes, torch.tensor([0.5, 0.5], dtype=torch.float64))
        assert low == pytest.approx(abs(mu), abs=1e-12) and high == pytest.approx((mu**2 + 1) ** 0.5, rel=1e-9)


def test_the_bounds_see_the_sign_of_the_mean_and_an_invariant_subspace_is_exact():
    nodes = torch.tensor([1.0, 2.0, 5.0, 0.0], dtype=torch.float64)
    weights = torch.tensor([0.2, 0.3, 0.5, 0.0], dtype=torch.float64)
    assert absolute_bounds(nodes, weights) == (pytest.approx(3.3), pytest.approx(3.3))
    low, high = absolute_bounds(nodes[:3], weights[:3])  # all that is known to be positive is the mean
    assert low == pytest.approx(3.3, rel=1e-12) and high > 3.3


def test_more_steps_narrow_the_bounds():
    widths = []
    for steps in (4, 8, 16, 32):
        density = spectral_density(operator("indefinite"), generator(), starts=2, steps=steps)
        low, high = absolute_bounds(density.nodes[0], density.weights[0])
        widths.append(high - low)
    assert all(narrow < 0.7 * wide for wide, narrow in pairwise(widths))


@pytest.mark.parametrize("name", ["indefinite", "both tails"])
def test_intervals_of_sums_cover_at_least_at_the_nominal_rate(name):
    H = operator(name)
    true = eigenvalues(H)
    runs, absolute, linear = 60, 0, 0
    for seed in range(runs):
        density = spectral_density(H, generator(seed), starts=6, steps=8, batch=6)
        total, trace = absolute_sum(density), density.integral(lambda x: x)
        absolute += total.low <= float(true.abs().sum()) <= total.high
        linear += trace.low <= float(true.sum()) <= trace.high
    floor = 0.95 - 4 * np.sqrt(0.95 * 0.05 / runs)
    assert absolute / runs >= floor and linear / runs >= floor


def test_the_smoothed_density_integrates_to_one_and_stands_where_the_spectrum_is():
    density = spectral_density(operator("multiple"), generator())
    grid = torch.linspace(-4, 5, 2001, dtype=torch.float64)
    curve = density.smoothed(grid, 0.1).mean(dim=0)
    assert float(torch.trapezoid(curve, grid)) == pytest.approx(1.0, abs=1e-6)
    assert float(grid[curve.argmax()]) == pytest.approx(-1.0, abs=0.01)


def test_the_matvecs_counted_are_those_that_were_needed():
    assert spectral_density(operator("indefinite"), generator(), starts=3, steps=10).matvecs == 30
    assert spectral_density(operator("zero"), generator(), starts=3, steps=10).matvecs == 3


def test_progress_ends_at_starts_times_steps():
    seen = []
    spectral_density(operator("indefinite"), generator(), 3, 5, 2, progress=lambda *state: seen.append(state[:2]))
    assert seen == sorted(seen) and seen[-1] == (15, 15)


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="starts >= 2"):
        spectral_density(operator("zero"), generator(), starts=1)
