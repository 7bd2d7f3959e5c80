import numpy as np
import pytest

from landscape.slices.interpolation import PlaneInterpolant, error_bound

X, Y = np.linspace(-1, 1, 21), np.concatenate([np.linspace(-0.3, 0, 7), np.geomspace(0.01, 2, 12)])


def known(grid, values, more=()):
    """The values on the axes, at the 16 points farthest from these, and at some more; nan elsewhere."""
    at = np.isin(np.arange(values.size), grid.required)
    at[np.concatenate([grid.farthest(at, 16), more]).astype(int)] = True
    return np.where(at, values, np.nan)


def test_on_the_axes_and_where_it_is_known_the_interpolant_is_the_function():
    values = np.random.default_rng(0).standard_normal(21 * 19)
    grid = PlaneInterpolant(X, Y, mixed=3.0)
    given = known(grid, values, [30, 111])
    found, at = grid(given), np.isfinite(given)
    assert at.reshape(21, 19)[10].all() and at.reshape(21, 19)[:, 6].all() and at.sum() == 21 + 18 + 16 + 2
    # round-off, as the solve of the spline amplifies it
    assert abs(found - values)[at].max() < 1e-11 and np.isfinite(found).all()


def test_the_farthest_points_fill_the_plane_from_its_corners_inwards():
    grid = PlaneInterpolant(np.linspace(-2, 2, 9), np.linspace(-1, 1, 9))
    known = np.isin(np.arange(81), grid.required)
    assert sorted(grid.farthest(known, 4)) == [0, 8, 72, 80]
    found = grid.farthest(known, 100)  # all there are, each once
    assert len(found) == 64 and set(found) == set(np.flatnonzero(~known))
    gaps = [grid.farthest(np.isin(np.arange(81), [*grid.required, *found[:n]]), 1)[0] for n in range(64)]
    assert gaps == list(found)  # as one by one


@pytest.mark.parametrize("step", [1e-2, 1e-4])
def test_its_hessian_at_the_centre_is_the_functions(step):
    """The mixed difference over four points near the centre tends to d2f/dxdy; it is not those of the far points."""
    x = np.array([-1, -0.5, -step, 0, step, 0.5, 1.0])
    f = np.add.outer(x, x) ** 2 / 2 + np.sin(5 * np.outer(x, x) * np.add.outer(x, 2 * x))  # d2f/dxdy = 1
    grid = PlaneInterpolant(x, x, mixed=1.0)
    at = np.add.outer(abs(x), abs(x)) > 0.4  # on the axes, and far from the centre
    at[3, :] = at[:, 3] = True
    found = grid(np.where(at, f, np.nan).ravel()).reshape(7, 7)
    mixed = (found[4, 4] - found[2, 4] - found[4, 2] + found[2, 2]) / (4 * step**2)
    assert abs(mixed - 1) < 20 * step


def test_without_the_hessian_a_product_is_found_from_points_off_the_axes():
    values = (np.add.outer(X**3, abs(Y)) + 2 * np.outer(X, Y) + np.outer(X**2, Y)).ravel()
    grid = PlaneInterpolant(X, Y)
    assert abs(grid(known(grid, values)) - values).max() < 1e-12


def test_values_that_are_not_finite_leave_the_others_as_they_are():
    values = np.outer(X**2, Y).ravel()
    grid = PlaneInterpolant(X, Y, mixed=0.0)
    values[0] = np.inf  # a corner
    others = np.isfinite(values)
    assert abs(grid(known(grid, values)) - values)[others].max() < 1e-12


@pytest.mark.parametrize(("draw", "least"), [("exponential", 0.97), ("uniform", 0.995)])
def test_the_bound_holds_for_all_points_as_often_as_it_says(draw, least):
    """Of errors with an exponential tail in at least 97.5% of the draws; of those that end somewhere nearly always."""
    random, runs = np.random.default_rng(1), 2000
    errors = getattr(random, draw)(size=(runs, 1064))
    held = [error_bound(row[:64], 1000, looks=1) >= row[64:].max() for row in errors]
    assert np.mean(held) > least
    assert all(error_bound(row[:64], 1000, looks=2) > error_bound(row[:64], 1000, looks=1) for row in errors[:20])


def test_the_bound_holds_where_a_tenth_of_the_errors_is_ten_times_as_large():
    """As beside a jump: most errors say nothing of the largest ones."""
    random = np.random.default_rng(2)
    errors = random.exponential(size=(400, 1064)) * np.where(random.random((400, 1064)) < 0.1, 10, 1)
    assert np.mean([error_bound(row[:64], 1000, looks=1) >= row[64:].max() for row in errors]) > 0.9


def test_without_errors_to_judge_by_nothing_is_bounded():
    assert error_bound(np.empty(0), 5, 0) == error_bound(np.array([0.1, np.inf]), 5, 1) == np.inf
    assert error_bound(np.empty(0), 0, 0) == 0.0 and error_bound(np.zeros(64), 1000, 1) == 0.0
