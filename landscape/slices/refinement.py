"""Choice of the points at which a slice is evaluated: a sparse grid grows until it predicts random points well.

    refine      evaluate points whose parents' surplus (`sparse_grid`) exceeds a threshold, the largest first, `batch` at a time
    hold out    predict random points that are not known, then evaluate them.  If all errors are within tolerance * range, the
                slice is done.  Otherwise the points with larger errors become nodes, the threshold is halved, and refinement
                goes on

The errors of the last hold-out are the interpolation error of the slice: its points were chosen at random and have not entered
the interpolant.  Hold-outs are drawn until one passes, so the k-th one uses the level 0.05 / 2^k: at most 5% of the slices
have a larger error than stated.  Decisions are made once a batch, so that the result does not depend on the number of workers.
"""

from dataclasses import dataclass
from math import ceil, inf
from time import monotonic

import numpy as np
import torch

from landscape.errors import InputError
from landscape.results import StopReason
from landscape.slices.grid_evaluations import GridEvaluations
from landscape.slices.sparse_grid import SparseGrid

SHARE_HELD_OUT = 1 / 8  # largest share of the unknown points in a hold-out, for small grids


@dataclass(frozen=True)
class SliceSettings:
    """Which points of a slice are evaluated; the others are interpolated.

    tolerance: of the interpolation, as a share of the range of the values; None: every point is evaluated.
    holdout: random points of a hold-out, at most an eighth of those not known.  If m points at the first look all meet the
        tolerance, at most 1 - 0.025^(1/m) of the other points do not, with 95% confidence over all looks: 12% for 30 points.
    batch: points between two decisions.  workers: threads that evaluate.
    max_evaluations, max_seconds: budgets, with hold-out points and the one at the centre; allowed only with a tolerance.  If a
        slice continues from a store, its evaluations count in total, but time counts from the call.
    """

    tolerance: float | None = 0.01
    holdout: int = 30
    batch: int = 32
    workers: int = 1
    max_evaluations: float = inf
    max_seconds: float = inf

    def __post_init__(self) -> None:
        if self.tolerance is not None and not 0 < self.tolerance < 1:
            raise InputError(f"expected a tolerance between 0 and 1, or None for every point, got {self.tolerance}")
        if min(self.holdout, self.batch, self.workers) < 1:
            raise InputError(
                f"expected holdout, batch and workers of at least 1, got {self.holdout}, {self.batch} and {self.workers}"
            )
        if not (self.max_evaluations >= 1 and self.max_seconds > 0):
            raise InputError(
                f"expected positive budgets, one evaluation or more, "
                f"got {self.max_evaluations} evaluations and {self.max_seconds} seconds"
            )
        if self.tolerance is None and (self.max_evaluations, self.max_seconds) != (inf, inf):
            raise InputError("expected no budget for a slice of every point, got one; give a tolerance")


def evaluate_adaptively(
    evaluations: GridEvaluations, x: np.ndarray, y: np.ndarray, settings: SliceSettings, generator: torch.Generator
) -> tuple[np.ndarray, np.ndarray, int, StopReason]:
    """Values at every point of x times y, |prediction - value| of the last hold-out, the number of looks, why it ended."""
    assert settings.tolerance is not None
    grid, budget = SparseGrid(x, y), _Budget(evaluations, settings)
    _insert(grid, evaluations, grid.coarse(), budget.room)
    look, threshold = 1, settings.tolerance
    while True:
        stopped = _refine(grid, evaluations, threshold, settings.batch, budget)
        cut = budget.left < budget.held_out
        drawn = _draw(evaluations.known, min(budget.held_out, budget.left), generator)
        predicted = grid.interpolant.ravel()[drawn]
        evaluations.require(drawn)
        errors = np.abs(predicted - evaluations.value[drawn])
        errors[~np.isfinite(errors)] = inf
        missed = drawn[errors > settings.tolerance * value_range(evaluations.value)]
        reason = (
            "exact" if evaluations.known.all() else stopped or (budget.spent if missed.size or cut else "tolerance")
        )
        if reason:
            values = np.where(evaluations.known, evaluations.value, grid.interpolant.ravel())
            return values, errors, look, reason
        look, threshold = look + 1, threshold / 2
        _insert(grid, evaluations, missed, budget.room)


def value_range(values: np.ndarray) -> float:
    """The largest difference between finite values; 0 where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if finite.size else 0.0


def _refine(
    grid: SparseGrid, evaluations: GridEvaluations, threshold: float, batch: int, budget: "_Budget"
) -> StopReason | None:
    """Insert points until no surplus exceeds the threshold (a share of the range).  Returns the budget that ended it."""
    while True:
        doubt = grid.doubt()
        doubtful = np.flatnonzero(doubt > threshold * value_range(evaluations.value))
        if not doubtful.size:
            return None
        if reason := budget.spent:
            return reason
        _insert(grid, evaluations, doubtful[np.argsort(-doubt[doubtful], kind="stable")][:batch], budget.room)


def _insert(grid: SparseGrid, evaluations: GridEvaluations, points: np.ndarray, room: int) -> None:
    """Make nodes of the points and their ancestors, at most `room` of them."""
    nodes = grid.with_ancestors(points)[:room]
    evaluations.require(nodes)
    grid.insert(nodes, evaluations.value[nodes])


def _draw(known: np.ndarray, size: int, generator: torch.Generator) -> np.ndarray:
    """Random points among those that are not known."""
    unknown = np.flatnonzero(~known)
    order = torch.randperm(len(unknown), generator=generator, device=generator.device)
    return unknown[order[:size].cpu().numpy()]


class _Budget:
    """The remaining budget of the refinement, after setting aside the next hold-out."""

    def __init__(self, evaluations: GridEvaluations, settings: SliceSettings):
        self._evaluations, self._settings, self._start = evaluations, settings, monotonic()

    @property
    def held_out(self) -> int:
        """Number of points of the next hold-out."""
        unknown = int((~self._evaluations.known).sum())
        return min(self._settings.holdout, ceil(SHARE_HELD_OUT * unknown))

    @property
    def left(self) -> int:
        """Remaining evaluations; the one at the centre is counted."""
        known = self._evaluations.known
        most = min(self._settings.max_evaluations, known.size + self._settings.holdout + 1)
        return max(int(most) - 1 - int(known.sum()), 0)

    @property
    def room(self) -> int:
        """Remaining evaluations of the refinement."""
        return max(self.left - self.held_out, 0)

    @property
    def spent(self) -> StopReason | None:
        """The budget that ends refinement.  It goes on only if there is room for a point and time for a whole batch."""
        if self.room == 0:
            return "evaluation budget"
        elapsed, made = monotonic() - self._start, self._evaluations.made  # points from a store take no time
        next_ones = self._settings.batch + self._settings.holdout
        return "time budget" if made and elapsed * (1 + next_ones / made) > self._settings.max_seconds else None
