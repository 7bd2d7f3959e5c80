from itertools import pairwise

import numpy as np
import pytest
import torch

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.linalg import unit_columns
from landscape.operators.operator import DenseOperator, ProjectedOperator
from landscape.probes import draw_probes
from landscape.spectrum.absolute_sum import FAR, absolute_integral, absolute_sum, integrals_of_rules
from landscape.spectrum.density import SETTLED, ActiveSpace, draw_starts, spectral_density
from landscape.spectrum.rules import SpectralDensity
from tests.landscape.spectra import SPECTRA, N, eigenvalues, generator, operator
from tests.oracles import absolute_matrix
from tests.refusals import misused


@pytest.mark.parametrize("name", SPECTRA)
def test_moments_below_twice_the_steps_are_those_of_the_start_vectors(name):
    H, steps = operator(name), 6
    density = spectral_density(H, generator(), matvecs=3 * steps, starts=3, batch=1)
    Z = unit_columns(draw_starts(N, 3, generator(), torch.float64))
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
    density = spectral_density(H, generator(), matvecs=2 * N, starts=2, batch=1)
    Z = unit_columns(draw_starts(N, 2, generator(), torch.float64))
    values, vectors = torch.linalg.eigh(H.matrix)
    for level in (-0.151, 0.051, 0.51):
        exact = torch.where(values[:, None] < level, (vectors.T @ Z).square(), 0.0).sum(dim=0)
        by_rule = torch.where(density.nodes < level, density.weights, 0.0).sum(dim=1)
        assert torch.allclose(by_rule, exact, rtol=0, atol=1e-10)


@pytest.mark.parametrize("steps", [2, 3, 8, 15, 30])
@pytest.mark.parametrize("name", SPECTRA)
def test_the_sum_of_magnitudes_of_each_start_vector_lies_within_its_bounds(name, steps):
    H = operator(name)
    density = spectral_density(H, generator(), matvecs=4 * steps, starts=4, batch=1)
    Z = unit_columns(draw_starts(N, 4, generator(), torch.float64))
    exact = (Z * (torch.from_numpy(absolute_matrix(H.matrix.numpy())) @ Z)).sum(dim=0)
    # the bounds are square roots of quantities of the size of |H|^2: round-off of the root of eps
    rounding = float(H.matrix.norm()) / FAR  # what a node that is left out, so far away, may add
    for nodes, weights, truth in zip(density.nodes, density.weights, exact, strict=True):
        low, _, high = absolute_integral(nodes, weights)
        assert low - rounding <= truth <= high + rounding
        assert low <= high


def test_the_bounds_of_the_sum_of_magnitudes_are_reached_by_measures_of_the_same_moments():
    """Lemma: of mean mu and variance 1, E |x| is at least |mu| and at most sqrt(mu^2 + 1)."""
    for mu in (0.0, 0.3, -2.0, 40.0):
        nodes = torch.tensor([mu - 1, mu + 1], dtype=torch.float64)
        low, _, high = absolute_integral(nodes, torch.tensor([0.5, 0.5], dtype=torch.float64))
        assert low == pytest.approx(abs(mu), abs=1e-12) and high == pytest.approx((mu**2 + 1) ** 0.5, rel=1e-9)


def test_the_bounds_see_the_sign_of_the_mean_and_an_invariant_subspace_is_exact():
    nodes = torch.tensor([1.0, 2.0, 5.0, 0.0], dtype=torch.float64)
    weights = torch.tensor([0.2, 0.3, 0.5, 0.0], dtype=torch.float64)
    assert absolute_integral(nodes, weights) == pytest.approx((3.3, 3.3, 3.3))
    low, _, high = absolute_integral(nodes[:3], weights[:3])  # all that is known to be positive is the mean
    assert low == pytest.approx(3.3, rel=1e-12) and high > 3.3


