from math import inf, isclose

import pytest
import torch

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds, Eigenpairs
from landscape.eigen.power import PowerSettings, power_ends
from landscape.operators.operator import DenseOperator
from landscape.spectrum.anisotropy import (
    _quotients,
    anisotropy,
    eigenvalue_ratio,
    negative_ratio,
    participation_ratio,
    top_mass,
)
from landscape.spectrum.density import spectral_density
from tests.landscape.spectra import ROUNDING, N, eigenvalues, generator, operator
from tests.refusals import misused


def ends(top, bottom, residuals=(0.0, 0.0)):
    """Ends with these values and residuals."""
    pairs = []
    for value, residual in zip((top, bottom), residuals, strict=True):
        numbers = torch.tensor([[value], [residual], [inf]], dtype=torch.float64)
        pairs.append(Eigenpairs(numbers[0], torch.ones(1, 1).double(), numbers[1], numbers[2], "tolerance"))
    return EigenEnds(pairs[0], pairs[1], "by hand", 0, inf, 0.0)


def test_the_ratios_are_their_definitions():
    assert eigenvalue_ratio(ends(4.0, -0.1)).value == pytest.approx(-40.0)
    assert negative_ratio(ends(4.0, -0.1)).value == pytest.approx(0.1 / 4.0)
    assert eigenvalue_ratio(ends(4.0, 0.1)).value == pytest.approx(40.0)
    assert eigenvalue_ratio(ends(-1.0, -4.0)).value == pytest.approx(0.25)


def test_brackets_are_the_extreme_quotients_of_the_intervals():
    index = eigenvalue_ratio(ends(4.0, -0.1, residuals=(0.4, 0.02)))
    assert (index.low, index.high) == pytest.approx((-4.4 / 0.08, -3.6 / 0.12))
    index = negative_ratio(ends(4.0, -0.1, residuals=(0.4, 0.02)))
    assert (index.low, index.high) == pytest.approx((0.08 / 4.4, 0.12 / 3.6))


def test_an_unresolved_small_end_bounds_each_ratio_on_one_side():
    unresolved = ends(4.0, 0.01, residuals=(0.4, 0.02))
    index = eigenvalue_ratio(unresolved)
    assert index.low == pytest.approx(3.6 / 0.03) and index.high == inf and "not resolved" in index.note
    assert index.value == pytest.approx(400)
    index = negative_ratio(unresolved)
    assert index.value == index.low == 0 and index.high == pytest.approx(0.01 / 3.6) and "not resolved" in index.note


def test_a_small_end_that_is_zero_to_round_off_bounds_the_index_by_the_dtype():
    index = eigenvalue_ratio(ends(4.0, 0.0))
    assert index.value is None and isclose(index.low, 1 / torch.finfo(torch.float64).eps, rel_tol=1e-6)


def test_an_unresolved_large_end_leaves_open_whether_there_is_positive_curvature_at_all():
    unresolved = ends(-0.01, -4.0, residuals=(0.02, 0.4))
    index = negative_ratio(unresolved)
    assert index.value is None and index.low == pytest.approx(3.6 / 0.01) and index.high == inf
    assert "lambda_max is positive at all" in index.note and str(index).startswith(">= 360")
    index = eigenvalue_ratio(unresolved)
    assert index.value == pytest.approx(0.01 / 4)
    assert (index.low, index.high) == pytest.approx((-0.01 / 3.6, 0.03 / 3.6))
    assert "lambda_max is not resolved" in index.note
    notes = [eigenvalue_ratio(ends(*pair)).note for pair in ((2.0, 1.0), (2.0, -1.0), (-1.0, -2.0))]
    assert notes == ["definite", "indefinite", "definite"]


