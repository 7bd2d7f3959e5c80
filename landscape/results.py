"""What the estimators return: frozen records, each number with its error and each run with the reason it stopped.

    interval        [low, high], the truth inside with the probability `confidence`
    standard error  of a mean over probe vectors: s / sqrt(probes)
    residual        |H v - lambda v| for a unit v: an eigenvalue lies within it of lambda, whatever v is
    reason          why the work ended: "tolerance" (the error asked for is reached), "noise floor" (more work would not
                    help: the error left is the matvec's own), "matvec budget", "evaluation budget", "time budget", "exact",
                    or "not asked for"

`record()` gives the scalars of a result as plain Python values for JSON; what is infinite or undefined is None there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import Literal

from jaxtyping import Float64
from scipy.special import stdtrit
from torch import Tensor

StopReason = Literal[
    "tolerance", "noise floor", "matvec budget", "evaluation budget", "time budget", "exact", "not asked for"
]
Sign = Literal["positive", "negative", "zero", "undetermined"]
Number = float | None

Progress = Callable[[int, int, str], None]
"""progress(done, most, state): units of work done, the most there can be, and a few words on the state of the estimate."""


def finite_or_none(value: float) -> Number:
    """A float that JSON can hold."""
    return float(value) if isfinite(value) else None


def t_quantile(freedom: float, confidence: float) -> float:
    """What Student's t of so many degrees of freedom stays within, on both sides, with this probability.

    >>> round(t_quantile(9, 0.95), 3)
    2.262
    """
    return float(stdtrit(freedom, (1 + confidence) / 2))


def standard_deviation(samples: Float64[Tensor, "s *shape"]) -> Float64[Tensor, "*shape"]:
    """Along the first axis; in units of the largest sample, as squares may leave the range of floats."""
    unit = float(samples.abs().max()) or 1.0
    return unit * (samples / unit).std(dim=0)


@dataclass(frozen=True)
class Bracket:
    """A number derived from other results, in [low, high], whose ends carry the errors of these results.

    value is None where the number is undefined or cannot be told; low and high may be infinite.  note: what limits it, or what
    the bracket rests on, in a few words.
    """

    value: Number
    low: float
    high: float
    note: str = ""

    def record(self) -> dict[str, Number | str]:
        value = None if self.value is None else finite_or_none(self.value)
        return {"value": value, "low": finite_or_none(self.low), "high": finite_or_none(self.high), "note": self.note}

    def __str__(self) -> str:
        if self.value is not None:
            return f"{self.value:.4g} in [{self.low:.4g}, {self.high:.4g}]" + (f" ({self.note})" if self.note else "")
        if not isfinite(self.low):
            return f"undefined: {self.note}"
        ends = f"in [{self.low:.4g}, {self.high:.4g}]" if isfinite(self.high) else f">= {self.low:.4g}"
        return f"{ends}: {self.note}"