@pytest.mark.parametrize("name", ["power law", "indefinite", "both tails", "rank-deficient"])
def test_what_start_vectors_find_in_common_are_the_simple_eigenvalues_at_the_ends(name):
    H = operator(name)
    true = eigenvalues(H)
    density = spectral_density(H, generator(), matvecs=120, starts=4)
    found = density.known
    assert len(found) > 0 and density.rest == N - len(found)
    # an eigenvalue misses by the square of the residual over the gap, SETTLED times the residual
    at = (found[:, None] - true).abs().argmin(dim=1)
    assert ((found - true[at]).abs() <= SETTLED**2 * float(true[-1] - true[0]) + 1e-13).all()
    assert len(at.unique()) == len(at) and set(at.tolist()) & {0, N - 1}


@pytest.mark.parametrize("name", ["multiple", "zero", "negative"])
def test_multiple_eigenvalues_and_dense_ends_are_not_taken_for_simple_ones(name):
    assert not len(spectral_density(operator(name), generator(), matvecs=80, starts=4).known)


def test_of_a_multiple_eigenvalue_among_simple_ones_the_simple_ones_are_known():
    values = torch.cat([torch.tensor([-4.0, 3.0, 5.0, 5.0, 7.0]), torch.linspace(0, 1, 95)]).double()
    Q = torch.linalg.qr(torch.randn(100, 100, generator=generator(), dtype=torch.float64)).Q
    for seed in range(10):
        density = spectral_density(DenseOperator((Q * values) @ Q.T), generator(seed), matvecs=50, starts=2)
        assert not torch.isclose(density.known, torch.tensor(5.0).double(), atol=0.01).any()
        for simple in (-4.0, 3.0, 7.0):
            assert float((density.known - simple).abs().min()) < 1e-6


@pytest.mark.parametrize(("shared", "starts"), [(torch.eye(2), 4), (torch.tensor([[0.8, 0.4], [0.4, 0.2]]), 2)])
def test_a_multiple_eigenvalue_that_few_rows_share_is_not_taken_for_a_simple_one(shared, starts):
    """On a diagonal, and twice the same block of rank 1: random signs alone see one direction of it again and again."""
    matrix = torch.diag(torch.linspace(0, 1, 100, dtype=torch.float64))
    for i in (0, 2) if shared[0, 1] else (0,):
        matrix[i : i + 2, i : i + 2] = 50 * shared.double()
    for seed in range(24):
        known = spectral_density(DenseOperator(matrix), generator(seed), 12 * starts, starts).known
        assert not torch.isclose(known, torch.tensor(50.0).double(), atol=0.1).any()


def test_what_a_start_vector_sees_of_all_that_is_not_known_is_no_error():
    """Known vectors take another share of each start vector; where all others are the same, that is all they differ by."""
    Q = torch.linalg.qr(torch.randn(60, 60, generator=generator(), dtype=torch.float64)).Q
    spectrum = torch.cat([torch.linspace(10, 20, 4), torch.tensor([1.0, -1.0]).repeat(28)]).double()
    H = DenseOperator((Q * spectrum) @ Q.T)
    ends = extreme_eigenpairs(H, generator(), EigenSettings(4, 0, rtol=1e-9))
    for seed in range(5):
        total = absolute_sum(spectral_density(H, generator(seed), 32, 4, batch=1, ends=ends))
        assert (total.low, total.value, total.high) == pytest.approx([float(spectrum.abs().sum())] * 3, rel=1e-9)


@pytest.mark.parametrize(("name", "times"), [("power law", 5.0), ("both tails", 2.0), ("rank-deficient", 1e9)])
def test_sums_lose_the_variance_of_what_is_known_and_gain_no_bias(name, times):
    H, runs = operator(name), 25
    true = float(eigenvalues(H).abs().sum())
    errors = torch.zeros(2, runs, dtype=torch.float64)
    for seed in range(runs):
        for i, batch in enumerate((1, 2)):
            found = spectral_density(H, generator(seed), matvecs=120, starts=4, batch=batch).integral(torch.abs).value
            assert found is not None
            errors[i, seed] = found / true - 1
    plain, known = errors.square().mean(dim=1).sqrt()
    assert known < plain / times + 1e-14  # half of the start vectors are the same
    # a bias is hidden by four standard errors, and by what quadrature has of it in either case
    assert abs(float(errors[1].mean())) < 4 * float(known) / runs**0.5 + abs(float(errors[0].mean())) + 1e-14


