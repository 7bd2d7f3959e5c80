from functools import cache

import numpy as np
import pytest
import torch

from landscape.slices.grid_evaluations import Control
from landscape.slices.refinement import SliceSettings
from landscape.slices.slices import evaluate_slice, symmetric_axis
from tests.refusals import misused

PLANE = torch.eye(2, dtype=torch.float64)
SIDE = symmetric_axis(1.0, 41)


def bowl(theta):
    x, y = theta.tolist()
    return 3 + x + 2 * x * x - x * y + y * y


def valley(theta):
    """As along two eigenvectors: round near the centre, straight walls, no interaction."""
    x, y = theta.tolist()
    return float(np.log(np.cosh(9 * x)) + np.log(np.cosh(14 * (y - 0.1))))


def noise(theta):
    """No function of the place: nothing predicts it."""
    return float(np.sin(1e4 * float(theta[0]) + 1e5 * float(theta[1] ** 2)))


def crease(theta):
    """As along a random direction: a fold across the plane."""
    x, y = theta.tolist()
    return float(np.hypot(x + 0.7 * y - 0.2, 0.1)) + 0.2 * x * x


def jumps(theta):
    """As where splats change their order: small jumps everywhere over a valley."""
    return valley(theta) + 0.02 * noise(theta)


def beside(theta):
    """`jumps` and what is small and smooth."""
    return jumps(theta) + 0.02 * bowl(theta)


def sliced(loss, seed=0, axes=(SIDE, SIDE), control=None, **settings):
    center, generator = torch.zeros(2, dtype=torch.float64), torch.Generator().manual_seed(seed)
    chosen, directions = SliceSettings(**settings), PLANE[:, : len(axes)]
    return evaluate_slice(loss, center, directions, list(axes), settings=chosen, generator=generator, control=control)


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


@pytest.mark.parametrize(("loss", "tolerance", "share"), [(bowl, 0.01, 0.1), (valley, 0.01, 0.1), (crease, 0.05, 0.2)])
def test_the_slice_takes_few_evaluations_and_is_as_good_as_asked_for(loss, tolerance, share):
    found = sliced(loss, tolerance=tolerance)
    off = errors(loss, found)
    assert found.reason == "tolerance" and found.resolved and found.tolerance == tolerance >= found.interpolation_error
    assert found.evaluations == 1 + int(found.evaluated.sum()) <= share * 41**2
    assert off.max() <= tolerance and found.error_seen <= found.interpolation_error
    assert found.holdout.numel() == 64


def test_a_plane_with_small_jumps_is_not_rendered_whole():
    """Of a thousandth of the range: a larger hold-out has more errors in its tail, from which the bound is told."""
    for seed in range(3):
        found = sliced(jumps, seed)
        assert found.reason == "tolerance" and found.evaluations < 0.4 * 41**2 and errors(jumps, found).max() <= 0.01


@pytest.mark.parametrize("loss", [valley, crease, noise])
def test_on_the_axes_nothing_is_interpolated(loss):
    found = sliced(loss, max_evaluations=1)
    assert found.evaluated[20].all() and found.evaluated[:, 20].all() and found.evaluations == 82
    assert not found.resolved and found.reason == "evaluation budget" and found.interpolation_error == float("inf")
    assert torch.equal(found.loss.isfinite(), found.evaluated)


def test_along_a_line_every_point_is_evaluated():
    found = sliced(crease, axes=(symmetric_axis(1.0, 101),), tolerance=0.5)
    assert found.evaluated.all() and found.reason == "exact" and found.resolved


def test_a_parabola_costs_the_axes_the_coarse_points_and_the_hold_out():
    found = sliced(bowl)
    assert found.evaluations == 1 + 81 + 16 + 64
    assert errors(bowl, found).max() < 1e-13 and found.interpolation_error < 1e-13


@pytest.mark.parametrize("side", [5, 11, 21, 35])
def test_any_number_of_points_a_side_works(side):
    axes = (symmetric_axis(2.0, side), symmetric_axis(1.0, 2 * side + 1) ** 3)
    found = sliced(bowl, axes=axes)
    # round-off, as the solve of the spline amplifies it
    assert errors(bowl, found).max() < 1e-11 and found.loss.shape == (side, 2 * side + 1) and found.resolved


def test_the_centre_may_lie_anywhere_on_its_axes():
    found = sliced(bowl, axes=(torch.arange(-3.0, 20.0).double() / 10, torch.arange(0.0, 25.0).double() / 20))
    assert errors(bowl, found).max() < 1e-12 and found.evaluated[3].all() and found.evaluated[:, 0].all()


