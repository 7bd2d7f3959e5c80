"""The estimate of a trace: its value, its standard error, and the interval in which the trace lies."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.results import Number, Sign, StopReason, finite_or_none


@dataclass(frozen=True, eq=False)
class TraceEstimate:
    """The trace of one block of H.

    block, dim: its name and number of rows.  low, high: the interval in which the trace lies with the probability `confidence`.
    samples: one for each of `probes` random vectors, in order; value is their mean, standard_error its error.  Both are empty
    or 0 where method is "exact".  matvecs: products with H that it took; blocks that were read from the same products each
    count them all.  method: "hutchinson", "hutch++", "xtrace" or "exact" (`landscape.traces.trace`).
    """

    block: str
    dim: int
    value: float
    standard_error: float
    low: float
    high: float
    confidence: float
    probes: int
    matvecs: int
    reason: StopReason
    samples: Float64[Tensor, " probes"]
    method: str = "hutchinson"

    @classmethod
    def exact(cls, block: str, dim: int, value: float, confidence: float, matvecs: int = 0) -> "TraceEstimate":
        """A trace without error: no part of it was sampled."""
        none = torch.zeros(0, dtype=torch.float64)
        return cls(block, dim, value, 0.0, value, value, confidence, 0, matvecs, "exact", none, "exact")

    @property
    def half_width(self) -> float:
        """Half the interval's length."""
        return (self.high - self.low) / 2

    @property
    def sign(self) -> Sign:
        """The sign of the trace where the interval decides it ("zero": it is exactly 0), else "undetermined"."""
        if self.low == self.high == 0:
            return "zero"
        if self.low > 0:
            return "positive"
        return "negative" if self.high < 0 else "undetermined"

    def record(self) -> dict[str, Number | int | str]:
        return {
            "value": finite_or_none(self.value),
            "standard_error": finite_or_none(self.standard_error),
            "low": finite_or_none(self.low),
            "high": finite_or_none(self.high),
            "confidence": self.confidence,
            "sign": self.sign,
            "dim": self.dim,
            "probes": self.probes,
            "matvecs": self.matvecs,
            "reason": self.reason,
            "method": self.method,
        }