def test_where_all_is_known_the_sums_are_exact_and_no_product_is_spent_on_more():
    H = DenseOperator(torch.diag(torch.tensor([-1.0, 2.0, 5.0], dtype=torch.float64)))
    density = spectral_density(H, generator(), matvecs=60, starts=6, batch=2)
    assert density.matvecs == 2 * 3 and density.rest == 0
    total = absolute_sum(density)
    assert (total.low, total.value, total.high) == pytest.approx((8.0, 8.0, 8.0), abs=1e-12)
    nodes, weights = density.table()
    assert torch.allclose((weights * nodes).sum(dim=1), torch.full((6,), 2.0).double(), atol=1e-12)


def test_more_steps_narrow_the_bounds():
    widths = []
    for steps in (4, 8, 16, 32):
        density = spectral_density(operator("indefinite"), generator(), matvecs=2 * steps, starts=2)
        low, _, high = integrals_of_rules(density)
        widths.append(density.rest * float(high[0] - low[0]))
    assert all(narrow < 0.7 * wide for wide, narrow in pairwise(widths))


@pytest.mark.parametrize("name", ["indefinite", "both tails"])
def test_intervals_of_sums_cover_at_least_at_the_nominal_rate(name):
    H = operator(name)
    true = eigenvalues(H)
    runs, absolute, linear = 60, 0, 0
    for seed in range(runs):
        density = spectral_density(H, generator(seed), matvecs=48, starts=6, batch=6)
        total, trace = absolute_sum(density), density.integral(lambda x: x)
        absolute += total.low <= float(true.abs().sum()) <= total.high
        linear += trace.low <= float(true.sum()) <= trace.high
    floor = 0.95 - 4 * np.sqrt(0.95 * 0.05 / runs)
    assert absolute / runs >= floor and linear / runs >= floor


def test_the_matvecs_counted_are_those_that_were_needed():
    assert spectral_density(operator("indefinite"), generator(), matvecs=30, starts=3).matvecs == 30
    assert spectral_density(operator("zero"), generator(), matvecs=30, starts=3).matvecs == 3


def test_progress_ends_at_starts_times_steps():
    seen = []
    spectral_density(operator("indefinite"), generator(), 15, 3, batch=2, progress=lambda *at: seen.append(at[:2]))
    assert seen == sorted(seen) and seen[-1] == (15, 15)


def test_a_known_null_space_is_left_out_of_the_sums():
    rank = 40
    basis = torch.linalg.qr(draw_probes(N, rank, generator(7), torch.float64)).Q
    curvatures = torch.linspace(1, 2, rank, dtype=torch.float64)
    inner = DenseOperator(basis @ torch.diag(curvatures) @ basis.T + torch.eye(N) - basis @ basis.T)
    H = ProjectedOperator(inner, lambda V: basis @ (basis.T @ V))
    active, covered, runs = ActiveSpace(H.project, rank), 0, 40
    for seed in range(runs):
        density = spectral_density(H, generator(seed), matvecs=48, starts=4, active=active)
        assert density.dim == rank and float(density.nodes.min()) > 1 - 1e-9  # none of the 80 zeros
        total = absolute_sum(density)
        covered += total.low <= 60 <= total.high
    assert covered / runs >= 0.95 - 4 * np.sqrt(0.95 * 0.05 / runs)


def test_bad_settings_are_refused():
    misused("rank 1 or more", ActiveSpace, lambda V: V, 0)
    misused("starts >= 2", spectral_density, operator("zero"), generator(), starts=1)


@pytest.mark.parametrize("share", [0.1, 0.3, 1 / 3])
def test_equal_values_whose_weights_round_have_an_interval_of_round_off(share):
    weights = torch.tensor([[share, share, 1 - 2 * share], [share, 1 - share, 0.0]], dtype=torch.float64)
    found = SpectralDensity(torch.full((2, 3), 2.0).double(), weights, dim=98, matvecs=6).integral(torch.abs)
    assert found.low <= 196 <= found.high and found.high - found.low < 1e-10
