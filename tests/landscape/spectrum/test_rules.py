"""Intervals of sums over a spectrum: their cover, what start vectors that see less make of them, numbers of any size."""

from dataclasses import replace

import pytest
import torch
from scipy.special import chdtriv

from landscape.results import standard_deviation, t_quantile
from landscape.spectrum.absolute_sum import absolute_sum
from landscape.spectrum.density import missed, spectral_density
from landscape.spectrum.rules import SpectralDensity
from tests.landscape.spectra import generator, operator

SEEDS, ROWS = 400, 120
_index = torch.arange(ROWS, dtype=torch.float64)
SPECTRA = {
    "1/i": 1 / (1 + _index),
    "1/i^1.5": (1 + _index) ** -1.5,
    "1/i^2": (1 + _index) ** -2,
    "exponential": torch.exp(-_index / 3),
    "four decades": torch.logspace(0, -4, ROWS, dtype=torch.float64),
    "five of 100": torch.where(_index < 5, 100.0, 1.0),
    "both signs": torch.where(_index % 3 > 0, 1.0, -0.3) / (1 + _index) ** 0.5,
    "flat": 1 + _index / ROWS,
}


def seen(values, starts, seed):
    """What start vectors of uniform direction see of these eigenvalues: the measures themselves (a weight of 0 says so)."""
    draws = torch.randn(starts, len(values), generator=generator(seed), dtype=torch.float64).square()
    weights = torch.nn.functional.pad(draws / draws.sum(dim=1, keepdim=True), (0, 1))
    nodes = torch.nn.functional.pad(values.expand(starts, -1), (0, 1))
    return SpectralDensity(nodes, weights, len(values), 0)


@pytest.mark.parametrize("starts", [3, 4, 8])
@pytest.mark.parametrize("name", SPECTRA)
def test_intervals_of_sums_cover_at_their_nominal_rate_and_are_no_longer_than_students(name, starts):
    values = SPECTRA[name]
    covered, widths, students = torch.zeros(2), torch.zeros(2), torch.zeros(2)
    for seed in range(SEEDS):
        density = seen(values, starts, seed)
        for i, function in enumerate((torch.abs, torch.square)):
            found = density.integral(function) if i else absolute_sum(density)
            samples = ROWS * (density.weights * function(density.nodes)).sum(dim=1)
            covered[i] += found.low <= float(function(values).sum()) <= found.high
            widths[i] += found.high - found.low
            students[i] += 2 * t_quantile(starts - 1, 0.95) * float(standard_deviation(samples)) / starts**0.5
    assert float(covered.min()) / SEEDS >= 0.95 - 2 * (0.95 * 0.05 / SEEDS) ** 0.5
    assert (widths < (1.0 if starts < 8 else 1.1) * students).all()


def test_of_one_multiple_eigenvalue_among_zeros_the_interval_is_that_of_chi_squared():
    """k m over the eigenvalue is chi-squared with k times its multiplicity degrees of freedom; at 96%."""
    values = torch.cat([torch.full((7,), 3.0), torch.zeros(10**4)]).double()
    density = seen(values, 6, 1)
    samples = density.dim * (density.weights * density.nodes).sum(dim=1)
    below, above = density.reach(density.nodes, samples, 0.95)
    mean, tail = float(samples.mean()), 0.8 * 0.05 / 2
    low, high = (3 / 6 * float(chdtriv(level, 6 * mean / 3)) for level in (1 - tail, tail))
    assert mean - below == pytest.approx(low, rel=5e-3) and mean + above == pytest.approx(high, rel=5e-3)


def test_where_start_vectors_see_the_same_the_interval_shrinks_with_what_they_differ_by():
    density = seen(SPECTRA["1/i"], 4, 0)
    samples = ROWS * (density.weights * density.nodes).sum(dim=1)
    mean = samples.mean()
    widths = [sum(density.reach(density.nodes, mean + share * (samples - mean), 0.95)) for share in (1, 0.1, 0.01, 0)]
    assert widths[1] < widths[0] and widths[2] == pytest.approx(widths[1] / 10, rel=1e-6) and widths[3] == 0


def test_an_independent_error_is_added_in_squares():
    density = seen(SPECTRA["1/i"], 4, 0)
    samples = ROWS * (density.weights * density.nodes).sum(dim=1)
    alone, both = (density.reach(density.nodes, samples, 0.95, other) for other in (0.0, 2.0))
    assert both == pytest.approx([(end**2 + 4) ** 0.5 for end in alone])


@pytest.mark.parametrize("size", [2.0**531, 2.0**-664])
def test_sums_of_any_size_have_the_intervals_of_their_size(size):
    density = seen(SPECTRA["both signs"], 4, 0)
    density = replace(density, trace=(8.0, 0.5))
    other = replace(density, nodes=size * density.nodes, trace=(8.0 * size, 0.5 * size))
    for kind in (absolute_sum, lambda found: found.integral(torch.abs)):
        one, scaled = kind(density), kind(other)
        ends = [value / size for value in (scaled.value, scaled.low, scaled.high)]
        assert ends == pytest.approx([one.value, one.low, one.high], rel=1e-12)


def test_sums_beyond_the_range_of_floats_are_refused():
    density = seen(2.0**531 * SPECTRA["1/i"], 4, 0)
    with pytest.raises(ValueError, match="within the range of floats"):
        density.integral(torch.square)


def residuals_of(density):
    """Residuals of the known eigenvalues, which `missed` was made of."""
    return density.known.abs() * torch.maximum(density.missed / 4, density.missed.sqrt() / 2)


def test_known_eigenvalues_may_miss_what_their_residuals_change():
    values = torch.tensor([-2.0, 1e-9, 1.0, 5.0], dtype=torch.float64)
    residuals = torch.tensor([0.1, 1e-7, 0.0, 1e-12], dtype=torch.float64)
    density = replace(seen(SPECTRA["flat"], 2, 0), known=values, missed=missed(values, residuals))
    assert torch.allclose(residuals_of(density), residuals, rtol=1e-12, atol=0)
    # of magnitudes, twice what a residual may change: 2 r^2 / |lambda|, where that is less than 2 r
    change = 2 * torch.minimum(2 * residuals**2 / values.abs(), 2 * residuals)
    assert density.of_known(torch.abs) == pytest.approx(float(change.sum()), rel=1e-6)


def test_known_eigenvalues_have_the_round_off_of_the_products_in_their_residuals():
    H = operator("both tails", torch.float32)
    density = spectral_density(H, generator(), 48, 4)
    truth = torch.linalg.eigvalsh(H.matrix.double())
    off = (density.known[:, None] - truth).abs().min(dim=1).values
    assert len(off) and (off <= residuals_of(density)).all() and float(residuals_of(density).max()) < 1e-5
