"""Slices of an objective: its values on a grid of one or two directions, beside the quadratic model there.

    f(x)     = L(center + sum_d x_d e_d)              every point is a true evaluation
    model(x) = L + b . x + x^T A x / 2                b = E^T g,  A = E^T H E

x is in multiples of the directions as given: for unit eigenvectors, in parameter units.  `curvature_reach` gives ranges
in units of the curvature instead: where the quadratic along an eigenvector has risen by a given amount,
x = r sqrt(2 dL / |lambda|).
"""

from collections.abc import Callable, Hashable, Sequence
from math import isfinite, sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.operator import SymmetricOperator
from landscape.results import Progress, Slice


def symmetric_axis(radius: float, points: int = 41) -> Float64[Tensor, " points"]:
    """Evenly spaced from -radius to radius, with 0 itself among them.

    >>> symmetric_axis(1.0, 5)
    tensor([-1.0000, -0.5000,  0.0000,  0.5000,  1.0000], dtype=torch.float64)
    """
    if points < 3 or points % 2 == 0:
        raise ValueError(f"expected an odd number of points, 3 or more, got {points}")
    if not (radius > 0 and isfinite(radius)):
        raise ValueError(f"expected a finite radius above 0, got {radius}")
    half = points // 2
    return torch.arange(-half, half + 1, dtype=torch.float64) * (radius / half)


def curvature_reach(curvature: float, rise: float, multiple: float = 1.0) -> float:
    """multiple * sqrt(2 rise / |curvature|): at 1, the distance at which the quadratic has changed by rise.

    >>> curvature_reach(curvature=-8.0, rise=1.0)
    0.5
    """
    if curvature == 0 or not isfinite(curvature) or rise <= 0 or multiple <= 0:
        raise ValueError(
            f"expected a curvature that is not zero, rise > 0 and multiple > 0, got {curvature}, {rise} and {multiple};"
            " give the range in parameter units instead"
        )
    return multiple * sqrt(2 * rise / abs(curvature))


def evaluate_slice(
    loss: Callable[[Tensor], Tensor | float],
    center: Float[Tensor, " n"],
    directions: Float[Tensor, "n d"],
    coordinates: Sequence[Float64[Tensor, " _"]],
    gradient: Float[Tensor, " n"] | None = None,
    operator: SymmetricOperator | None = None,
    signature: Callable[[Tensor], Hashable] | None = None,
    progress: Progress | None = None,
) -> Slice:
    """loss on the grid coordinates[0] x coordinates[1] (d = 2) or along coordinates[0] (d = 1).

    Points are formed in float64 and rounded once to center's dtype.  With gradient and operator (at center) the
    quadratic model comes beside it, for d matvecs.  signature(theta) names the piece of a piecewise smooth objective:
    points whose signature differs from the centre's are marked.

    >>> line = evaluate_slice(lambda x: (x * x).sum(), torch.zeros(3), torch.eye(3)[:, :1], [symmetric_axis(2.0, 5)])
    >>> line.loss
    tensor([4., 1., 0., 1., 4.], dtype=torch.float64)
    """
    _require_slice(center, directions, coordinates)
    if (gradient is None) != (operator is None):
        raise ValueError("expected both gradient and operator for the quadratic model, or neither; got one of them")
    grid = torch.stack(torch.meshgrid(*coordinates, indexing="ij"), dim=-1).double()
    points = grid.reshape(-1, len(coordinates))
    origin, spans = center.detach().double(), directions.detach().double()
    center_loss = float(loss(center))
    if not isfinite(center_loss):
        raise ValueError(f"expected a finite objective at the centre, got {center_loss}")
    here = signature(center) if signature else None
    values, crossed = torch.empty(len(points), dtype=torch.float64), torch.zeros(len(points), dtype=torch.bool)
    for index, x in enumerate(points):
        theta = (origin + spans @ x).to(center.dtype)
        values[index] = float(loss(theta))
        if signature:
            crossed[index] = signature(theta) != here
        if progress:
            progress(index + 1, len(points), "slice")
    shape = grid.shape[:-1]
    slope = curvature = model = None
    if gradient is not None and operator is not None:
        slope = spans.T @ gradient.double()
        curvature = spans.T @ operator.apply(directions.to(operator.dtype)).double()
        curvature = (curvature + curvature.T) / 2
        model = center_loss + points @ slope + ((points @ curvature) * points).sum(dim=1) / 2
        model = model.reshape(shape)
    return Slice(
        coordinates=tuple(axis.double() for axis in coordinates),
        loss=values.reshape(shape),
        center_loss=center_loss,
        model=model,
        slope=slope,
        curvature=curvature,
        crossed=crossed.reshape(shape) if signature else None,
        evaluations=len(points) + 1,
    )


def _require_slice(center: Tensor, directions: Tensor, coordinates: Sequence[Tensor]) -> None:
    n = center.numel()
    if center.ndim != 1 or directions.ndim != 2 or directions.shape[0] != n or directions.shape[1] not in (1, 2):
        raise ValueError(
            f"expected a flat center (n,) and one or two directions (n, d), got {tuple(center.shape)} and "
            f"{tuple(directions.shape)}"
        )
    if len(coordinates) != directions.shape[1] or any(axis.ndim != 1 or axis.numel() == 0 for axis in coordinates):
        raise ValueError(
            f"expected one vector of coordinates per direction ({directions.shape[1]}), got shapes "
            f"{[tuple(axis.shape) for axis in coordinates]}"
        )
    lengths = torch.linalg.vector_norm(directions.double(), dim=0)
    if not ((lengths > 0) & torch.isfinite(lengths)).all():
        raise ValueError(f"expected finite directions that are not zero, got lengths {lengths.tolist()}")
