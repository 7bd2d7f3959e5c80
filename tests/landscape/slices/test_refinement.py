from functools import cache

import numpy as np
import pytest
import torch

from landscape.slices.refinement import SliceSettings
from landscape.slices.slices import evaluate_slice, symmetric_axis

PLANE = torch.eye(2, dtype=torch.float64)
SIDE = symmetric_axis(1.0, 41)


def bowl(theta):
    x, y = theta.tolist()
    return 3 + x + 2 * x * x - x * y + y * y


def valley(theta):
    """As along two eigenvectors: round near the centre, straight walls, no interaction."""
    x, y = theta.tolist()
    return float(np.log(np.cosh(9 * x)) + np.log(np.cosh(14 * (y - 0.1))))


def crease(theta):
    """As along a random direction: a kink across the plane."""
    x, y = theta.tolist()
    return abs(x + 0.7 * y - 0.2) + 0.2 * x * x


def sliced(loss, seed=0, axes=(SIDE, SIDE), **settings):
    return evaluate_slice(
        loss,
        torch.zeros(2, dtype=torch.float64),
        PLANE[:, : len(axes)],
        list(axes),
        settings=SliceSettings(**settings),
        generator=torch.Generator().manual_seed(seed),
    )


@cache
def truth(loss, axes):
    """The loss at every point of the grid of some axes, which are given as tuples of numbers."""
    points = torch.stack(
        torch.meshgrid(*(torch.tensor(axis, dtype=torch.float64) for axis in axes), indexing="ij"), dim=-1
    )
    flat = points.reshape(-1, points.shape[-1])
    flat = torch.nn.functional.pad(flat, (0, 2 - flat.shape[1]))
    return torch.tensor([float(loss(point)) for point in flat], dtype=torch.float64).reshape(points.shape[:-1])


def errors(loss, found):
    """Of the interpolated values, as shares of the true range."""
    true = truth(loss, tuple(tuple(axis.tolist()) for axis in found.coordinates))
    assert torch.equal(found.loss[found.evaluated], true[found.evaluated])
    return (found.loss - true).abs() / (true.max() - true.min())


@pytest.mark.parametrize(("loss", "share"), [(bowl, 0.05), (valley, 0.1), (crease, 0.4)])
def test_the_slice_takes_few_evaluations_and_is_as_good_as_asked_for(loss, share):
    found = sliced(loss)
    off = errors(loss, found)
    assert found.reason == "tolerance" and found.interpolation_error <= 0.01
    assert found.evaluations == 1 + int(found.evaluated.sum()) <= share * 41**2
    # what 30 random points of which none is off allow, with 95% confidence over all looks
    assert found.holdout.numel() == 30 and float((off > 0.01).double().mean()) <= found.share_beyond
    assert found.share_beyond == pytest.approx(1 - (0.05 / 2**found.looks) ** (1 / 30))


def test_a_parabola_costs_the_coarse_grid_one_round_and_the_hold_out():
    found = sliced(bowl)
    assert errors(bowl, found).max() < 1e-14 and found.interpolation_error < 1e-14


@pytest.mark.parametrize("side", [5, 11, 21, 35, 64])
def test_any_number_of_points_a_side_works(side):
    axes = (
        torch.linspace(-1, 2, side, dtype=torch.float64),
        torch.linspace(-1, 1, 2 * side + 1, dtype=torch.float64) ** 3,
    )
    found = sliced(bowl, axes=axes)
    assert errors(bowl, found).max() < 1e-13 and found.loss.shape == (side, 2 * side + 1)


def test_along_one_direction_a_kink_is_found():
    def kink(theta):
        return abs(float(theta[0]) - 0.31)

    found = sliced(kink, axes=(symmetric_axis(1.0, 401),))
    assert found.loss.shape == (401,) and found.evaluations < 0.25 * 401 and errors(kink, found).max() < 0.01
    # the kink; a straight part, with its share of the hold-out
    assert found.evaluated[262] and found.evaluated[:100].double().mean() < 0.2


def hidden(theta):
    """A wave that is 0 wherever the refinement looks first."""
    height = float(np.sin(4 * np.pi * float(theta[0])))
    return height if abs(height) > 1e-9 else 0.0


def test_the_interpolation_error_is_that_of_random_points_not_yet_known():
    found = sliced(hidden, max_evaluations=60)
    assert found.reason == "evaluation budget" and found.interpolation_error > 0.4
    assert errors(hidden, found).max() > 0.4


def test_what_the_hold_out_finds_is_refined():
    found = sliced(hidden)
    assert found.reason == "tolerance" and found.evaluations < 0.5 * 41**2 and errors(hidden, found).max() < 0.01


def test_the_interpolation_error_covers_the_true_error_as_often_as_it_says():
    # the share of points off by more than the largest of m random ones exceeds 1 - 0.05^(1/m) in 5% of the runs
    runs, beyond = 200, 0
    side = symmetric_axis(1.0, 21)
    for seed in range(runs):
        found = sliced(crease, seed, (side, side), tolerance=0.02, max_evaluations=120, holdout=10)
        off = errors(crease, found)
        judged = off[~found.evaluated]
        beyond += bool((judged > found.interpolation_error).double().mean() > found.share_beyond)
    # four standard errors of a binomial count above its mean
    assert beyond <= 0.05 * runs + 4 * (0.05 * 0.95 * runs) ** 0.5


