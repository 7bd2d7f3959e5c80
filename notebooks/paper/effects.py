"""Effects of methods in a study, their intervals over seeds, and the verdict on each of the paper's claims.

An effect is a mean over trainings, or over pairs (scene, seed) that both methods have, with Student's 95% interval: of gains in
PSNR from the deviation pooled over all methods, as a handful of seeds of one tells little of it, else from the effect's own.
Ratios are averaged as logarithms.  A training repeated on several machines counts once.  The verdict compares the interval with
no effect and with the size that the paper claims:

    interval beyond no effect, reaches the claimed size         holds
    interval beyond no effect, falls short of that size         holds in part
    interval not beyond no effect, falls short of that size     does not hold
    interval includes no effect and that size                   undecided
    fewer than three trainings or pairs                         cannot be tested at this size
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from notebooks.statistics import Interval

UNTESTED = "cannot be tested at this size"
Verdict = Literal["holds", "holds in part", "does not hold", "undecided", "cannot be tested at this size"]
LEAST = 3
BASE, STABLE = "3dgs", "stablegs"
SCORE = "psnr"
STRETCHED = ("quats", "log_scales")  # attributes whose curvature the paper ascribes to needles
PAIR = ("scene", "seed")
SURROUNDINGS = ("machine", "threads")  # columns that must agree for times to be compared


@dataclass(frozen=True)
class Effect:
    """A measured effect.  null: its value without any effect; claimed: the paper's value, None where it has none.

    unit: "×" for a ratio, "dB", or "" for a share or a correlation.
    """

    name: str
    interval: Interval
    null: float
    claimed: float | None
    unit: Literal["", "×", "dB"] = ""


def decide(effect: Effect) -> Verdict:
    """The verdict by the module's table.  The claimed effect is on the side of `null` where `claimed` lies, by default above.

    >>> decide(Effect("", Interval(1.2, 1.0, 1.4, 3), 0.0, 1.3)), decide(Effect("", Interval(0.5, 0.3, 0.7, 3), 0.0, 1.3))
    ('holds', 'holds in part')
    >>> decide(Effect("", Interval(0.1, -0.3, 0.7, 3), 0.0, 1.3)), decide(Effect("", Interval(1.0, -0.3, 2.3, 3), 0.0, 1.3))
    ('does not hold', 'undecided')
    """
    if effect.interval.n < LEAST:
        return UNTESTED
    claimed = effect.null if effect.claimed is None else effect.claimed
    sign = -1 if claimed < effect.null else 1
    low, high = sorted((sign * effect.interval.low, sign * effect.interval.high))
    beyond, reaches = low > sign * effect.null, high >= sign * claimed
    if beyond:
        return "holds" if reaches else "holds in part"
    return "undecided" if reaches else "does not hold"


def numbers(rows: pd.DataFrame, name: str, method: str | None = None, keys: Sequence[str] = PAIR) -> pd.Series:
    """A quantity by keys: of every run, or of one method, whose runs with the same keys are averaged.  Without missing ones."""
    values = np.asarray(rows[name], float) if name in rows else np.full(len(rows), np.nan)
    known = np.isfinite(values)
    if method is not None:
        known &= np.asarray(rows["method"] == method)
    found = pd.Series(values[known], pd.MultiIndex.from_arrays([rows[key].array[known] for key in keys], names=keys))
    return found if method is None else _means(found, keys)


def _means(values: pd.Series, keys: Sequence[str]) -> pd.Series:
    """Means over entries with the same keys."""
    return values if values.index.is_unique else pd.Series(values.groupby(level=list(keys)).mean())


def gains(rows: pd.DataFrame, method: str, over: str = BASE) -> pd.Series:
    """PSNR minus that of another method, dB, by scene and seed."""
    return (numbers(rows, SCORE, method) - numbers(rows, SCORE, over)).dropna()


def gain(rows: pd.DataFrame, method: str, over: str = BASE) -> Interval:
    """The mean of `gains`, with the deviation that those of all methods have together."""
    others = [name for name in dict.fromkeys(rows["method"]) if name != over]
    within = [found - found.mean() for name in others if len(found := gains(rows, name, over)) > 1]
    freedom = sum(map(len, within)) - len(within)
    deviation = float(np.sqrt(sum(found @ found for found in within) / max(freedom, 1)))
    return Interval.of(gains(rows, method, over), (deviation, freedom) if freedom else None)


def log_ratios(rows: pd.DataFrame, name: str, method: str = STABLE) -> pd.Series:
    """ln |quantity / that of 3DGS| by scene and seed; times are compared only within the same surroundings."""
    keys = [*PAIR, *(key for key in SURROUNDINGS if key in rows and name.endswith("_seconds"))]
    found = (numbers(rows, name, method, keys) / numbers(rows, name, BASE, keys)).dropna().abs()
    return _means(pd.Series(np.log(found[found > 0])).droplevel(keys[len(PAIR) :]), PAIR)


def ratio_effect(name: str, logarithms: pd.Series, claimed: float | None) -> Effect:
    """The effect of a ratio, from its logarithms."""
    return Effect(name, Interval.of(logarithms).exp(), 1.0, claimed, "×")
