from math import sqrt

import numpy as np
import pytest
import torch
from scipy.stats import chi2, norm

from landscape.linalg import column_dots, gram
from landscape.probes import draw_probes
from landscape.traces.quadratic import PowerSums, mean_interval, power_sums
from tests.landscape.spectra import generator
from tests.oracles import symmetric_matrix

N = 30
EIGENVALUES = np.where(np.arange(N) % 3 > 0, 1.0, -0.5) / (1 + np.arange(N))
MATRIX = torch.from_numpy(symmetric_matrix(EIGENVALUES, seed=0))


@pytest.mark.parametrize("probes", [4, 9])
def test_power_sums_of_gaussian_probes_are_unbiased(probes):
    runs, rng = 2000, generator()
    draws = []
    for _ in range(runs):
        Z = draw_probes(N, probes, rng, torch.float64)
        sums = power_sums(Z, MATRIX @ Z, "gaussian")
        draws.append(sums.sums(1.0))
    draws = torch.tensor(draws, dtype=torch.float64)
    truth = torch.tensor([(EIGENVALUES**j).sum() for j in (2, 3, 4)])
    assert ((draws.mean(dim=0) - truth).abs() < 4 * draws.std(dim=0) / sqrt(runs)).all()
    # the variance of the estimate of p_2 is the stated one
    stated = sums.spread * float(truth[2]) + 2 / sums.pairs * float(truth[0]) ** 2
    squares = (draws[:, 0] - truth[0]).square()
    assert abs(float(squares.mean()) - stated) < 4 * float(squares.std()) / sqrt(runs)


def test_power_sums_of_random_signs_leave_the_diagonal_out():
    runs, probes, rng = 1000, 8, generator()
    hollow = MATRIX - torch.diag(MATRIX.diagonal())
    heavy = MATRIX + torch.diag(torch.linspace(5, 50, N, dtype=torch.float64))
    draws = []
    for _ in range(runs):
        Z = draw_probes(N, probes, rng, torch.float64, "rademacher")
        sums = power_sums(Z, heavy @ Z, "rademacher")
        draws.append(sums.sums(1.0)[0])
    draws = torch.tensor(draws, dtype=torch.float64)
    assert abs(float(draws.mean() - hollow.square().sum())) < 4 * float(draws.std()) / sqrt(runs)


def test_power_sums_are_invariant_to_rotations_and_antisymmetric_parts():
    Z = draw_probes(N, 6, generator(), torch.float64)
    skew = torch.randn(N, N, dtype=torch.float64, generator=generator(1))
    turn = torch.linalg.qr(torch.randn(6, 6, dtype=torch.float64, generator=generator(2))).Q
    plain = power_sums(Z, MATRIX @ Z, "gaussian")
    turned = power_sums(Z @ turn, MATRIX @ Z @ turn, "gaussian")
    skewed = power_sums(Z, (MATRIX + skew - skew.T) @ Z, "gaussian")
    for sums in (turned, skewed):
        assert sums.sums(1.0) == pytest.approx(plain.sums(1.0), rel=1e-10)


def test_one_eigenvalue_has_the_exact_interval_of_chi_squared():
    k = 8
    v = torch.randn(N, 1, dtype=torch.float64, generator=generator(3))
    Z = draw_probes(N, k, generator(), torch.float64)
    samples = column_dots(Z, v @ (v.T @ Z))
    mean = float(samples.mean())
    _, low, high = mean_interval(mean, k, [power_sums(Z, v @ (v.T @ Z), "gaussian")], 0.95)
    cube_roots = 1 - 2 / (9 * k) + norm.ppf([0.975, 0.025]) * sqrt(2 / (9 * k))
    assert (low, high) == pytest.approx(tuple(mean / cube_roots**3), rel=1e-5)  # Student's t of 2e6 degrees of freedom
    # Wilson and Hilferty's cube root is within 1.3% of these quantiles of chi^2_8
    assert (low, high) == pytest.approx((k * mean / chi2.ppf(0.975, k), k * mean / chi2.ppf(0.025, k)), rel=0.013)
    # and the mirror image for a negative one
    _, mirrored_low, mirrored_high = mean_interval(-mean, k, [power_sums(Z, -v @ (v.T @ Z), "gaussian")], 0.95)
    assert (-mirrored_high, -mirrored_low) == pytest.approx((low, high), rel=1e-9)


def test_many_eigenvalues_and_pairs_have_the_normal_interval():
    sums = PowerSums(second=2.0, third=0.0, fourth=0.0, pairs=1e7, spread=0.0)
    error, low, high = mean_interval(1.0, 100, [sums], 0.95)
    assert error == pytest.approx(sqrt(2 * 2 / 100))
    assert (low, high) == pytest.approx((1 - norm.ppf(0.975) * error, 1 + norm.ppf(0.975) * error), rel=1e-6)
    _, wider, _ = mean_interval(1.0, 100, [sums], 0.95, widening=2.0)
    assert 1 - wider == pytest.approx(2 * (1 - low))


def test_groups_count_by_their_pairs():
    one, other = (PowerSums(value, 0.0, 0.0, pairs, 0.0) for value, pairs in ((1.0, 30.0), (4.0, 10.0)))
    assert mean_interval(0.0, 10, [one, other], 0.95)[0] == pytest.approx(sqrt(2 * 1.75 / 10))


def test_gram_matrices_are_accumulated_in_double_precision():
    A = torch.full((200_001, 1), 0.1, dtype=torch.float32)
    value = float(A[0, 0].double()) ** 2
    round_off = 200_001 * torch.finfo(torch.float64).eps
    assert float(gram(A, A)) == pytest.approx(200_001 * value, rel=round_off)
    assert float(column_dots(A, A)) == pytest.approx(200_001 * value, rel=round_off)
