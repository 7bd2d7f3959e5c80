from functools import cache
from math import sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from landscape.operators.operator import CountingOperator, DenseOperator
from landscape.traces.choice import chosen
from landscape.traces.hutchinson import TraceSettings
from landscape.traces.sketched import _leave_out, hutch_plus_plus, xtrace
from landscape.traces.trace import estimate_traces
from tests.landscape.spectra import Broken, generator
from tests.oracles import symmetric_matrix

N = 120
METHODS = ["hutch++", "xtrace"]
POWER = torch.from_numpy(symmetric_matrix(1 / np.arange(1.0, N + 1) ** 2, seed=0))
INDEFINITE = torch.from_numpy(symmetric_matrix(np.linspace(-0.5, 1, N) ** 3, seed=1))
ROUND_OFF = N * torch.finfo(torch.float64).eps


MATRICES = {"power law": POWER, "indefinite": INDEFINITE}


def runs(matrix, settings, seeds):
    operator = DenseOperator(matrix)
    return [estimate_traces(operator, generator(seed), settings)["all"] for seed in range(seeds)]


@cache
def many_runs(method, name, matvecs=40, seeds=250):
    """The same runs for all tests of averages over seeds."""
    return runs(MATRICES[name], TraceSettings.fixed(matvecs, method=method), seeds)


class Placed:
    """Says where the vectors lie that it is given."""

    dim, blocks, dtype = 5, {"all": slice(0, 5)}, torch.float32

    def apply(self, V):
        raise RuntimeError(f"on {V.device}")


@pytest.mark.parametrize("estimator", [chosen, hutch_plus_plus, xtrace])
def test_the_identity_lies_where_the_generator_draws(estimator):
    there: Any = SimpleNamespace(device=torch.device("meta"))
    with pytest.raises(RuntimeError, match="on meta"):
        estimator(Placed(), there, TraceSettings())


def root_mean_square(estimates, truth):
    return sqrt(sum((e.value - truth) ** 2 for e in estimates) / len(estimates))


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("method", METHODS)
def test_the_mean_over_seeds_is_the_trace(method, name):
    values = torch.tensor([e.value for e in many_runs(method, name)])
    assert abs(float(values.mean() - MATRICES[name].trace())) < 4 * float(values.std()) / sqrt(len(values))


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("method", METHODS)
def test_intervals_cover_at_least_at_the_nominal_rate(method, name):
    truth, estimates = float(MATRICES[name].trace()), many_runs(method, name)
    seeds = len(estimates)
    covered = sum(e.low <= truth <= e.high for e in estimates) / seeds
    assert covered > 0.95 - 4 * sqrt(0.95 * 0.05 / seeds)
    # and the stated error is no larger than twice the true one
    assert sum(e.standard_error for e in estimates) / seeds < 2 * root_mean_square(estimates, truth)


@pytest.mark.parametrize("method", METHODS)
def test_on_a_power_law_the_error_falls_faster_than_one_over_matvecs(method):
    truth = float(POWER.trace())
    few, many = (root_mean_square(many_runs(method, "power law", m, 100), truth) for m in (24, 96))
    assert many < few / 4 / 1.5  # 1.5: an error estimated from 100 runs is within a third of the true one, 4 sigma
    plain = root_mean_square(many_runs("hutchinson", "power law", 96, 100), truth)
    assert many < plain / 10


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("rank", [0, 1, 7])
def test_a_matrix_of_low_rank_is_exact(method, rank):
    values = np.where(np.arange(N) < rank, 1.0 - 0.3 * np.arange(N), 0.0)  # of both signs
    matrix = torch.from_numpy(symmetric_matrix(values, seed=2))
    (estimate,) = runs(matrix, TraceSettings.fixed(24, method=method), 1)
    bound = ROUND_OFF * float(np.abs(values).sum())
    assert abs(estimate.value - float(matrix.trace())) <= bound
    # what the sketch adds in round-off alone is not multiplied
    assert estimate.half_width <= 2 * bound and estimate.matvecs == (24 if method == "hutch++" else 12 + rank)


@pytest.mark.parametrize("method", METHODS)
def test_low_rank_on_coordinate_axes_is_exact(method):
    matrix = torch.diag(torch.where(torch.arange(N) < 3, 2.0, 0.0)).double()
    (estimate,) = runs(matrix, TraceSettings.fixed(30, method=method), 1)
    assert estimate.value == pytest.approx(6.0, abs=6 * ROUND_OFF)


