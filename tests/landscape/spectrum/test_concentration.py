"""Counts of large eigenvalues from a density, against spectra that are known."""

import numpy as np
import pytest
import torch

from landscape import EigenSettings, extreme_eigenpairs, spectral_density
from landscape.eigen.lanczos import lanczos
from landscape.operators.operator import DenseOperator
from landscape.spectrum.concentration import excesses, half, top
from landscape.spectrum.rules import SpectralDensity

N = 200
PLACE = torch.arange(1, N + 1, dtype=torch.float64)
SPECTRA = {
    "steep": PLACE**-1.2,
    "even": PLACE**-0.7,
    "of both signs": PLACE**-1.0 * torch.where(PLACE % 5 == 0, -0.3, 1.0),
    "many at one node": torch.exp(-PLACE / 8) * torch.where(PLACE % 7 == 0, -0.1, 1.0),
    "near 0": torch.where(PLACE <= N // 4, 1 / PLACE, 1e-6 / PLACE),
    "a few over many": torch.where(PLACE <= 5, 100 / PLACE, 1 / PLACE.sqrt()),
}


def truth(values: torch.Tensor) -> tuple[float, float, float]:
    sizes = values.abs().sort(descending=True).values.numpy()
    mass = np.concatenate([[0.0], np.cumsum(sizes)])
    half = float(np.interp(mass[-1] / 2, mass, np.arange(N + 1)))
    return half, float(mass[10] / mass[-1]), float(mass[100] / mass[-1])


@pytest.mark.parametrize("name", SPECTRA)
def test_the_brackets_hold_as_often_as_they_say(name):
    values = SPECTRA[name]
    Q = torch.linalg.qr(torch.randn(N, N, generator=torch.Generator().manual_seed(5), dtype=torch.float64)).Q
    H, runs, held = DenseOperator((Q * values) @ Q.T), 20, np.zeros(3)
    for seed in range(runs):
        generator = torch.Generator().manual_seed(seed)
        ends = extreme_eigenpairs(H, generator, EigenSettings(2, 1, max_matvecs=60))
        density = spectral_density(H, generator, 72, ends=ends, trace=(float(values.sum()), 0.0))
        found = half(density), top(density, 10), top(density, 100)
        held += [each.low <= true <= each.high for each, true in zip(found, truth(values), strict=True)]
        assert all(each.value is not None and each.high <= 3 * each.value for each in found)  # they say something
    # four standard errors of a binomial count below its mean
    assert held.min() >= 0.95 * runs - 4 * (0.95 * 0.05 * runs) ** 0.5


@pytest.mark.parametrize("name", SPECTRA)
def test_each_start_vector_bounds_its_own_sums(name):
    """The bounds of F(t) hold for the measure that a start vector sees, at every t."""
    values, z = SPECTRA[name], torch.randn(N, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    z /= z.norm(dim=0)
    runs = [run.T for run in lanczos(DenseOperator(torch.diag(values)), z, 12)]
    rules = [torch.linalg.eigh(T) for T in runs]
    nodes, weights = torch.stack([x for x, _ in rules]), torch.stack([S[0].square() for _, S in rules])
    t, least, largest = excesses(SpectralDensity(nodes, weights, N, 24))
    true = N * (z.T.square() @ (values.abs()[:, None] - t).clamp(min=0))
    slack = 1e-12 * true[:, :1]
    assert (least <= true + slack).all() and (true <= largest + slack).all()
    assert ((largest - least) > 1e9 * slack).any()  # a rule by itself is one number of those between


def test_of_a_spectrum_that_is_known_whole_the_numbers_are_exact():
    known, none = torch.tensor([-1.0, 1.0, 4.0]).double(), torch.zeros(2, 0, dtype=torch.float64)
    density = SpectralDensity(none, none, 3, 6, known)
    assert (half(density).low, half(density).value, half(density).high) == (0.75, 0.75, 0.75)
    assert top(density, 1).value == top(density, 1).low == pytest.approx(2 / 3) and top(density, 100).value == 1.0


def test_of_an_operator_that_is_zero_nothing_is_said():
    zero = torch.zeros(2, 1, dtype=torch.float64)
    assert half(SpectralDensity(zero, zero + 1, 5, 2)).value is None