def test_without_the_centre_on_its_axes_a_plane_is_refused():
    misused("coordinates of a plane with 0 among them", sliced, bowl, axes=(torch.linspace(0.1, 1, 41).double(), SIDE))


def test_the_stated_error_covers_every_point_of_slices_from_many_seeds():
    """The bound has 95% confidence; what was asked for holds with room beyond it."""
    runs, beyond = 30, 0
    for seed in range(runs):
        found = sliced(crease, seed, (symmetric_axis(1.0, 31),) * 2, tolerance=0.05)
        off = errors(crease, found).max()
        beyond += bool(off > found.interpolation_error)
        assert off <= 0.05
    # four standard errors of a binomial count above its mean
    assert beyond <= 0.05 * runs + 4 * (0.05 * 0.95 * runs) ** 0.5


def test_the_same_seed_gives_the_same_slice_whatever_the_number_of_workers():
    one, four, other = (sliced(crease, seed, tolerance=0.05, workers=n) for seed, n in ((0, 1), (0, 4), (1, 1)))
    assert torch.equal(one.evaluated, four.evaluated) and torch.equal(one.loss, four.loss)
    assert torch.equal(one.holdout, four.holdout) and not torch.equal(one.evaluated, other.evaluated)


@pytest.mark.parametrize("most", [1, 160, 161, 285, 286, 1000])
def test_beyond_the_axes_no_more_evaluations_are_made_than_allowed(most):
    calls = []

    def rough(theta):
        calls.append(theta)
        return noise(theta)

    found = sliced(rough, max_evaluations=most)
    assert len(calls) == found.evaluations <= max(most, 82) and found.reason == "evaluation budget"
    assert found.interpolation_error > 0.1 and not found.resolved and found.loss[~found.evaluated].isnan().all()
    assert found.looks == (most > 161) + (most > 285) + (most > 591) + (most > 1355)


def test_of_noise_every_point_is_evaluated():
    got = sliced(noise, axes=(symmetric_axis(1.0, 21),) * 2)
    assert got.evaluated.all() and got.tolerance is None and (got.reason, got.interpolation_error) == ("exact", 0)


def test_with_a_control_that_has_the_jumps_few_evaluations_tell_the_rest():
    for seed in range(5):
        found = sliced(beside, seed, control=Control(lambda x: jumps(x.flip(0)), torch.tensor([1, 0])))
        assert found.evaluations == 1 + 1 + 16 + 22 < sliced(beside, seed).evaluations and found.reason == "tolerance"
        assert 0 < found.error_seen <= found.interpolation_error <= 0.01
        assert errors(beside, found).max() <= found.interpolation_error


def test_a_control_without_the_jumps_costs_evaluations_and_no_accuracy():
    found = [sliced(jumps, seed, control=Control(bowl, torch.arange(2))) for seed in range(10)]
    off = [errors(jumps, each).max() for each in found]
    assert all(each.evaluations > 100 and each.interpolation_error <= 0.01 for each in found) and max(off) <= 0.01
    assert sum(error > each.interpolation_error for error, each in zip(off, found, strict=True)) <= 3  # of 10, 95% each


def test_losses_that_are_not_finite_are_never_interpolated():
    def broken(theta):
        return float("nan") if theta[0] > 0.2 else bowl(theta)

    found = sliced(broken)
    assert found.resolved and found.loss[SIDE <= 0.2].isfinite().all() and not found.loss[SIDE > 0.2].isfinite().any()
    stopped = sliced(broken, max_evaluations=300)
    assert stopped.interpolation_error == float("inf") and stopped.record()["interpolation_error"] is None
    assert stopped.record()["resolved"] is False


def test_a_constant_is_known_from_the_first_hold_out():
    found = sliced(lambda theta: 2.5)
    assert found.evaluations == 81 + 16 + 64 + 1 and (found.loss == 2.5).all() and found.interpolation_error == 0


def test_points_that_were_not_evaluated_are_not_marked_discontinuous():
    found = sliced(lambda theta: (bowl(theta), bool(theta[0] > 0)))
    assert found.discontinuous is not None
    assert torch.equal(found.discontinuous, found.evaluated & (SIDE > 0)[:, None])
    record = found.record()
    assert record["crossed_points"] == int(found.discontinuous.sum()) and record["points"] == 41**2
    assert record["evaluated_points"] == int(found.evaluated.sum()) == found.evaluations - 1 < 41**2


def test_settings_without_meaning_are_refused():
    misused("tolerance between 0 and 1", SliceSettings, tolerance=0.0)
    misused("at least 1", SliceSettings, holdout=0)
    misused("one evaluation or more", SliceSettings, max_evaluations=0)
    misused("no budget for a slice of every point", SliceSettings, tolerance=None, max_evaluations=9)
