"""Choice of the points at which a slice is evaluated: both axes, then points that fill the plane until they predict the others.

    axes        every point: nothing is interpolated along a line, nor, without a control, along the two sections of a plane
    fill        the points farthest from all that are known: COARSE at first, then 3/4 as many as are known off the axes
    hold out    predict all points that are not known, then evaluate max(holdout, number filled) of them, at random: the more
                they are, the closer the bound is to the largest error.  If the bound is within tolerance * range, the slice is
                done, with these predictions; else fill again, and the interpolant has the points held out, too

bound: `interpolation.error_bound`, of the error at every point not known, from the errors at the points held out; the k-th
hold-out may err with a chance of 5% / 2^k.  range: largest less smallest of the values evaluated.

control: a cheap function that differs from the loss by little that is smooth.  It is refined first, in the same way, to 3/4 of
the tolerance.  Of the loss itself the centre and COARSE points are evaluated at first, and a third of a hold-out: the spline
through its differences from the control predicts the others, those of the axes, too.  Both bounds are added.

A slice keeps the interpolant that was judged.  Fitting it again with the points held out made it worse in 95% of the draws on
a fern's planes: some lie next to an axis, where its spline, divided by x y, magnifies jumps.  A plane whose bound is not
within the tolerance at max_evaluations is not resolved: its points are those that were evaluated.  Decisions are made when
a whole hold-out is evaluated, so that the result does not depend on the number of workers.
"""

from dataclasses import dataclass
from math import inf

import numpy as np
import torch

from landscape.errors import InputError
from landscape.results import StopReason
from landscape.slices.grid_evaluations import GridEvaluations
from landscape.slices.interpolation import PlaneInterpolant, error_bound

COARSE = 16  # points
CONTROLLED = 0.75  # share of the tolerance that a control is refined to


@dataclass(frozen=True)
class SliceSettings:
    """Rules for the points of a plane to evaluate; the others are interpolated.

    tolerance: of the interpolation, as a share of the range of the values; None: every point is evaluated.
    holdout: fewest random points of a hold-out, or all that are left.  Where the largest error at 64 of them is within the
        tolerance, at most 5.6% of the other points are not, with 97.5% confidence at the first hold-out; `error_bound`
        extrapolates to all.
    workers: threads that evaluate.
    max_evaluations: budget; counts the axes and once more the centre, always evaluated, and points of an earlier run.
        Allowed only with a tolerance.
    """

    tolerance: float | None = 0.01
    holdout: int = 64
    workers: int = 1
    max_evaluations: float = inf

    def __post_init__(self) -> None:
        if self.tolerance is not None and not 0 < self.tolerance < 1:
            raise InputError(f"expected a tolerance between 0 and 1, or None for every point, got {self.tolerance}")
        if min(self.holdout, self.workers) < 1:
            raise InputError(f"expected holdout and workers of at least 1, got {self.holdout} and {self.workers}")
        if not self.max_evaluations >= 1:
            raise InputError(f"expected a budget of one evaluation or more, got {self.max_evaluations}")
        if self.tolerance is None and self.max_evaluations != inf:
            raise InputError("expected no budget for a slice of every point, got one; give a tolerance")


@dataclass(frozen=True, eq=False)
class Refined:
    """Outcome of a refinement.

    values [points]: evaluated or interpolated, nan where neither.  holdout: |prediction - value| at the points of the last
    hold-out, none where every point was evaluated.  looks: number of hold-outs.  reason: why it ended.  bound: of the error at
    every point that was not evaluated.
    """

    values: np.ndarray
    holdout: np.ndarray
    looks: int
    reason: StopReason
    bound: float = 0.0


def evaluate_adaptively(
    evaluations: GridEvaluations,
    grid: PlaneInterpolant,
    settings: SliceSettings,
    generator: torch.Generator,
    control: tuple[GridEvaluations, Refined] | None = None,
) -> Refined:
    """Evaluate in rounds until the others are predicted within the tolerance, or all are known; `grid.required` in any case.

    A round that does not fit into max_evaluations is not begun.  control: evaluated and refined on the same grid.
    """
    assert settings.tolerance is not None
    fill, holdout = COARSE, settings.holdout if control is None else -(-settings.holdout // 3)
    seen, looks, bound = np.empty(0), 0, inf
    evaluations.require(grid.required)
    while not (known := evaluations.known).all():  # `require` sets entries of this array
        filling = grid.farthest(known, fill)
        drawn = _draw(known, filling, max(holdout, fill), generator)
        # 1: the loss at the centre, which is evaluated apart from the grid's points
        if 1 + int(known.sum()) + len(filling) + len(drawn) > settings.max_evaluations:
            return Refined(evaluations.value, seen, looks, "evaluation budget", bound)
        evaluations.require(filling)
        exact, beside, others = 0.0, 0.0, 0.0  # the control: evaluated, refined, and its bound
        if control is not None:
            control[0].require(np.append(np.flatnonzero(known), drawn).tolist())
            exact, beside, others = control[0].value, control[1].values, control[1].bound
        predicted = grid(evaluations.value - exact)
        evaluations.require(drawn)
        errors, looks = np.abs(predicted + exact - evaluations.value)[drawn], looks + 1
        seen = np.abs(predicted + beside - evaluations.value)[drawn]
        fill = 3 * int(known.sum() - len(grid.required)) // 4
        seen[~np.isfinite(seen)] = inf  # without a number no bound holds
        allowed = settings.tolerance * value_range(evaluations.value)
        bound = error_bound(errors, int((~known).sum()), looks) + others
        if bound <= allowed and not known.all():
            values = np.where(known, evaluations.value, predicted + beside)
            return Refined(values, seen, looks, "tolerance", bound)
    return Refined(evaluations.value, np.empty(0), looks, "exact")


def value_range(values: np.ndarray) -> float:
    """The largest difference between finite values; 0 where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if finite.size else 0.0


def _draw(known: np.ndarray, taken: np.ndarray, size: int, generator: torch.Generator) -> np.ndarray:
    """Random points among those that are neither known nor taken."""
    unknown = np.setdiff1d(np.flatnonzero(~known), taken)
    order = torch.randperm(len(unknown), generator=generator, device=generator.device)
    return unknown[order[:size].cpu().numpy()]
