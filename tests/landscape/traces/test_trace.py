from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
import torch

from landscape.operators.operator import CountingOperator, DenseOperator
from landscape.traces.trace import PAPER, TraceSettings, estimate_traces
from tests.landscape.spectra import Broken, Buffered, generator
from tests.oracles import symmetric_matrix
from tests.refusals import misused, refused

N = 40
BLOCKS = {"a": slice(0, 12), "b": slice(12, 13), "c": slice(13, N)}
INDEFINITE = torch.from_numpy(symmetric_matrix(np.linspace(-0.5, 1, N), seed=0))
POSITIVE = torch.from_numpy(symmetric_matrix(np.linspace(0.2, 1, N), seed=1))
READINGS = ["block", "full"]
DISTRIBUTIONS = ["rademacher", "gaussian"]


def exact(matrix):
    return {name: float(matrix[rows, rows].trace()) for name, rows in BLOCKS.items()}


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_every_block_is_within_four_standard_errors(distribution, reading):
    settings = TraceSettings.fixed(400, distribution, reading)
    for name, estimate in estimate_traces(DenseOperator(INDEFINITE, BLOCKS), generator(), settings).items():
        assert abs(estimate.value - exact(INDEFINITE)[name]) <= 4 * estimate.standard_error + 1e-12, name


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_the_variance_is_the_one_of_theory(distribution, reading):
    probes, rows = 4000, BLOCKS["a"]
    block = INDEFINITE[rows, rows]
    variance = 2 * block.square().sum()
    if distribution == "rademacher":
        variance -= 2 * block.diag().square().sum()
    if reading == "full":
        variance += INDEFINITE[rows].square().sum() - block.square().sum()
    settings = TraceSettings.fixed(probes, distribution, reading)
    samples = estimate_traces(DenseOperator(INDEFINITE, BLOCKS), generator(), settings, ["a"])["a"].samples
    # relative error of a sample variance: sqrt((kurtosis - 1) / probes)
    deviation = samples - samples.mean()
    kurtosis = float(deviation.pow(4).mean() / deviation.square().mean() ** 2)
    assert float(samples.var()) == pytest.approx(float(variance), rel=4 * sqrt((kurtosis - 1) / probes))


def test_an_adaptive_run_reaches_its_tolerance_and_says_so():
    settings = TraceSettings(rtol=0.03, max_probes=5000, method="hutchinson")
    estimates = estimate_traces(DenseOperator(POSITIVE, BLOCKS), generator(), settings)
    for estimate in estimates.values():
        assert estimate.reason == "tolerance"
        assert estimate.half_width <= 0.03 * abs(estimate.value)
        assert estimate.probes >= 12


def test_a_budget_that_is_too_small_is_said():
    estimate = estimate_traces(DenseOperator(INDEFINITE), generator(), TraceSettings(rtol=1e-6, max_probes=20))["all"]
    assert estimate.reason == "matvec budget" and estimate.probes == estimate.matvecs == 20


def test_an_absolute_tolerance_ends_a_trace_near_zero_without_a_sign():
    balanced = DenseOperator(INDEFINITE - INDEFINITE.trace() / N * torch.eye(N))
    estimate = estimate_traces(balanced, generator(), TraceSettings(rtol=0.01, atol=2.0, max_probes=5000))["all"]
    assert estimate.reason == "tolerance" and estimate.half_width <= 2.0
    assert estimate.sign == "undetermined"


def test_signs_are_told_where_the_interval_decides_them():
    signs = {}
    for name, factor in {"positive": 1.0, "negative": -1.0, "zero": 0.0}.items():
        signs[name] = estimate_traces(DenseOperator(factor * POSITIVE), generator())["all"].sign
    assert signs == {name: name for name in signs}


def test_the_papers_estimator_is_ten_gaussian_probes_for_each_block():
    operator = CountingOperator(DenseOperator(INDEFINITE, BLOCKS))
    estimates = estimate_traces(operator, generator(), PAPER)
    assert operator.matvecs == 10 * len(BLOCKS)
    assert {(e.probes, e.matvecs, e.dim) for e in estimates.values()} == {(10, 10, 12), (10, 10, 1), (10, 10, 27)}
    single = estimates["b"].samples / INDEFINITE[12, 12]  # z^2 of one normal number each
    assert (single >= 0).all() and len(single.unique()) == 10


def test_the_full_reading_shares_its_matvecs_among_the_blocks():
    operator = CountingOperator(DenseOperator(INDEFINITE, BLOCKS))
    estimate_traces(operator, generator(), TraceSettings.fixed(10, reading="full"))
    assert operator.matvecs == 10


def test_rademacher_is_exact_on_a_diagonal():
    diagonal = torch.linspace(-1, 2, N, dtype=torch.float64)
    estimates = estimate_traces(DenseOperator(torch.diag(diagonal), BLOCKS), generator())
    for name, rows in BLOCKS.items():
        assert estimates[name].value == pytest.approx(float(diagonal[rows].sum()), abs=1e-13)
        assert estimates[name].standard_error < 1e-14


