"""Result: the objective on a line or a plane, evaluated or interpolated, with its quadratic model."""

from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from torch import Tensor

from landscape.results import StopReason, plain


@dataclass(frozen=True, eq=False)
class Slice:
    """The objective on a grid center + sum_d x_d directions[:, d], d = 1 or 2.

    coordinates: increasing x_d of the grid, in multiples of the directions.
    loss: one axis for each direction (rows for coordinates[0], columns for coordinates[1]).  The objective at points that are
        `evaluated`, interpolated values elsewhere; nan there if the slice is not `resolved`.
    holdout: |prediction - objective| at the random points of the last hold-out; empty where none was drawn.
    tolerance: what was asked of the interpolation, as a share of the range; None: nothing is interpolated.
    model: center_loss + slope . x + x^T curvature x / 2, with the derivatives of the objective in x.  All three are None where
        neither gradient nor operator was given.
    discontinuous: evaluated points on another smooth piece than the centre (for a scene: another order of the splats or set of
        visible ones), so that the objective can jump on the way there.  False at points that are not evaluated; None for an
        objective that does not name its pieces.
    evaluations: of the objective, with the one at the centre.  looks: number of hold-outs drawn.  bound: of the error at every
        interpolated point (`interpolation`).
    """

    coordinates: tuple[Float64[Tensor, " _"], ...]
    loss: Float64[Tensor, "..."]
    evaluated: Bool[Tensor, "..."]
    holdout: Float64[Tensor, " m"]
    center_loss: float
    model: Float64[Tensor, "..."] | None
    slope: Float64[Tensor, " d"] | None
    curvature: Float64[Tensor, "d d"] | None
    discontinuous: Bool[Tensor, "..."] | None
    evaluations: int
    reason: StopReason
    tolerance: float | None = None
    looks: int = 0
    bound: float = 0.0

    @property
    def resolved(self) -> bool:
        """Whether every point is evaluated, or known to within the tolerance."""
        return self.reason in ("exact", "tolerance")

    def __repr__(self) -> str:
        shape, rendered = " x ".join(map(str, self.loss.shape)), int(self.evaluated.sum())
        return (
            f"slice of {shape} points around {self.center_loss:.6g}, values over a range of {self.range:.4g}\n"
            f"  {rendered:,} evaluated; error of the others {self.interpolation_error:.2g} of the range, "
            f"at {self.holdout.numel()} points\n"
            f"  {self.evaluations:,} evaluations; ended: {self.reason}"
        )

    @property
    def range(self) -> float:
        """The largest difference between finite values."""
        finite = self.loss[self.loss.isfinite()]
        return float(finite.max() - finite.min()) if finite.numel() else 0.0

    @property
    def error_seen(self) -> float:
        """The largest error of the hold-out over the range; 0 if every point is evaluated, infinite without a hold-out."""
        return self._relative(float(self.holdout.max()) if self.holdout.numel() else inf)

    @property
    def interpolation_error(self) -> float:
        """`bound` over the range."""
        return self._relative(self.bound)

    def _relative(self, error: float) -> float:
        if self.evaluated.all() or error == 0:
            return 0.0
        return error / self.range if self.range else inf

    def arrays(self) -> dict[str, np.ndarray]:
        """x, y: coordinates (n,); of each point the loss, the model, whether it was evaluated, and in another smooth piece."""
        known = dict(zip("xy", self.coordinates, strict=False))
        known |= {"loss": self.loss, "model": self.model, "crossed": self.discontinuous, "evaluated": self.evaluated}
        return {name: array.numpy() for name, array in known.items() if array is not None}

    def record(self) -> dict[str, Any]:
        return {
            "points": self.loss.numel(),
            "evaluated_points": int(self.evaluated.sum()),
            "crossed_points": 0 if self.discontinuous is None else int(self.discontinuous.sum()),
            "holdout_points": self.holdout.numel(),
        } | plain(self, "evaluations center_loss tolerance resolved interpolation_error error_seen reason")
