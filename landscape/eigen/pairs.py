"""Results: eigenpairs of one end of a spectrum, and of both ends, with residuals that bound their errors."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float, Float64
from torch import Tensor

from landscape.results import Number, StopReason, finite_or_none


@dataclass(frozen=True, eq=False)
class Eigenpairs:
    """k eigenpairs of one end of the spectrum, the outermost first.

    vectors: columns of unit length.  Lanczos makes their largest entries positive.
    residuals: |H v - lambda v|, from the recurrence plus a margin for noise, or from further products (`krylov`).
    vector_errors: residual over the distance to the nearest other approximate eigenvalue, about the sine of the angle between v
        and the true eigenvector; infinite where that distance is not known.
    reason: why the search for this end stopped.
    """

    values: Float64[Tensor, " k"]
    vectors: Float[Tensor, "n k"]
    residuals: Float64[Tensor, " k"]
    vector_errors: Float64[Tensor, " k"]
    reason: StopReason

    def __len__(self) -> int:
        return self.values.numel()

    def __repr__(self) -> str:
        pairs = zip(self.values.tolist(), self.residuals.tolist(), strict=True)
        return f"{', '.join(f'{value:.6g} ± {residual:.1g}' for value, residual in pairs) or 'none'} ({self.reason})"

    def interval(self, index: int = 0) -> tuple[float, float]:
        """[value - residual, value + residual] of the pair at this index.  It contains an eigenvalue of H."""
        value, residual = float(self.values[index]), float(self.residuals[index])
        return value - residual, value + residual

    def columns(self, name: str) -> dict[str, Any]:
        """Of the outermost pair, as `TraceEstimate.columns`."""
        return {name: float(self.values[0]), f"{name}_error": float(self.residuals[0]), f"{name}_reason": self.reason}

    def record(self, index: int = 0) -> dict[str, Number | str]:
        value, residual = (finite_or_none(float(column[index])) for column in (self.values, self.residuals))
        return {"value": value, "residual": residual, "reason": self.reason}


@dataclass(frozen=True, eq=False)
class EigenEnds:
    """Both ends of the spectrum.

    largest, smallest: by signed value; an end that was not asked for has no pairs.
    method: "lanczos" or "power iteration".  matvecs: products used for both ends together.
    beyond: no eigenvalue lies farther than this outside [smallest[0], largest[0]], with probability 0.99 over the random start.
        A worst-case bound over all spectra, far from sharp; infinite where there is none.
    noise: length of the error (round-off or other) of H v for a unit vector v: measured by a product if a residual came near
        it, else estimated from the asymmetry of products, else nan.
    further: pairs next to those of either end, with the residuals that the search left them; None where not asked for.
    ritz: first row: all approximate eigenvalues of the last basis, ascending; second row: estimates of their residuals.  None
        for a method without a basis.
    """

    largest: Eigenpairs
    smallest: Eigenpairs
    method: str
    matvecs: int
    beyond: float
    noise: float
    ritz: Float64[Tensor, "2 m"] | None = None
    further: tuple[Eigenpairs, Eigenpairs] | None = None

    def __repr__(self) -> str:
        return f"largest   {self.largest!r}\nsmallest  {self.smallest!r}\n  by {self.method}, {self.matvecs} products"