@pytest.mark.parametrize("method", METHODS)
def test_blocks_are_sketched_one_by_one_and_the_matvecs_counted(method):
    blocks = {"a": slice(0, 70), "b": slice(70, 72), "c": slice(72, N)}
    operator = CountingOperator(DenseOperator(INDEFINITE, blocks))
    estimates = estimate_traces(operator, generator(), TraceSettings.fixed(30, method=method))
    for name, rows in blocks.items():
        estimate, truth = estimates[name], float(INDEFINITE[rows, rows].trace())
        assert abs(estimate.value - truth) <= 4 * estimate.standard_error + ROUND_OFF, name
    assert {name: e.method for name, e in estimates.items()} == {"a": method, "b": "exact", "c": method}
    assert estimates["b"].matvecs == 2  # a block smaller than its budget is multiplied out
    assert operator.matvecs == sum(e.matvecs for e in estimates.values()) == 62


@pytest.mark.parametrize("method", METHODS)
def test_an_adaptive_run_stops_at_its_tolerance(method):
    # two thirds of 120 eigenvalues 1/i^2 beyond the sketch: a few percent are reached well before the budget
    settings = TraceSettings(rtol=0.05, min_probes=16, max_probes=96, method=method)
    for estimate in runs(POWER, settings, 5):
        assert estimate.reason == "tolerance" and estimate.matvecs < 96
        assert estimate.half_width <= 0.05 * estimate.value


def test_xtrace_stops_only_if_the_error_was_small_one_test_vector_before():
    def run(seed: int, most: int):
        settings = TraceSettings(rtol=0.1, method="xtrace", max_probes=most)
        return estimate_traces(DenseOperator(POWER), generator(seed), settings)["all"]

    for seed in range(20):
        estimate = run(seed, 100)
        before = run(seed, 2 * (estimate.probes - 1))
        assert estimate.reason == before.reason == "tolerance" and before.probes == estimate.probes - 1


@pytest.mark.parametrize("method", METHODS)
def test_single_precision_products_give_the_trace_to_single_precision(method):
    values = np.where(np.arange(N) < 5, 1.0, 0.0)
    matrix = torch.from_numpy(symmetric_matrix(values, seed=2)).float()
    (estimate,) = runs(matrix, TraceSettings.fixed(24, method=method), 1)
    assert abs(estimate.value - 5) < 5 * N * torch.finfo(torch.float32).eps


@pytest.mark.parametrize("spherical", [True, False])
def test_xtrace_without_a_vector_equals_xtrace_of_the_others(spherical):
    Omega = torch.randn(N, 6, dtype=torch.float64, generator=generator())
    Y = INDEFINITE @ Omega
    Q = torch.linalg.qr(Y).Q
    t, without = _leave_out(Omega, Y, Q, INDEFINITE @ Q, spherical)
    for i in range(6):
        others = [j for j in range(6) if j != i]
        smaller = torch.linalg.qr(Y[:, others]).Q
        expected = _leave_out(Omega[:, others], Y[:, others], smaller, INDEFINITE @ smaller, spherical)[0]
        assert torch.allclose(without[i, others], expected, rtol=0, atol=1e-10)
        # and t_i itself by its definition
        u = Omega[:, i] - smaller @ (smaller.T @ Omega[:, i])
        length = (N - 5) / (u @ u) if spherical else 1.0
        direct = (smaller.T @ INDEFINITE @ smaller).trace() + length * (u @ INDEFINITE @ u)
        assert float(t[i]) == pytest.approx(float(direct), abs=1e-10)


def test_the_error_of_xtrace_counts_that_the_test_vectors_share_a_sketch():
    """Its square is the mean squared error, which the published one is half of."""
    estimates = many_runs("xtrace", "power law")
    seeds = len(estimates)
    squares = torch.tensor([(e.value - float(POWER.trace())) ** 2 for e in estimates]).double()
    ours = torch.tensor([e.standard_error**2 for e in estimates]).double()
    published = torch.tensor([float(e.samples.var()) / len(e.samples) for e in estimates]).double()
    # four standard errors of a mean of squares
    room = 4 * float(squares.std()) / sqrt(seeds)
    assert abs(float(ours.mean() - squares.mean())) < room < float(squares.mean() - published.mean())


@pytest.mark.parametrize("method", METHODS)
def test_products_that_are_not_finite_are_an_error_that_names_the_block(method):
    with pytest.raises(ValueError, match=r"expected finite products H V.*in all"):
        estimate_traces(Broken(INDEFINITE), generator(), TraceSettings.fixed(30, method=method))
