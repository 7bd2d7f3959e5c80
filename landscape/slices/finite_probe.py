"""Curvature along a direction v from values of the loss at finite steps d, next to the infinitesimal curvature v.H v.

    c(d) = (L(theta + d v) - 2 L(theta) + L(theta - d v)) / d^2  =  v.H v + d^2 L4 / 12 + ...       L4 = d^4 L / dv^4

round-off   4 sqrt(6 noise^2 + 2 (d s)^2) / d^2: four standard errors of a second difference of values with independent errors.
            d s with s = eps |theta * H v| / sqrt(12): the rounding of theta + d v, times the slope d H v there
confirmed   a step where c(d) is beyond its round-off, has the sign of v.H v, and is between half and twice it.  A curvature is
            confirmed by three such steps, each twice the one before: the curvature 2 |d| / d^2 of a kink at the
            centre is halved from one to the next, so that it never is
refuted     a step where no value within round-off of c(d) is between half and twice v.H v.  Round-off grows as d shrinks, by
            up to 1 / d^2, and hides the shortest steps of any loss.  These alone leave no curvature open: it is so only where
            no step of at least `least` is refuted, or where of three in a row some confirm and none is refuted
noise       standard deviation of the error of one value of L, from differences of order k = 4 of values at small even steps
            along v, in which the smooth part of L cancels: sigma^2 = (k!)^2 / (2k)! mean (Delta^k L)^2 (Hamming; More and
            Wild 2011, Sec. 2).  At least the resolution of the numbers that the objective returns (Python floats that are all
            float32 numbers count as float32)
control     a function that is cheap and follows L but for what is small and smooth: c(d) is its own, plus that of L less the
            control at every other step of the longest, CHECKED in all, between which it is interpolated.  Twice the largest
            of these is added to the round-off at the others
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import factorial, isfinite, sqrt
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_lengths
from landscape.operators.operator import SymmetricOperator, product
from landscape.results import Progress, ShortRepr, plain
from landscape.slices.grid_evaluations import Control, Loss

ORDER, NOISE_POINTS = 4, 24  # order of the differences, number of values
CLOSER = 4  # the distance between these values is the smallest step over this ...
ROUNDINGS = 4  # ... but at least this many round-offs of the parameters, so that each value is rounded differently
CHECKED = 4  # steps
WITHIN, RUN = 2.0, 3  # largest factor between c(d) and v.H v; consecutive steps that confirm
STEPS = tuple(10.0 ** (k / 2) for k in range(-10, 1))  # for curves: `confirmation` needs steps that double


@dataclass(frozen=True, eq=False, repr=False)
class FiniteProbe(ShortRepr):
    """The curvature c(d) at increasing steps d, in multiples of the direction, with its round-off.

    discontinuous: steps d for which +d or -d lies on another smooth piece than the centre; None where the objective does not
    name its pieces.  infinitesimal: v.H v, the limit of c(d) for small d.  noise: standard deviation of the error of one
    evaluation.  evaluations: of the objective.
    """

    steps: Float64[Tensor, " m"]
    curvatures: Float64[Tensor, " m"]
    round_off: Float64[Tensor, " m"]
    discontinuous: Bool[Tensor, " m"] | None
    infinitesimal: float
    center_loss: float
    noise: float
    evaluations: int

    def confirmation(self, least: float) -> tuple[bool | None, tuple[float, float] | None]:
        """Whether the loss confirms v.H v, and the ends of the last unbroken run of steps that do; steps must double.

        True where RUN consecutive steps, the longest of at least `least`, confirm it; None, open, where of RUN such steps some
        confirm and none refutes it, or no step of at least `least` refutes it; else False.
        """
        ratio, error = self.curvatures / self.infinitesimal, self.round_off / abs(self.infinitesimal)
        good = (ratio >= 1 / WITHIN) & (ratio < WITHIN) & (ratio > error)
        refuted = ~((ratio + error >= 1 / WITHIN) & (ratio - error < WITHIN))
        ends = [i for i in range(RUN - 1, len(ratio)) if self.steps[i] >= least]
        runs = [i for i in ends if good[i - RUN + 1 : i + 1].all()]
        if not runs:
            begun = (good[i - RUN + 1 : i + 1].any() and not refuted[i - RUN + 1 : i + 1].any() for i in ends)
            return (None if any(begun) or not refuted[self.steps >= least].any() else False), None
        first = last = runs[-1]
        while first and good[first - 1]:
            first -= 1
        return True, (float(self.steps[first]), float(self.steps[last]))

    def record(self) -> dict[str, Any]:
        crossed = None if self.discontinuous is None else self.discontinuous.tolist()
        names = "steps curvatures round_off infinitesimal center_loss noise evaluations"
        return plain(self, names) | {"crossed": crossed}


def finite_probe(
    loss: Loss,
    center: Float[Tensor, " n"],
    direction: Float[Tensor, " n"],
    operator: SymmetricOperator,
    steps: Sequence[float] = STEPS,
    progress: Progress | None = None,
    noise_points: int = NOISE_POINTS,
    control: Control | None = None,
) -> FiniteProbe:
    """Curvature along direction at finite steps, for one matvec and 2 len(steps) + 1 + noise_points evaluations.

    With a control, these are its own, and of loss there are 2 CHECKED + 1 at most; smooth pieces are not told apart.

    loss, center: as for `evaluate_slice`.  operator: H at center.  steps: two or more, increasing, in multiples of direction.
    noise_points: number of values for the estimate of the noise, more than four.

    >>> from landscape.operators.operator import DenseOperator
    >>> found = finite_probe(lambda x: (x**4).sum(), torch.ones(1, dtype=torch.float64), torch.ones(1),
    ...                      DenseOperator(torch.full((1, 1), 12.0, dtype=torch.float64)), [0.1, 1.0])
    >>> found.infinitesimal, found.curvatures
    (12.0, tensor([12.0200, 14.0000], dtype=torch.float64))
    """
    if len(steps) < 2 or not (steps[0] > 0 and all(a < b for a, b in pairwise(steps)) and isfinite(steps[-1])):
        raise ValueError(f"expected two or more positive steps that increase, got {tuple(steps)}")
    column_lengths(direction[:, None], "directions")
    origin, v = center.detach().double(), direction.detach().double()
    total = 2 * len(steps) + 1 + noise_points
    whole = at = _Line(loss, origin, v, center.dtype, total, progress)
    center_loss, here = middle, _ = at(0.0)
    if control is not None:
        at = _Line(control.loss, origin[control.rows], v[control.rows], center.dtype, total, progress)
        middle, here = at(0.0)[0], None
    if not isfinite(middle):
        raise InputError(f"expected a finite objective at the centre, got {middle}")
    # eps times the root mean square of theta_i / v_i with weights v_i^4: the step along v that rounding of theta makes
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
    round_off = 4 * (6 * noise**2 + 2 * (d * slope).square()).sqrt() / d.square()
    if control is not None:
        checked = torch.arange(len(steps) - 1, -1, -2)[:CHECKED].flip(0)
        rises = [sum(whole(sign * step)[0] - center_loss for sign in (1, -1)) for step in d[checked].tolist()]
        rest = torch.tensor(rises, dtype=torch.float64) / d[checked].square() - curvatures[checked]
        curvatures += torch.from_numpy(np.interp(np.arange(len(d)), checked.numpy(), rest.numpy()))
        round_off += 2 * rest.abs().max() * torch.ones_like(d).index_fill(0, checked, 0.0)
    return FiniteProbe(
        steps=d,
        curvatures=curvatures,
        round_off=round_off,
        discontinuous=None if here is None else other,
        infinitesimal=float(torch.dot(v, Hv)),
        center_loss=center_loss,
        noise=noise,
        evaluations=whole.done,
    )


class _Line:
    """The objective along the direction.  coarsest: the largest eps of the dtypes that it has returned so far."""

    def __init__(
        self, loss: Loss, origin: Tensor, v: Tensor, dtype: torch.dtype, total: int, progress: Progress | None
    ) -> None:
        self.loss, self.origin, self.v, self.dtype = loss, origin, v, dtype
        self.done, self.total, self.progress = 0, total, progress
        self.coarsest = torch.finfo(torch.float64).eps

    def __call__(self, step: float) -> tuple[float, object]:
        """Value and smooth piece at this step, in multiples of the direction."""
        found = self.loss((self.origin + step * self.v).to(self.dtype))
        value, piece = found if isinstance(found, tuple) else (found, None)
        if isinstance(value, Tensor) and value.is_floating_point():
            self.coarsest = max(self.coarsest, torch.finfo(value.dtype).eps)
        self.done += 1
        if self.progress:
            self.progress(self.done, self.total, "finite steps")
        return float(value), piece


def resolution(values: Sequence[float]) -> float:
    """The eps of float32 where the values are all float32 numbers and not all equal; else that of float64.

    >>> resolution([0.5, 0.1]) < resolution([0.5, 0.10000000149011612])
    True
    """
    exact = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore"):
        coarse = exact.astype(np.float32)
    single = np.array_equal(coarse, exact, equal_nan=True) and len(set(values)) > 1
    return float(np.finfo(np.float32 if single else np.float64).eps)


def evaluation_noise(values: Sequence[float]) -> float:
    """Standard deviation of the errors in values of a smooth function at even steps.

    >>> evaluation_noise([x**3 for x in range(8)])
    0.0
    """
    if len(values) <= ORDER:
        raise ValueError(f"expected more than {ORDER} values, got {len(values)}")
    differences = np.diff(np.asarray(values, dtype=np.float64), ORDER)
    return sqrt(factorial(ORDER) ** 2 / factorial(2 * ORDER) * float(np.mean(differences**2)))
