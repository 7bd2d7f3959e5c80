"""Where to evaluate a slice: points are added to a sparse grid until random points are predicted well.

    refine      all points whose parents' surplus exceeds the threshold, the largest first, `batch` at a time
    hold out    random points that are not known, predicted first and then evaluated.  If all are within tolerance * range,
                the grid is done; otherwise those that are not become nodes, the threshold is halved, and it refines again

The errors of the last hold-out are the slice's interpolation error: no point of it was chosen by the refinement, and none has
entered the interpolant.  As it is drawn anew until one passes, what it says is at the level 0.05 / 2^k at the k-th look: all
looks together are wrong in 5% of the slices at most.  Decisions are made once a batch, so that the result does not depend on
the number of workers.
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

SHARE_HELD_OUT = 1 / 8  # at most, of the points that are not known: small grids


@dataclass(frozen=True)
class SliceSettings:
    """Which points of a slice are evaluated; the others are interpolated.

    tolerance: of the interpolation, as a share of the range of the values; None: every point is evaluated.
    holdout: random points that judge the interpolation, at most an eighth of those not known.  (With 30, and none off by
        more than the tolerance at the first look, at most 12% of the points not evaluated are, with 95% confidence; with 5,
        52%.)
    batch: points that are added between two decisions.  workers: threads that evaluate.
    max_evaluations, max_seconds: budgets, hold-out points and the one at the centre included; ValueError without a tolerance,
        as a slice of every point has none.  A slice that continues from a store has its evaluations in total, but its time
        anew: a call takes at most so long.
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
    """Values at every point of x times y (true where known), |prediction - value| of the last hold-out, which look that was,
    why it ended."""
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
    """Insert until no surplus exceeds the threshold (as a share of the range); the budget that ended it before."""
    while True:
        doubt = grid.doubt()
        doubtful = np.flatnonzero(doubt > threshold * value_range(evaluations.value))
        if not doubtful.size:
            return None
        if reason := budget.spent:
            return reason
        _insert(grid, evaluations, doubtful[np.argsort(-doubt[doubtful], kind="stable")][:batch], budget.room)


def _insert(grid: SparseGrid, evaluations: GridEvaluations, points: np.ndarray, room: int) -> None:
    """Make nodes of the points and their ancestors, as far as there is room."""
    nodes = grid.with_ancestors(points)[:room]
    evaluations.require(nodes)
    grid.insert(nodes, evaluations.value[nodes])


def _draw(known: np.ndarray, size: int, generator: torch.Generator) -> np.ndarray:
    """Points that are not known, at random."""
    unknown = np.flatnonzero(~known)
    order = torch.randperm(len(unknown), generator=generator, device=generator.device)
    return unknown[order[:size].cpu().numpy()]


class _Budget:
    """What is left for refinement when the next hold-out is paid for."""

    def __init__(self, evaluations: GridEvaluations, settings: SliceSettings):
        self._evaluations, self._settings, self._start = evaluations, settings, monotonic()

    @property
    def held_out(self) -> int:
        """Points of a hold-out drawn now."""
        unknown = int((~self._evaluations.known).sum())
        return min(self._settings.holdout, ceil(SHARE_HELD_OUT * unknown))

    @property
    def left(self) -> int:
        """Evaluations; the one at the centre is counted."""
        known = self._evaluations.known
        most = min(self._settings.max_evaluations, known.size + self._settings.holdout + 1)
        return max(int(most) - 1 - int(known.sum()), 0)

    @property
    def room(self) -> int:
        """Evaluations of the refinement."""
        return max(self.left - self.held_out, 0)

    @property
    def spent(self) -> StopReason | None:
        """The budget that ends refinement, which goes on only where there is room and time for a whole batch."""
        if self.room == 0:
            return "evaluation budget"
        elapsed, made = monotonic() - self._start, self._evaluations.made  # what was stored took no time
        next_ones = self._settings.batch + self._settings.holdout
        return "time budget" if made and elapsed * (1 + next_ones / made) > self._settings.max_seconds else None