@pytest.mark.parametrize("seed", range(30))
def test_brackets_hold_all_that_the_intervals_of_both_ends_allow_and_nothing_else(seed):
    """Against a grid of both intervals."""
    draws = torch.Generator().manual_seed(seed)
    bottom, top = torch.randn(2, generator=draws).double().sort().values.tolist()
    residuals = tuple((0.5 * torch.rand(2, generator=draws)).tolist())
    found = ends(top, bottom, residuals)
    x = torch.linspace(top - residuals[0], top + residuals[0], 101, dtype=torch.float64)[:, None]
    y = torch.linspace(bottom - residuals[1], bottom + residuals[1], 101, dtype=torch.float64)
    allowed = (x >= y) & (y != 0)
    quotients, index = (x / y)[allowed], eigenvalue_ratio(found)
    if not index.note.endswith("its modulus"):
        assert index.low <= float(quotients.min()) and float(quotients.max()) <= index.high
        signs = (x * y).sign()[allowed].unique().tolist()
        assert index.note == {1: "definite", -1: "indefinite"}.get(sum(signs), index.note)
        assert ("not resolved" in index.note) == (len(signs) > 1)
        assert index.value is not None and index.low <= index.value <= index.high
    ratios, down = ((-y).clamp_min(0) / x)[allowed & (x > 0)], negative_ratio(found)
    assert down.value is None or down.low <= down.value <= down.high
    if len(ratios) and down.high < inf:
        assert down.low <= float(ratios.min()) and float(ratios.max()) <= down.high * (1 + ROUNDING)
        assert down.high - down.low <= 1.1 * float(ratios.max() - ratios.min()) + 0.1 * down.high


@pytest.mark.parametrize("seed", range(5))
def test_a_negative_operator_whose_large_end_the_budget_left_behind_has_no_ratio(seed):
    values = -torch.cat([torch.logspace(-6, -3, 1900), torch.logspace(0, 1, 100)]).double()
    H, generator = DenseOperator(torch.diag(values)), torch.Generator().manual_seed(seed)
    found = extreme_eigenpairs(H, generator, EigenSettings(max_matvecs=12))
    assert found.largest.reason == "matvec budget" and float(found.largest.values[0]) < 0
    down, index = negative_ratio(found), eigenvalue_ratio(found)
    assert down.value is None and down.high == inf
    assert index.low <= float(values.max() / values.min()) <= index.high and "not resolved" in index.note


@pytest.mark.parametrize("top", [(-3.0, -1.0), (-3.0, 1.0), (1.0, 3.0)])
@pytest.mark.parametrize("sizes", [(0.5, 2.0), (0.0, 2.0)])
def test_quotients_of_either_sign_by_a_size_that_may_be_as_small_as_any_are_bounded_on_the_right_side(top, sizes):
    x = torch.linspace(top[0], top[1], 101, dtype=torch.float64)[:, None]
    y = torch.linspace(sizes[0], sizes[1], 101, dtype=torch.float64).clamp_min(1e-300)
    low, high = _quotients(top, sizes)
    least, most = float((x / y).min()), float((x / y).max())
    assert low == pytest.approx(least if least > -1e290 else -inf)
    assert high == pytest.approx(most if most < 1e290 else inf)


def test_the_negative_ratio_is_0_at_a_minimum_and_undefined_without_a_positive_curvature():
    assert negative_ratio(ends(4.0, 0.1)).record() == {"value": 0.0, "low": 0.0, "high": 0.0, "note": ""}
    assert "negative semi-definite" in str(negative_ratio(ends(-0.1, -4.0)))


@pytest.mark.parametrize("name", ["indefinite", "both tails", "power law", "clustered", "rank-deficient"])
def test_every_bracket_holds_the_truth(name):
    H = operator(name)
    true = eigenvalues(H)
    magnitude = true.abs().sum()
    found = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-4))
    family = anisotropy(found, spectral_density(H, generator(), matvecs=128, starts=8))
    assert family.top_mass is not None and family.participation_ratio is not None
    assert family.top_mass.low <= float(true[-1] / magnitude) <= family.top_mass.high
    assert family.participation_ratio.low <= magnitude**2 / true.square().sum() <= family.participation_ratio.high
    if name == "rank-deficient":
        assert family.eigenvalue_ratio.high == inf and family.eigenvalue_ratio.low > 1e10
        assert family.negative_ratio.low == 0 and family.negative_ratio.high < 1e-10
        return
    assert family.eigenvalue_ratio.low <= float(true[-1] / true[0]) <= family.eigenvalue_ratio.high
    assert family.negative_ratio.low <= max(float(-true[0] / true[-1]), 0.0) <= family.negative_ratio.high


