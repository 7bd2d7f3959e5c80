"""Curvature along a direction at finite steps, beside the infinitesimal one: what probing a loss at a distance d sees.

    c(d) = (L(theta + d v) - 2 L(theta) + L(theta - d v)) / d^2  =  v.H v + d^2 L4 / 12 + ...       L4 = d^4 L / dv^4

round-off   4 sqrt(6 noise^2 + 2 (d s)^2) / d^2: four standard errors of a second difference of values with independent errors.
            s = eps |theta * H v| / sqrt(12): away from theta the slope has grown by d H v, and theta + d v is rounded
truncation  |c(d) - v.H v| as far as neighbouring steps tell it: the term in d^2 that makes their c differ.  It says nothing
            across a kink, a jump or a crossed sort, where c(d) is no derivative at all but still what the probe sees
noise       standard deviation of L's own error, from differences of order k = 4 of values at close, even steps along v, in
            which the smooth part of L cancels: sigma^2 = (k!)^2 / (2k)! mean (Delta^k L)^2 (Hamming; More and Wild 2011,
            Sec. 2); at least the resolution of the numbers that the objective returns (Python floats that are all
            float32 numbers count as float32)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import factorial, isfinite, sqrt

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator, product
from landscape.results import Number, Progress, finite_or_none
from landscape.slices.grid_evaluations import Loss

ORDER, NOISE_POINTS = 4, 24  # of the differences; the values they are taken of
CLOSER = 4  # the values lie this many times closer together than the smallest step is long, ...
ROUNDINGS = 4  # ... but so many round-offs of the parameters apart, lest their rounding be the same
STEPS = tuple(10.0 ** (k / 2) for k in range(-10, 1))


@dataclass(frozen=True, eq=False)
class FiniteProbe:
    """The curvature c(d) at increasing steps d, in multiples of the direction, with its round-off and its truncation.

    infinitesimal: v.H v, which c(d) tends to for small d; crossed: where the signature at +d or -d is not the centre's (None:
    the objective has none); noise: the standard deviation of one evaluation's error; evaluations: of the objective.
    """

    steps: Float64[Tensor, " m"]
    curvatures: Float64[Tensor, " m"]
    round_off: Float64[Tensor, " m"]
    truncation: Float64[Tensor, " m"]
    crossed: Bool[Tensor, " m"] | None
    infinitesimal: float
    center_loss: float
    noise: float
    evaluations: int

    @property
    def best(self) -> int | None:
        """Index of the step, of those that cross nothing, whose round-off and truncation are least in sum; None without any."""
        error = (self.round_off + self.truncation).nan_to_num(torch.inf, posinf=torch.inf)
        if self.crossed is not None:
            error = error.masked_fill(self.crossed, torch.inf)
        return int(error.argmin()) if error.isfinite().any() else None

    def record(self) -> dict[str, Number | int | list[Number] | list[bool] | None]:
        columns = {
            name: [finite_or_none(value) for value in getattr(self, name).tolist()]
            for name in ("steps", "curvatures", "round_off", "truncation")
        }
        return {
            **columns,
            "crossed": None if self.crossed is None else self.crossed.tolist(),
            "infinitesimal": finite_or_none(self.infinitesimal),
            "center_loss": finite_or_none(self.center_loss),
            "noise": finite_or_none(self.noise),
            "best": self.best,
            "evaluations": self.evaluations,
        }


def finite_probe(
    loss: Loss,
    center: Float[Tensor, " n"],
    direction: Float[Tensor, " n"],
    operator: SymmetricOperator,
    steps: Sequence[float] = STEPS,
    progress: Progress | None = None,
    noise_points: int = NOISE_POINTS,
) -> FiniteProbe:
    """Probe along direction, for one matvec and 2 len(steps) + 1 + noise_points evaluations.

    loss, center: as for `evaluate_slice`; operator: H at center.  steps: two or more, increasing, in multiples of direction; by
    default 1e-5 to 1, two a decade.  noise_points: values that the noise is estimated from, more than four.

    >>> from landscape.operators.operator import DenseOperator
    >>> found = finite_probe(lambda x: (x**4).sum(), torch.ones(1, dtype=torch.float64), torch.ones(1),
    ...                      DenseOperator(torch.full((1, 1), 12.0, dtype=torch.float64)), [0.1, 1.0])
    >>> found.infinitesimal, found.curvatures, found.truncation
    (12.0, tensor([12.0200, 14.0000], dtype=torch.float64), tensor([0.0200, 2.0000], dtype=torch.float64))
    """
    _require_probe(center, direction, steps, noise_points)
    origin, v = center.detach().double(), direction.detach().double()
    total = 2 * len(steps) + 1 + noise_points
    at = _Line(loss, origin, v, center.dtype, total, progress)
    middle, here = at(0.0)
    if not isfinite(middle):
        raise InputError(f"expected a finite objective at the centre, got {middle}")
    # theta_i / v_i, weighted by v_i^4: of the parameters that make up the direction
    rounding = torch.finfo(center.dtype).eps * float((origin * v).norm() / v.square().norm())
    spacing = max(steps[0] / CLOSER, ROUNDINGS * rounding)
    close = [at((k - (noise_points - 1) / 2) * spacing)[0] for k in range(noise_points)]
    ends = [(at(step), at(-step)) for step in steps]
    seen = [middle, *close, *(value for pair in ends for value, _ in pair)]
    noise = max(evaluation_noise(close), max(at.coarsest, resolution(seen)) * abs(middle))
    d = torch.tensor(steps, dtype=torch.float64)
    rises = torch.tensor([(ahead[0] - middle) + (behind[0] - middle) for ahead, behind in ends], dtype=torch.float64)
    other = torch.tensor([ahead[1] != here or behind[1] != here for ahead, behind in ends])
    curvatures = rises / d.square()
    Hv = product(operator, direction.to(operator.dtype)[:, None])[:, 0].double()
    slope = torch.finfo(center.dtype).eps * float((origin * Hv).norm()) / sqrt(12)
    return FiniteProbe(
        steps=d,
        curvatures=curvatures,
        round_off=4 * (6 * noise**2 + 2 * (d * slope).square()).sqrt() / d.square(),
        truncation=_truncation(d, curvatures),
        crossed=None if here is None else other,
        infinitesimal=float(torch.dot(v, Hv)),
        center_loss=middle,
        noise=noise,
        evaluations=total,
    )


class _Line:
    """The objective along the direction.  coarsest: the largest eps of the numbers that it has returned so far."""

    def __init__(
        self, loss: Loss, origin: Tensor, v: Tensor, dtype: torch.dtype, total: int, progress: Progress | None
    ) -> None:
        self.loss, self.origin, self.v, self.dtype = loss, origin, v, dtype
        self.done, self.total, self.progress = 0, total, progress
        self.coarsest = torch.finfo(torch.float64).eps

    def __call__(self, step: float) -> tuple[float, object]:
        """Value and signature at this step, in multiples of the direction."""
        found = self.loss((self.origin + step * self.v).to(self.dtype))
        value, signature = found if isinstance(found, tuple) else (found, None)
        if isinstance(value, Tensor) and value.is_floating_point():
            self.coarsest = max(self.coarsest, torch.finfo(value.dtype).eps)
        self.done += 1
        if self.progress:
            self.progress(self.done, self.total, "finite steps")
        return float(value), signature


def resolution(values: Sequence[float]) -> float:
    """The eps of float32 where values that differ are all float32 numbers; else that of float64.

    >>> resolution([0.5, 0.1]) < resolution([0.5, 0.10000000149011612])
    True
    """
    exact = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore"):
        coarse = exact.astype(np.float32)
    single = np.array_equal(coarse, exact, equal_nan=True) and len(set(values)) > 1
    return float(np.finfo(np.float32 if single else np.float64).eps)


def evaluation_noise(values: Sequence[float]) -> float:
    """The standard deviation of the errors of values of a smooth function at even steps.

    >>> evaluation_noise([x**3 for x in range(8)])
    0.0
    """
    if len(values) <= ORDER:
        raise ValueError(f"expected more than {ORDER} values, got {len(values)}")
    differences = np.diff(np.asarray(values, dtype=np.float64), ORDER)
    return sqrt(factorial(ORDER) ** 2 / factorial(2 * ORDER) * float(np.mean(differences**2)))


def _truncation(steps: Tensor, curvatures: Tensor) -> Tensor:
    """|a| d^2 of the parabola in d through c at each step and the next larger one (for the last, the one before)."""
    squares = steps.square()
    slopes = (curvatures.diff() / squares.diff()).abs()
    return torch.cat([slopes, slopes[-1:]]) * squares


def _require_probe(center: Tensor, direction: Tensor, steps: Sequence[float], noise_points: int) -> None:
    if noise_points <= ORDER:
        raise ValueError(f"expected more than {ORDER} noise points, got {noise_points}")
    if center.ndim != 1 or center.shape != direction.shape:
        raise ValueError(
            f"expected a flat center and a direction of its length, got {tuple(center.shape)} and {tuple(direction.shape)}"
        )
    if not (torch.isfinite(direction).all() and direction.any()):
        raise ValueError("expected a finite direction that is not zero, got another")
    increasing = all(a < b for a, b in pairwise(steps))
    if len(steps) < 2 or not (increasing and steps[0] > 0 and isfinite(steps[-1])):
        raise ValueError(f"expected two or more positive steps that increase, got {tuple(steps)}")