@pytest.mark.parametrize("reading", READINGS)
def test_the_same_seed_gives_the_same_samples_in_batches_of_any_size(reading):
    operator = DenseOperator(INDEFINITE, BLOCKS)
    runs = [
        estimate_traces(operator, generator(5), TraceSettings(reading=reading, rtol=0.2, batch=batch))
        for batch in (1, 3, 3)
    ]
    for name in BLOCKS:
        assert torch.equal(runs[1][name].samples, runs[2][name].samples)
        assert torch.allclose(runs[0][name].samples, runs[1][name].samples, rtol=0, atol=1e-13)


def test_a_blocks_samples_do_not_depend_on_how_many_another_one_needed():
    few, many = (
        estimate_traces(DenseOperator(INDEFINITE, BLOCKS), generator(), TraceSettings.fixed(probes))
        for probes in (8, 13)
    )
    assert torch.allclose(few["c"].samples, many["c"].samples[:8], rtol=0, atol=1e-13)


def test_an_empty_block_has_an_exact_zero_trace():
    operator = CountingOperator(DenseOperator(INDEFINITE, {"none": slice(0, 0), "all": slice(0, N)}))
    estimate = estimate_traces(operator, generator(), blocks=["none"])["none"]
    assert (estimate.value, estimate.standard_error, estimate.reason, operator.matvecs) == (0.0, 0.0, "exact", 0)


@pytest.mark.parametrize("reading", READINGS)
def test_progress_never_falls_and_ends_at_the_budget(reading):
    seen = []
    settings = TraceSettings.fixed(10, reading=reading)
    estimate_traces(
        DenseOperator(INDEFINITE, BLOCKS),
        generator(),
        settings,
        progress=lambda done, total, note: seen.append((done, total)),
    )
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1][0] == seen[-1][1] == (10 if reading == "full" else 30)


def test_products_that_are_not_finite_are_an_error_that_names_the_block():
    misused(r"expected finite products H V.*in a", estimate_traces, Broken(INDEFINITE, BLOCKS), generator())


def test_bad_settings_are_refused():
    misused("min_probes <= max_probes", TraceSettings, min_probes=10, max_probes=5)
    refused("'rademacher' or 'gaussian'", TraceSettings, distribution="uniform")
    refused("'block' or 'full'", TraceSettings, reading="half")
    misused("rtol, atol >= 0", TraceSettings, rtol=-1)
    misused("expected 8 <= min_probes", TraceSettings.fixed, 7)
    misused(r"max_probes >= 24 with the method 'hutch[+][+]'", TraceSettings.fixed, 23, method="hutch++")
    refused(r"'auto', 'hutchinson', 'hutch[+][+]' or 'xtrace', got 'exact'", TraceSettings, method="exact")
    misused("reading 'block' with the method 'xtrace'", TraceSettings, method="xtrace", reading="full")
    misused("memory > 0", TraceSettings, memory=0.0)
    with pytest.raises(ValueError, match="blocks out of a, b, c, got 'd'"):
        estimate_traces(DenseOperator(INDEFINITE, BLOCKS), generator(), blocks=["d"])


@pytest.mark.parametrize("method", ["auto", "hutchinson", "hutch++", "xtrace"])
def test_an_operator_may_give_the_same_memory_at_every_call(method):
    matrix = torch.from_numpy(symmetric_matrix(1 / np.arange(1, 121.0) ** 1.5, seed=1))
    plain, buffered = (
        estimate_traces(H, torch.Generator().manual_seed(0), TraceSettings.fixed(40, method=method))["all"]
        for H in (DenseOperator(matrix), Buffered(matrix))
    )
    assert torch.allclose(plain.samples, buffered.samples, rtol=1e-9)
    assert (plain.low, plain.high) == pytest.approx((buffered.low, buffered.high), rel=1e-9)
    assert plain.method == buffered.method == ("xtrace" if method == "auto" else method)


@pytest.mark.parametrize("wrong", ["rtol", "atol", "memory"])
def test_a_setting_that_is_no_number_is_refused(wrong):
    misused(r"got .*nan", replace, TraceSettings(), **{wrong: float("nan")})


@pytest.mark.parametrize("method", ["hutchinson", "hutch++", "xtrace", "auto"])
@pytest.mark.parametrize("power", [-664, -300, 250, 664])
def test_intervals_scale_with_the_operator(power, method):
    """Powers of two, which round nothing off: squares and fourth powers leave the range of float64 at 1e+-154 and 1e+-77."""
    matrix = torch.from_numpy(symmetric_matrix(1 / np.arange(1, 121.0) ** 1.5, seed=1))
    settings = TraceSettings.fixed(40, method=method)
    plain, scaled = (estimate_traces(DenseOperator(2.0**e * matrix), generator(), settings)["all"] for e in (0, power))
    expected = [2.0**power * x for x in (plain.value, plain.low, plain.high, plain.standard_error)]
    assert [scaled.value, scaled.low, scaled.high, scaled.standard_error] == pytest.approx(expected, rel=1e-9, abs=0)
    assert scaled.method == plain.method
