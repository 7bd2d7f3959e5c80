"""Parts that all results share: intervals, reasons to stop, records for JSON.

Every estimator returns a frozen dataclass: each number with its error, and the reason why the run stopped.

    interval        [low, high], contains the truth with the probability `confidence`
    standard error  s / sqrt(m) of a mean over m probe vectors with the sample standard deviation s
    residual        |H v - lambda v| for a unit vector v: some eigenvalue of H is no farther than this from lambda
    reason          "tolerance" (the requested error is reached), "noise floor" (the remaining error is that of the matvec, so
                    more work would not help), "matvec budget", "evaluation budget", "exact" or "not asked for"

`record()` of a result gives its scalars as plain Python values for JSON, with None for what is infinite or undefined.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from math import erf, isfinite, nan, sqrt
from pathlib import Path
from textwrap import fill
from typing import Any, Literal, NamedTuple

import scipy
from jaxtyping import Float64
from torch import Tensor

StopReason = Literal["tolerance", "noise floor", "matvec budget", "evaluation budget", "exact", "not asked for"]
Sign = Literal["positive", "negative", "zero", "undetermined"]
Number = float | None
LINE, SHORT = 100, 60  # characters of a line, and of a list in it

Progress = Callable[[int, int, str], None]
"""progress(done, most, state): units of work done, the largest possible number of them, the estimate so far in words."""


def finite_or_none(value: float) -> Number:
    """A float that JSON can hold."""
    return float(value) if isfinite(value) else None


def plain(result: object, names: str) -> dict[str, Any]:
    """The named attributes of a result for JSON: tensors and tuples as lists, None for numbers that are not finite.

    >>> plain(Bracket(2.0, 1.0, float("inf")), "low high")
    {'low': 1.0, 'high': None}
    """
    return {name: _plain(getattr(result, name)) for name in names.split()}


def _plain(value: Any) -> Any:
    if isinstance(value, Tensor):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return finite_or_none(value) if isinstance(value, float) else value


class ShortRepr:
    """A dataclass, made with repr=False, that fits on three lines of a terminal: of large parts their kind and shape."""

    def __repr__(self) -> str:
        parts = [f"{each.name}={_brief(getattr(self, each.name))}" for each in fields(self) if each.repr]  # pyright: ignore[reportArgumentType]
        text = f"{type(self).__name__}({', '.join(parts)})"
        return fill(text, LINE, max_lines=3, placeholder=" ...", subsequent_indent="  ", break_on_hyphens=False)


def _brief(value: Any) -> str:
    """
    >>> import torch
    >>> _brief(torch.zeros(3, 4)), _brief([1, 2]), _brief(Bracket(2.0, 1.5, 3.0)), _brief(Path("runs"))
    ('float32 3 x 4', '[1, 2]', '2 in [1.5, 3]', "'runs'")
    """
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {' x '.join(map(str, value.shape)) or 'scalar'}"
    if isinstance(value, Bracket):
        return str(value)
    if isinstance(value, str | Path):
        return repr(str(value))
    if isinstance(value, list | tuple | dict):
        text = repr(value) if all(isinstance(item, str | int | float) for item in value) else ""
        return text if 0 < len(text) <= SHORT else f"{type(value).__name__} of {len(value)}"
    return repr(value) if value is None or isinstance(value, str | bool | int | float) else type(value).__name__


def t_quantile(freedom: float, confidence: float) -> float:
    """q with P(|t| <= q) = confidence, for Student's t with this many degrees of freedom.

    >>> round(t_quantile(9, 0.95), 3)
    2.262
    """
    return float(scipy.special.stdtrit(freedom, (1 + confidence) / 2))


def standard_deviation(samples: Float64[Tensor, "s *shape"]) -> Float64[Tensor, "*shape"]:
    """The standard deviation along the first axis; in units of the largest sample, as squares may leave the range of floats."""
    unit = float(samples.abs().max()) or 1.0
    return unit * (samples / unit).std(dim=0)


def sampling_error(terms: Float64[Tensor, " m"], population: int) -> Number:
    """Error of the mean of m terms, drawn at random from `population` terms, as an estimate of the mean of all.

    q s sqrt(1/m - 1/M), with the terms' standard deviation s, which errors of their own make larger; 0 where they are all,
    None of a single one.  q, 1 for many terms, is Student's factor: twice the error holds as often as two standard errors do.

    >>> import torch
    >>> terms = torch.tensor([1.0, 3.0], dtype=torch.float64)
    >>> sampling_error(terms, 2), round(sampling_error(terms, 4), 12), sampling_error(terms[:1], 4)
    (0.0, 4.938338370835, None)
    """
    m = len(terms)
    if m >= population:
        return 0.0
    if m < 2:
        return None
    student = t_quantile(m - 1, erf(sqrt(2))) / 2
    return student * float(standard_deviation(terms)) * sqrt(1 / m - 1 / population)


def mean_of_parts(draws: Float64[Tensor, "*k m s"]) -> tuple[Float64[Tensor, "*k"], Float64[Tensor, "*k"]]:
    """The mean over m parts of the means of s independent draws in each, and its error, as `sampling_error`'s: by the spread
    within the parts, by which they differ from one another is no error.

    >>> import torch
    >>> [round(float(x), 3) for x in mean_of_parts(torch.tensor([[1.0, 3.0], [7.0, 9.0]], dtype=torch.float64))]
    [5.0, 1.6]
    """
    m, s = draws.shape[-2:]
    student = t_quantile(m * (s - 1), erf(sqrt(2))) / 2
    return draws.mean(dim=(-2, -1)), student * (draws.var(dim=-1).mean(dim=-1) / (m * s)).sqrt()


class Measured(NamedTuple):
    """A number and its error: of `mean`, over draws (`sampling_error`), nan where a single one was drawn."""

    value: float
    error: float

    @classmethod
    def mean(cls, terms: Float64[Tensor, " m"]) -> "Measured":
        """The mean of independent draws."""
        error = sampling_error(terms, sys.maxsize)
        return cls(float(terms.mean()), nan if error is None else error)


@dataclass(frozen=True)
class Bracket:
    """A number derived from other results, and bounds [low, high] that carry their errors.

    value: None where the number is undefined or cannot be determined.  low, high: may be infinite.  note: the assumption or
    the limit behind the bounds, in a few words.
    """

    value: Number
    low: float
    high: float
    note: str = ""

    def record(self) -> dict[str, Number | str]:
        return plain(self, "value low high note")

    def __str__(self) -> str:
        if self.value is not None:
            return f"{self.value:.4g} in [{self.low:.4g}, {self.high:.4g}]" + (f" ({self.note})" if self.note else "")
        if not isfinite(self.low):
            return f"undefined: {self.note}"
        ends = f"in [{self.low:.4g}, {self.high:.4g}]" if isfinite(self.high) else f">= {self.low:.4g}"
        return f"{ends}: {self.note}"