def test_the_same_seed_gives_the_same_slice_whatever_the_number_of_workers():
    one, four, other = sliced(crease), sliced(crease, workers=4), sliced(crease, seed=1)
    assert torch.equal(one.evaluated, four.evaluated) and torch.equal(one.loss, four.loss)
    assert torch.equal(one.holdout, four.holdout) and not torch.equal(one.evaluated, other.evaluated)


@pytest.mark.parametrize("most", [1, 2, 5, 20, 31, 64, 150, 1000])
def test_no_more_evaluations_are_made_than_allowed(most):
    calls = []

    def rough(theta):
        calls.append(theta)
        return float(np.sin(1e4 * float(theta[0]) + 1e5 * float(theta[1] ** 2)))

    found = sliced(rough, max_evaluations=most, holdout=10)
    assert len(calls) == found.evaluations <= most and found.reason == "evaluation budget"
    assert found.interpolation_error > 0.1 and (most > 1 or found.share_beyond == 1)


def test_on_a_small_grid_the_hold_out_takes_only_its_points_of_the_budget():
    found = sliced(bowl, axes=(symmetric_axis(1.0, 41),), max_evaluations=16)
    assert found.evaluations <= 16 and found.holdout.numel() == 4 and found.interpolation_error < 1e-14


def test_a_hold_out_that_passes_after_others_failed_is_trusted_less():
    """Of a table whose entries are no function of the place looks are repeated until one is lucky."""
    marked = torch.rand(41, 41, generator=torch.Generator().manual_seed(1)) < 0.12
    marked[20], marked[:, 20] = False, False

    def table(theta):
        i, j = (20 * theta + 20).round().long().tolist()
        return float((theta * theta).sum()) + 0.1 * float(marked[i, j])

    found = sliced(table)
    assert found.reason == "tolerance" and found.looks > 1
    assert found.share_beyond == pytest.approx(1 - (0.05 / 2**found.looks) ** (1 / found.holdout.numel()))


def test_of_noise_every_point_is_evaluated():
    random = np.random.default_rng(0).standard_normal((11, 11))
    side = symmetric_axis(5.0, 11)
    found = sliced(lambda theta: random[int(theta[0]) + 5, int(theta[1]) + 5], axes=(side, side))
    assert float(found.evaluated.double().mean()) > 0.95 and found.interpolation_error <= 0.01


def test_a_region_without_finite_values_is_evaluated_everywhere():
    def broken(theta):
        return float("nan") if theta[0] > 0.2 else bowl(theta)

    found = sliced(broken)
    assert found.evaluated[SIDE > 0.2].all() and not found.loss[SIDE > 0.2].isfinite().any()
    assert found.loss[SIDE <= 0.2].isfinite().all() and float(found.evaluated[SIDE <= 0.2].double().mean()) < 0.4


def test_losses_that_are_not_finite_are_found_by_the_hold_out():
    def broken(theta):
        return float("inf") if 0.26 < theta[0] < 0.49 else bowl(theta)

    found = sliced(broken)
    gap = (SIDE > 0.26) & (SIDE < 0.49)
    assert gap.sum() == 4 and found.evaluated[gap].all() and found.loss[gap].isinf().all()
    stopped = sliced(broken, max_evaluations=70)
    assert stopped.interpolation_error == float("inf") and stopped.record()["interpolation_error"] is None


def test_a_constant_is_known_from_the_coarse_grid():
    found = sliced(lambda theta: 2.5)
    assert found.evaluations == 21 + 30 + 1 and (found.loss == 2.5).all() and found.interpolation_error == 0


def test_time_ends_the_refinement():
    found = sliced(crease, max_seconds=1e-9)
    assert found.reason == "time budget" and found.evaluations == 21 + 30 + 1


def test_points_that_were_not_evaluated_are_not_marked_discontinuous():
    found = sliced(lambda theta: (bowl(theta), bool(theta[0] > 0)))
    assert found.discontinuous is not None
    assert torch.equal(found.discontinuous, found.evaluated & (SIDE > 0)[:, None])
    record = found.record()
    assert record["crossed_points"] == int(found.discontinuous.sum()) and record["points"] == 41**2
    assert record["evaluated_points"] == int(found.evaluated.sum()) == found.evaluations - 1 < 41**2


def test_settings_without_meaning_are_refused():
    with pytest.raises(ValueError, match="tolerance between 0 and 1"):
        SliceSettings(tolerance=0.0)
    with pytest.raises(ValueError, match="at least 1"):
        SliceSettings(holdout=0)
    with pytest.raises(ValueError, match="positive budgets"):
        SliceSettings(max_seconds=0.0)
    with pytest.raises(ValueError, match="no budget for a slice of every point"):
        SliceSettings(tolerance=None, max_evaluations=9)
