"""Eigenpairs of one end of a spectrum, and of both, with residuals that bound their errors."""

from dataclasses import dataclass

from jaxtyping import Float, Float64
from torch import Tensor

from landscape.results import Number, StopReason, finite_or_none


@dataclass(frozen=True, eq=False)
class Eigenpairs:
    """k eigenpairs of one end of the spectrum, the outermost first.

    vectors: columns of unit length; of Lanczos with their largest entries positive.
    residuals: |H v - lambda v|.  Where the recurrence's own estimate of it plus a margin for the matvec's noise meets the goal,
        this sum (`krylov`); else measured by a last application of the operator.
    vector_errors: residual over the distance to the nearest other approximate eigenvalue, about the sine of the angle
        between v and the true eigenvector; infinite where that distance is not known.
    reason: why the search for this end stopped.
    """

    values: Float64[Tensor, " k"]
    vectors: Float[Tensor, "n k"]
    residuals: Float64[Tensor, " k"]
    vector_errors: Float64[Tensor, " k"]
    reason: StopReason

    def __len__(self) -> int:
        return self.values.numel()

    def interval(self, index: int = 0) -> tuple[float, float]:
        """[value - residual, value + residual] of the pair at this index: an eigenvalue of H lies in it."""
        value, residual = float(self.values[index]), float(self.residuals[index])
        return value - residual, value + residual

    def record(self, index: int = 0) -> dict[str, Number | str]:
        return {
            "value": finite_or_none(float(self.values[index])),
            "residual": finite_or_none(float(self.residuals[index])),
            "vector_error": finite_or_none(float(self.vector_errors[index])),
            "reason": self.reason,
        }


@dataclass(frozen=True, eq=False)
class EigenEnds:
    """Both ends of the spectrum.

    largest, smallest: by signed value; an end that was not asked for has no pairs.
    method: "lanczos" or "power iteration".  matvecs: products that both ends took together.
    beyond: with the probability 0.99 over the random start, no eigenvalue lies farther than this outside
        [smallest[0], largest[0]] (a worst-case bound over all spectra, far from sharp; infinite where there is none).
    noise: the length of the error (round-off and any other) of one matvec of a unit vector: measured where a residual asked for
        was near it; else estimated from how far products are from symmetric; nan where neither was possible.
    ritz: all approximate eigenvalues of the last basis, ascending, and below them estimates of their residuals; None where
        the method has no basis.
    """

    largest: Eigenpairs
    smallest: Eigenpairs
    method: str
    matvecs: int
    beyond: float
    noise: float
    ritz: Float64[Tensor, "2 m"] | None = None

    def record(self) -> dict[str, object]:
        return {
            "max": [self.largest.record(i) for i in range(len(self.largest))],
            "min": [self.smallest.record(i) for i in range(len(self.smallest))],
            "method": self.method,
            "matvecs": self.matvecs,
            "beyond": finite_or_none(self.beyond),
            "noise": finite_or_none(self.noise),
        }
