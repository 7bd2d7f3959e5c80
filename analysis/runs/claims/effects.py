"""Effects of a study's methods, their intervals over seeds, and the verdict that an interval allows.

An effect is an average over trainings, or over pairs of a scene and a seed that both methods have, with Student's 95% interval;
ratios are averaged as logarithms, a cell that was trained on
several machines counts once.  The verdict compares the interval with no effect and with the size that the paper states:

    interval                                  verdict
    beyond no effect, reaches the size        holds
    beyond no effect, falls short of it       holds in part
    falls short of the size, else             does not hold
    holds no effect and the size              cannot be tested here: the seeds do not decide
    fewer than three trainings or pairs       cannot be tested here
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from scipy import stats

from analysis.records.quantities import quantity

Verdict = Literal["holds", "holds in part", "does not hold", "cannot be tested here"]
LEAST, CONFIDENCE = 3, 0.95
BASE, STABLE = "3dgs", "stablegs"
SCORE = "psnr"
STRETCHED = ("quats", "log_scales")  # what needles are said to dominate
PAIR = ("scene", "seed")
SURROUNDINGS = ("machine", "threads")  # without which times do not compare


@dataclass(frozen=True)
class Interval:
    """A mean over n trainings or pairs, and its 95% interval; unbounded for n below 2."""

    value: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, values: Sequence[float] | pd.Series) -> "Interval":
        """Of the values that are finite.

        >>> Interval.of([1.0, 2.0, 3.0])
        Interval(value=2.0, low=-0.484..., high=4.484..., n=3)
        """
        known = np.asarray(values, float)
        known = known[np.isfinite(known)]
        n = len(known)
        if n < 2:
            return cls(float(known.mean()) if n else np.nan, -np.inf, np.inf, n)
        half = float(stats.t.ppf((1 + CONFIDENCE) / 2, n - 1) * known.std(ddof=1) / np.sqrt(n))
        return cls(float(known.mean()), float(known.mean()) - half, float(known.mean()) + half, n)

    def exp(self) -> "Interval":
        """Of a ratio, from that of its logarithm."""
        value, low, high = (float(np.exp(x)) for x in (self.value, self.low, self.high))
        return Interval(value, low, high, self.n)

    def text(self, unit: str = "") -> str:
        """In words.

        >>> Interval(1.5, 1.0, 2.0, 3).text(" dB")
        '1.50 dB (1.00 to 2.00; n = 3)'
        """
        if self.n < 2:
            return f"{quantity(self.value)}{unit} (n = 1)" if self.n else "not measured"
        return f"{quantity(self.value)}{unit} ({quantity(self.low)} to {quantity(self.high)}; n = {self.n})"


@dataclass(frozen=True)
class Effect:
    """One measured effect; null: what no effect would be; claimed: the paper's size, None where it states none.

    unit: "×" of a ratio, "dB", or "" of a share or a correlation.
    """

    name: str
    interval: Interval
    null: float
    claimed: float | None
    unit: Literal["", "×", "dB"] = ""


def decide(effect: Effect) -> Verdict:
    """By the table above; the effect is claimed to lie on that side of `null` where `claimed` is.

    >>> decide(Effect("", Interval(1.2, 1.0, 1.4, 3), 0.0, 1.3)), decide(Effect("", Interval(0.5, 0.3, 0.7, 3), 0.0, 1.3))
    ('holds', 'holds in part')
    >>> decide(Effect("", Interval(0.1, -0.3, 0.7, 3), 0.0, 1.3)), decide(Effect("", Interval(1.0, -0.3, 2.3, 3), 0.0, 1.3))
    ('does not hold', 'cannot be tested here')
    """
    if effect.interval.n < LEAST:
        return "cannot be tested here"
    claimed = effect.null if effect.claimed is None else effect.claimed
    sign = -1 if claimed < effect.null else 1
    low, high = sorted((sign * effect.interval.low, sign * effect.interval.high))
    beyond, reaches = low > sign * effect.null, high >= sign * claimed
    if beyond:
        return "holds" if reaches else "holds in part"
    return "cannot be tested here" if reaches else "does not hold"


def numbers(rows: pd.DataFrame, name: str, method: str | None = None, keys: Sequence[str] = PAIR) -> pd.Series:
    """A quantity of all runs, or of one method's, by scene and seed, the mean of those alike; none where no run has it."""
    part = rows if method is None else rows[rows["method"] == method]
    values = np.asarray(part[name], float) if name in part else np.full(len(part), np.nan)
    found = pd.Series(values, pd.MultiIndex.from_frame(pd.DataFrame(part[list(keys)])))
    found = pd.Series(found[np.isfinite(values)])
    return found if method is None else pd.Series(found.groupby(level=list(keys)).mean())


def gains(rows: pd.DataFrame, method: str) -> pd.Series:
    """PSNR over that of 3DGS, dB, by scene and seed."""
    return (numbers(rows, SCORE, method) - numbers(rows, SCORE, BASE)).dropna()


def log_ratios(rows: pd.DataFrame, name: str, method: str = STABLE) -> pd.Series:
    """ln of the magnitude over that of 3DGS, by scene and seed; of times, only of trainings in the same surroundings."""
    keys = [*PAIR, *(key for key in SURROUNDINGS if key in rows and name.endswith("_seconds"))]
    found = (numbers(rows, name, method, keys) / numbers(rows, name, BASE, keys)).dropna().abs()
    return pd.Series(pd.Series(np.log(found[found > 0])).groupby(level=list(PAIR)).mean())


def ratio_effect(name: str, logarithms: pd.Series, claimed: float | None) -> Effect:
    """Of a ratio whose logarithms were averaged."""
    return Effect(name, Interval.of(logarithms).exp(), 1.0, claimed, "×")
