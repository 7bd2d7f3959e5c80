"""The estimate of a trace: value, standard error, and an interval that contains the trace."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.results import Number, Sign, StopReason, plain, sampling_error


@dataclass(frozen=True, eq=False)
class TraceEstimate:
    """The trace of one block of H.

    block, dim: its name and number of rows.  low, high: an interval that contains the trace with probability `confidence`.
    samples: one for each of `probes` random vectors, in order; value is their mean, standard_error the error of the mean.  With
    the method "exact" there are none.  matvecs: products used; blocks that are read from the same products each count them all.
    method: "hutchinson", "hutch++", "xtrace", "exact" (`landscape.traces.trace`), "pixels" (`pixels`) or words.  terms: where H
    is the mean of several operators whose traces are known apart, the estimate of each.
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
    terms: Float64[Tensor, " m"] | None = None

    @classmethod
    def exact(
        cls,
        block: str,
        dim: int,
        value: float,
        confidence: float,
        matvecs: int = 0,
        terms: Float64[Tensor, " m"] | None = None,
    ) -> "TraceEstimate":
        """A trace without error: nothing of it was sampled."""
        none = torch.zeros(0, dtype=torch.float64)
        return cls(block, dim, value, 0.0, value, value, confidence, 0, matvecs, "exact", none, "exact", terms)

    def __repr__(self) -> str:
        return (
            f"trace of {self.block} ({self.dim:,} rows): {self.value:.6g} ± {self.standard_error:.2g}, {self.sign}\n"
            f"  {self.confidence:.0%} in [{self.low:.6g}, {self.high:.6g}]\n"
            f"  {self.method}, {self.probes} vectors, {self.matvecs} products; ended: {self.reason}"
        )

    def left_out(self, population: int) -> Number:
        """The standard error of taking the mean over `population` operators from these terms; None where that is not known."""
        return None if self.terms is None else sampling_error(self.terms, population)

    @property
    def half_width(self) -> float:
        """Half the length of the interval."""
        return (self.high - self.low) / 2

    @property
    def sign(self) -> Sign:
        """The sign of the trace if the interval decides it ("zero" for exactly 0), else "undetermined"."""
        if self.low == self.high == 0:
            return "zero"
        if self.low > 0:
            return "positive"
        return "negative" if self.high < 0 else "undetermined"

    def columns(self, name: str) -> dict[str, Any]:
        """Columns of a table with a row for each step of a training: NAME, NAME_error, ..."""
        numbers = {"": self.value, "_error": self.standard_error, "_low": self.low, "_high": self.high}
        return {f"{name}{key}": each for key, each in (numbers | {"_dim": self.dim, "_reason": self.reason}).items()}

    def record(self) -> dict[str, Any]:
        return plain(self, "value standard_error low high confidence sign dim probes matvecs reason method")
