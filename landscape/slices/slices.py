"""Slices of an objective L: its values on a grid along one or two directions e_d, and its quadratic model.

    f(x)     = L(center + sum_d x_d e_d)              evaluated where needed (`refinement`), interpolated elsewhere
    model(x) = L + b . x + x^T A x / 2                b = E^T g,  A = E^T H E

x is in multiples of the directions: for unit vectors in units of the parameters.  `curvature_reach` gives ranges in units of
the curvature instead: the distance r sqrt(2 dL / |lambda|), at which the quadratic term along an eigenvector is r^2 dL.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, isfinite, sqrt

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_lengths
from landscape.operators.operator import SymmetricOperator, product
from landscape.results import Progress
from landscape.slices.grid_evaluations import Control, GridEvaluations, Loss, Store
from landscape.slices.interpolation import PlaneInterpolant
from landscape.slices.refinement import CONTROLLED, Refined, SliceSettings, evaluate_adaptively
from landscape.slices.slice import Slice


def symmetric_axis(radius: float, points: int = 41) -> Float64[Tensor, " points"]:
    """Evenly spaced coordinates from -radius to radius that contain 0 exactly.  points: odd, 3 or more.

    >>> symmetric_axis(1.0, 5)
    tensor([-1.0000, -0.5000,  0.0000,  0.5000,  1.0000], dtype=torch.float64)
    """
    if points < 3 or points % 2 == 0:
        raise InputError(f"expected an odd number of points, 3 or more, got {points}")
    if not (radius > 0 and isfinite(radius)):
        raise InputError(f"expected a finite radius above 0, got {radius}")
    half = points // 2
    return torch.arange(-half, half + 1, dtype=torch.float64) * (radius / half)


def curvature_reach(curvature: float, rise: float, multiple: float = 1.0) -> float:
    """multiple * sqrt(2 rise / |curvature|).  With multiple = 1: the distance at which the quadratic term equals rise.

    For a unit direction: curvature in loss per squared unit of the parameters, rise in loss, the result in these units.
    Raises InputError where the curvature is 0 or not finite, or rise or multiple is not positive.

    >>> curvature_reach(curvature=-8.0, rise=1.0)
    0.5
    """
    if curvature == 0 or not isfinite(curvature) or rise <= 0 or multiple <= 0:
        raise InputError(
            f"expected a curvature that is not zero, rise > 0 and multiple > 0, got {curvature}, {rise} and {multiple};"
            " give the range in units of the parameters instead"
        )
    return multiple * sqrt(2 * rise / abs(curvature))


def evaluate_slice(
    loss: Loss,
    center: Float[Tensor, " n"],
    directions: Float[Tensor, "n d"],
    coordinates: Sequence[Float64[Tensor, " _"]],
    gradient: Float[Tensor, " n"] | None = None,
    operator: SymmetricOperator | Float64[Tensor, "d d"] | None = None,
    settings: SliceSettings = SliceSettings(),
    generator: torch.Generator | None = None,
    store: Store | None = None,
    progress: Progress | None = None,
    control: Control | None = None,
) -> Slice:
    """loss on the grid coordinates[0] x coordinates[1] (d = 2) or along coordinates[0] (d = 1).

    loss(theta): the objective, or (objective, smooth_piece) if it is piecewise smooth (`grid_evaluations`); it is called from
    settings.workers threads.  coordinates: increasing, in multiples of the directions.  gradient, operator: both at center, for
    the quadratic model, or neither; the model takes d matvecs, or none if the operator is given as the matrix E^T H E.
    settings: for a plane; every point of a line is evaluated.  generator: draws the hold-out points (`refinement`) of a plane;
    may be None only if settings.tolerance is.  store: keeps evaluations, from which an interrupted run continues.  control: of
    loss; a plane then takes few evaluations of loss itself (`refinement`).
    Raises InputError if the objective at the centre is not finite.

    >>> axis, generator = symmetric_axis(2.0, 41), torch.Generator().manual_seed(0)
    >>> bowl = evaluate_slice(lambda x: (x * x).sum(), torch.zeros(3), torch.eye(3)[:, :2], [axis, axis], generator=generator)
    >>> bowl.loss[20, ::10], bowl.loss.shape, int(bowl.evaluated.sum()), bowl.reason
    (tensor([4., 1., 0., 1., 4.], dtype=torch.float64), torch.Size([41, 41]), 161, 'tolerance')
    """
    if not all(axis.isfinite().all() and (axis.diff() > 0).all() for axis in coordinates):
        raise ValueError("expected finite coordinates that increase, got others; sort them and drop repeated ones")
    if (gradient is None) != (operator is None):
        raise ValueError("expected both gradient and operator for the quadratic model, or neither; got one of them")
    column_lengths(directions, "directions")
    _require_refinable(coordinates, settings, generator)
    axes = [axis.detach().double() for axis in coordinates]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    shape, points = grid.shape[:-1], grid.reshape(-1, len(axes))
    found = GridEvaluations(loss, center, directions, points, settings.workers, store, progress)
    slope = curvature = model = None
    if gradient is not None and operator is not None:
        slope, curvature = _derivatives(gradient, operator, directions)
        model = found.center_loss + points @ slope + ((points @ curvature) * points).sum(dim=1) / 2
        model = model.reshape(shape)
    cheap = None
    if control is not None and settings.tolerance is not None and len(axes) == 2:
        some = center[control.rows], directions[control.rows]
        cheap = GridEvaluations(control.loss, *some, points, settings.workers, progress=progress)
    mixed = None if curvature is None or cheap else float(curvature[0, -1])
    refined = _refined(found, axes, mixed, settings, generator, cheap)
    return Slice(
        coordinates=tuple(axes),
        loss=torch.from_numpy(refined.values).reshape(shape),
        evaluated=torch.from_numpy(found.known).reshape(shape),
        holdout=torch.from_numpy(refined.holdout),
        center_loss=found.center_loss,
        model=model,
        slope=slope,
        curvature=curvature,
        discontinuous=torch.from_numpy(found.discontinuous).reshape(shape) if found.has_pieces else None,
        evaluations=int(found.known.sum()) + 1,
        reason=refined.reason,
        tolerance=None if found.known.all() else settings.tolerance,
        looks=refined.looks,
        bound=refined.bound,
    )


def _refined(
    found: GridEvaluations,
    axes: Sequence[Float64[Tensor, " _"]],
    mixed: float | None,
    settings: SliceSettings,
    generator: torch.Generator | None,
    cheap: GridEvaluations | None,
) -> Refined:
    """Every point of a line evaluated; a plane refined adaptively.  mixed: the model's mixed derivative, for a plane.

    cheap: of the control.
    """
    if len(axes) == 1 or settings.tolerance is None or generator is None:
        found.require(range(len(found.value)))
        return Refined(found.value, np.empty(0), 0, "exact")
    x, y = (axis.numpy() for axis in axes)
    plane = PlaneInterpolant(x, y, mixed)
    if cheap is None:
        return evaluate_adaptively(found, plane, settings, generator)
    tighter = replace(settings, tolerance=CONTROLLED * settings.tolerance, max_evaluations=inf)
    control = cheap, evaluate_adaptively(cheap, plane, tighter, generator)
    return evaluate_adaptively(found, PlaneInterpolant(x, y, through_axes=False), settings, generator, control)


def _derivatives(
    gradient: Tensor, operator: SymmetricOperator | Float64[Tensor, "d d"], directions: Tensor
) -> tuple[Tensor, Tensor]:
    """b and A of the model, on the CPU."""
    spans = directions.detach().double()
    slope = (spans.T @ gradient.double()).cpu()
    if isinstance(operator, Tensor):
        return slope, operator.double().cpu()
    curvature = (spans.T @ product(operator, directions.to(operator.dtype)).double()).cpu()
    return slope, (curvature + curvature.T) / 2


def _require_refinable(
    coordinates: Sequence[Tensor], settings: SliceSettings, generator: torch.Generator | None
) -> None:
    """Raise unless a plane that is to be refined has what that takes: random numbers, and axes through the centre."""
    if len(coordinates) == 1 or settings.tolerance is None:
        return
    if generator is None:
        raise ValueError(
            "expected a generator for the hold-out points of a plane, got none; "
            "pass torch.Generator().manual_seed(0), or SliceSettings(tolerance=None) to evaluate every point"
        )
    if not all((axis == 0).any() for axis in coordinates):
        raise InputError(
            "expected coordinates of a plane with 0 among them, for the axes through the centre, got others; "
            "take symmetric_axis, or SliceSettings(tolerance=None) to evaluate every point"
        )
