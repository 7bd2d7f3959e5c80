"""The objective on a line or a plane: rendered and interpolated values beside the quadratic model."""

from dataclasses import dataclass
from math import inf

from jaxtyping import Bool, Float64
from torch import Tensor

from landscape.results import Number, StopReason, finite_or_none


@dataclass(frozen=True, eq=False)
class Slice:
    """The objective on a grid center + sum_d x_d directions[:, d], d = 1 or 2, beside its quadratic model.

    coordinates: increasing x_d of the grid, in multiples of the directions.
    loss has one axis per direction (rows follow coordinates[0], columns coordinates[1]): the objective itself at points that
    are `evaluated`, interpolated elsewhere.  holdout: |prediction - objective| at the random points of the last hold-out, which
    tells how good the interpolation is; empty where none was drawn.
    model: center_loss + slope . x + x^T curvature x / 2, with slope and curvature the derivatives of the objective in x; the
    three are None where neither gradient nor operator was given.  crossed marks evaluated points whose signature (order of
    sorting, visible set) differs from the centre's, so that the objective may jump on the way there; at points that are not
    evaluated it is False and nothing is known.  evaluations: of the objective, the centre's too.
    looks: hold-outs that were drawn, one after the other, until one was good enough or a budget ended it.
    """

    coordinates: tuple[Float64[Tensor, " _"], ...]
    loss: Float64[Tensor, "..."]
    evaluated: Bool[Tensor, "..."]
    holdout: Float64[Tensor, " m"]
    center_loss: float
    model: Float64[Tensor, "..."] | None
    slope: Float64[Tensor, " d"] | None
    curvature: Float64[Tensor, "d d"] | None
    crossed: Bool[Tensor, "..."] | None
    evaluations: int
    reason: StopReason
    looks: int = 1

    @property
    def difference(self) -> Float64[Tensor, "..."] | None:
        """Objective minus quadratic model."""
        return None if self.model is None else self.loss - self.model

    @property
    def range(self) -> float:
        """The largest difference between finite evaluated values."""
        finite = self.loss[self.evaluated & self.loss.isfinite()]
        return float(finite.max() - finite.min()) if finite.numel() else 0.0

    @property
    def interpolation_error(self) -> float:
        """The largest error of the hold-out as a share of the range; 0 where every point is evaluated, infinite without any."""
        if self.evaluated.all():
            return 0.0
        if not self.holdout.numel():
            return inf
        if not self.holdout.any():
            return 0.0
        return float(self.holdout.max()) / self.range if self.range else inf

    @property
    def share_beyond(self) -> float:
        """With 95% confidence, at most this share of the interpolated points is off by more than interpolation_error.

        If a share p were, a hold-out of m random points would miss all of them with the probability (1 - p)^m at most.  p is
        where that is 0.05 / 2^k at the k-th look: with many looks it is likelier that one of them is lucky.
        """
        if self.evaluated.all():
            return 0.0
        return 1 - (0.05 / 2**self.looks) ** (1 / self.holdout.numel()) if self.holdout.numel() else 1.0

    def record(self) -> dict[str, Number | int | str]:
        return {
            "points": self.loss.numel(),
            "evaluated_points": int(self.evaluated.sum()),
            "crossed_points": 0 if self.crossed is None else int(self.crossed.sum()),
            "evaluations": self.evaluations,
            "center_loss": self.center_loss,
            "interpolation_error": finite_or_none(self.interpolation_error),
            "holdout_points": self.holdout.numel(),
            "share_beyond": self.share_beyond,
            "reason": self.reason,
        }
