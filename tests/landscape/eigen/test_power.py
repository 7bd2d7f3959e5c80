from dataclasses import replace

import pytest
import torch

from landscape.eigen.lanczos import lanczos
from landscape.eigen.power import PowerSettings, power_ends, power_iteration, power_of_runs
from landscape.operators.operator import CountingOperator, DenseOperator
from tests.landscape.spectra import Broken, N, eigenvalues, generator, operator
from tests.refusals import misused


@pytest.mark.parametrize("name", ["power law", "both tails", "clustered", "negative", "multiple"])
def test_power_iteration_finds_the_eigenvalue_of_largest_magnitude(name):
    H = operator(name)
    true = eigenvalues(H)
    dominant = float(true[true.abs().argmax()])
    pair, steps = power_iteration(H, generator(), PowerSettings(rtol=1e-4, max_matvecs=3000))
    assert pair.reason == "tolerance" and steps <= 3000
    assert abs(float(pair.values) - dominant) <= float(pair.residuals) <= 1e-4 * abs(dominant)
    assert float((H.matrix @ pair.vectors - pair.values * pair.vectors).norm()) == pytest.approx(float(pair.residuals))


def test_shifted_power_iteration_finds_the_end_opposite_to_the_shift():
    H = operator("both tails")
    true = eigenvalues(H)
    pair, _ = power_iteration(H, generator(), PowerSettings(rtol=1e-3, max_matvecs=3000), shift=float(true[-1]))
    assert float(pair.values) == pytest.approx(float(true[0]), rel=1e-4)


@pytest.mark.parametrize("sign", [1, -1])
def test_power_ends_puts_the_ends_in_order_whichever_is_longer(sign):
    H = DenseOperator(sign * operator("both tails").matrix)
    true = eigenvalues(H)
    ends = power_ends(H, generator(), PowerSettings(rtol=1e-3, max_matvecs=3000))
    assert float(ends.largest.values) == pytest.approx(float(true[-1]), rel=1e-3)
    assert float(ends.smallest.values) == pytest.approx(float(true[0]), rel=1e-3)
    assert ends.method == "power iteration"


def test_power_iteration_says_when_its_budget_ends_it():
    H = CountingOperator(operator("indefinite"))
    ends = power_ends(H, generator(), PowerSettings(rtol=1e-12, max_matvecs=15))
    assert ends.largest.reason == "matvec budget" and H.matvecs == ends.matvecs == 30


@pytest.mark.parametrize("name", ["power law", "both tails", "clustered", "negative", "indefinite"])
@pytest.mark.parametrize("steps", [1, 2, 9, 25])
def test_lanczos_runs_hold_the_iterates_of_power_iteration(name, steps):
    H, Z = operator(name), torch.randn(N, 2, generator=generator(), dtype=torch.float64)
    settings = PowerSettings(rtol=0.0, max_matvecs=steps)
    ends = power_of_runs(lanczos(H, Z, max(steps, 12)), settings)
    first, _ = power_iteration(H, generator(), settings, start=Z[:, 0])
    other, _ = power_iteration(H, generator(), settings, shift=float(first.values), start=Z[:, 1])
    size = float(eigenvalues(H).abs().max())
    for found, true in zip(
        (ends.smallest, ends.largest), sorted((first, other), key=lambda pair: float(pair.values)), strict=True
    ):
        assert abs(float(found.values - true.values)) < 1e-10 * size
        assert abs(float(found.residuals - true.residuals)) < 1e-10 * size
        assert float((found.vectors - true.vectors).norm()) < 1e-10
        assert found.reason == "matvec budget"
    assert ends.matvecs == 0


def test_iterates_end_where_the_lanczos_run_does_unless_it_found_all_there_is():
    H, Z = operator("both tails"), torch.randn(N, 1, generator=generator(), dtype=torch.float64)
    settings = PowerSettings(rtol=0.0, max_matvecs=3000)
    short, _ = power_iteration(H, generator(), replace(settings, max_matvecs=7), start=Z[:, 0])
    assert float(power_of_runs(lanczos(H, Z, 7), settings).largest.residuals) == pytest.approx(float(short.residuals))
    whole = DenseOperator(torch.diag(torch.tensor([3.0, 2.0, -1.0], dtype=torch.float64)))
    ends = power_of_runs(lanczos(whole, torch.ones(3, 1, dtype=torch.float64), 3), settings)
    assert float(ends.largest.values) == pytest.approx(3) and float(ends.smallest.values) == pytest.approx(-1)
    assert ends.smallest.reason == "noise floor"


def test_power_iteration_of_zero_is_zero():
    pair, _ = power_iteration(operator("zero"), generator())
    assert float(pair.values) == float(pair.residuals) == 0.0


def test_bad_power_settings_are_refused():
    misused("max_matvecs >= 1", PowerSettings, max_matvecs=0)


def test_products_that_are_not_finite_are_an_error():
    misused("finite products", power_iteration, Broken(torch.eye(5)), generator())


@pytest.mark.parametrize("wrong", ["rtol", "atol"])
def test_a_power_setting_that_is_no_number_is_refused(wrong):
    misused(r"got .*nan", replace, PowerSettings(), **{wrong: float("nan")})


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_power_iteration_scales_with_the_operator(scale):
    H = operator("clustered")
    pair, steps = power_iteration(DenseOperator(scale * H.matrix), generator(), PowerSettings(rtol=1e-4))
    plain, expected = power_iteration(H, generator(), PowerSettings(rtol=1e-4))
    assert steps == expected and pair.reason == plain.reason
    assert float(pair.values) == pytest.approx(scale * float(plain.values), rel=1e-9, abs=0)
    assert float(pair.residuals) == pytest.approx(scale * float(plain.residuals), rel=1e-6, abs=0)