def test_a_multiple_of_the_identity_has_full_effective_rank_and_even_share():
    H = DenseOperator(-3 * torch.eye(N, dtype=torch.float64))
    found, density = extreme_eigenpairs(H, generator()), spectral_density(H, generator())
    rank = participation_ratio(found, density)
    assert (rank.low, rank.value, rank.high) == pytest.approx((N, N, N))
    assert top_mass(found, density).value == pytest.approx(-1 / N)


def test_the_zero_operator_has_no_index():
    H = operator("zero")
    found, density = extreme_eigenpairs(H, generator()), spectral_density(H, generator())
    family = anisotropy(found, density)
    for index in (family.eigenvalue_ratio, family.negative_ratio, family.top_mass, family.participation_ratio):
        assert index is not None and index.value is None


def test_the_papers_power_iteration_gives_the_literal_index():
    H = operator("both tails")
    true = eigenvalues(H)
    index = eigenvalue_ratio(power_ends(H, generator(), PowerSettings(rtol=1e-3, max_matvecs=3000)))
    assert index.value == pytest.approx(float(true[-1] / true[0]), rel=2e-3)
    assert index.low <= float(true[-1] / true[0]) <= index.high


def test_splitting_a_direction_in_two_halves_changes_the_literal_index_but_not_the_share():
    """One direction split into two coincident halves: theta = a + b, so that each new row is the old one."""
    split = torch.cat([torch.eye(N, dtype=torch.float64)] * 2, dim=1)
    H = operator("both tails")
    doubled = DenseOperator(split.T @ H.matrix @ split)
    true, twice = eigenvalues(H), eigenvalues(doubled)
    before = anisotropy(extreme_eigenpairs(H, generator()), spectral_density(H, generator(), 8))
    after = anisotropy(extreme_eigenpairs(doubled, generator()), spectral_density(doubled, generator(), 8))
    assert before.top_mass is not None and after.top_mass is not None
    assert after.top_mass.low <= float(twice[-1] / twice.abs().sum()) <= after.top_mass.high
    assert float(twice[-1] / twice.abs().sum()) == pytest.approx(float(true[-1] / true.abs().sum()))
    assert before.record().keys() == {"eigenvalue_ratio", "negative_ratio", "top_mass", "participation_ratio"}


def test_without_a_density_only_the_ends_indices_are_given():
    assert anisotropy(ends(4.0, -0.1)).record().keys() == {"eigenvalue_ratio", "negative_ratio"}


@pytest.mark.parametrize("seed", range(10))
def test_an_end_that_the_budget_left_behind_is_not_claimed(seed):
    """Most eigenvalues are next to 0, and a small negative one hides behind the large ones: its Ritz value is still near 0."""
    values = torch.cat([torch.tensor([-0.02]), torch.linspace(-1e-4, 1e-4, 1900), torch.logspace(0, 1, 99)]).double()
    H, generator = DenseOperator(torch.diag(values)), torch.Generator().manual_seed(seed)
    ends = extreme_eigenpairs(H, generator, EigenSettings(max_matvecs=12))
    assert ends.smallest.reason == "matvec budget"
    assert float(ends.smallest.values[0]) - float(ends.smallest.residuals[0]) > -0.02  # the residual does not tell
    found, down, truth = eigenvalue_ratio(ends), negative_ratio(ends), 10 / -0.02
    assert found.low <= abs(truth) if "for its modulus" in found.note else found.low <= truth <= found.high
    assert down.low <= 1 / abs(truth) <= down.high


def test_an_end_that_was_not_looked_for_is_asked_for():
    H = operator("both tails")
    top = extreme_eigenpairs(H, generator(), EigenSettings(largest=1, smallest=0))
    misused("eigenpair at each end, got 1 of the largest and 0 of the smallest", eigenvalue_ratio, top)
    misused("eigenpair at each end", anisotropy, top, spectral_density(H, generator(), 24))
