"""Means with their intervals; Kendall's tau of a quantity with a score within each scene, given controls.

With r = sin(pi tau / 2) of quantity, score and controls among each other (Greiner: Pearson's r of normal variables that have
these ranks) and P = r^-1, r given the controls is -P_01 / sqrt(P_00 P_11), and tau given them 2 / pi asin of it.  Kendall's own
partial tau, the same formula in tau, is not 0 where normal variables are independent given the controls.  Of few runs r may
have eigenvalues that are negative, or nearly so: they are raised to FLOOR.

Interval    of 95%, by the jackknife over clusters.  All runs of a method are one cluster, as its seeds differ by less than
            methods do; where there are LEAST scenes and more, these are clusters too, and the variances are those of methods
            plus those of scenes minus those of both (Cameron, Gelbach & Miller 2011).  With fewer scenes the interval is for
            these scenes alone.  Student's t has one degree of freedom less than the fewest clusters.
p           from the same t; of runs that differ in their seed alone, from DRAWS permutations of the scores among these
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from analysis.records.quantities import quantity

CONFIDENCE, SEED, DRAWS = 0.95, 0, 999
LEAST, FLOOR = 5, 1e-3


@dataclass(frozen=True)
class Interval:
    """A mean over n trainings or pairs with its 95% interval, unbounded for n below 2."""

    value: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, values: Sequence[float] | pd.Series, pooled: tuple[float, int] | None = None) -> "Interval":
        """The interval of the mean of all finite values.  pooled: their deviation and its degrees of freedom, where known.

        >>> Interval.of([1.0, 2.0, 3.0])
        Interval(value=2.0, low=-0.484..., high=4.484..., n=3)
        """
        known = np.asarray(values, float)
        known = known[np.isfinite(known)]
        n = len(known)
        if n < 2:
            return cls(float(known.mean()) if n else np.nan, -np.inf, np.inf, n)
        deviation, freedom = pooled or (float(known.std(ddof=1)), n - 1)
        half = float(stdtrit(freedom, (1 + CONFIDENCE) / 2) * deviation / np.sqrt(n))
        return cls(float(known.mean()), float(known.mean()) - half, float(known.mean()) + half, n)

    def exp(self) -> "Interval":
        """The interval of a ratio, from that of its logarithm."""
        value, low, high = (float(np.exp(x)) for x in (self.value, self.low, self.high))
        return Interval(value, low, high, self.n)

    def text(self, unit: str = "") -> str:
        """Value, interval and n in words.

        >>> Interval(1.5, 1.0, 2.0, 3).text(" dB")
        '1.50 dB (1.00 to 2.00; n = 3)'
        """
        if self.n < 2:
            return f"{quantity(self.value)}{unit} (n = 1)" if self.n else "not measured"
        return f"{quantity(self.value)}{unit} ({quantity(self.low)} to {quantity(self.high)}; n = {self.n})"


def interval(tau: float, error: float, clusters: int) -> dict[str, float]:
    """Ends of the 95% interval and two-sided p, of Student's t."""
    half = float(stdtrit(clusters - 1, 0.975)) * error
    p = 2 * float(stdtr(clusters - 1, -abs(tau) / max(error, 1e-300)))
    return {"low": max(tau - half, -1.0), "high": min(tau + half, 1.0), "p": p}


def interval_text(line: dict, name: str, form: str = "", words: str = "", after: str = "") -> str:
    """A number of a row and the ends of its interval, "low" and "high".  form: of Python; without one two digits."""
    value, low, high = (format(line[key], form) if form else digits(line[key]) for key in (name, "low", "high"))
    return f"{value}{words} ({low} to {high}{after})".replace("-", "−")


def digits(value: float) -> str:
    """Two significant digits.

    >>> [digits(value) for value in (0.8, 1.0, 11.2, 234.0, -0.0123)]
    ['0.80', '1.0', '11', '234', '-0.012']
    """
    return f"{value:#.2g}".rstrip(".") if abs(value) < 99.5 else f"{value:.0f}"


def jackknife(
    values: np.ndarray, scenes: np.ndarray, methods: np.ndarray, *, within: bool = False
) -> tuple[float, float, int]:
    """Tau, its standard error and the fewest clusters.

    values: (n, 2 and more), quantity, score and controls.  scenes, methods: (n,), numbers from 0.  within: only pairs of runs
    of one method count.
    """
    count = int(methods.max(initial=-1)) + 1
    found = np.array([
        _of_scene(values[scenes == scene], methods[scenes == scene], count, within) for scene in np.unique(scenes)
    ]).reshape(-1, count + 1)  # fmt: skip
    found = found[np.isfinite(found[:, 0])]  # nothing varies in the others
    if not len(found) or count < 2:
        return np.nan, np.nan, count
    whole, without = found[:, 0], found[:, 1:]
    by_method = _variance(without.mean(axis=0))
    if len(whole) < LEAST:
        return float(whole.mean()), float(np.sqrt(by_method)), count
    by_scene = _variance((whole.sum() - whole) / (len(whole) - 1))
    by_both = _variance(whole.mean() + ((without - whole[:, None]) / len(whole)).ravel())
    total = max(by_method, by_scene, by_method + by_scene - by_both)
    return float(whole.mean()), float(np.sqrt(total)), min(count, len(whole))


def _variance(left_out: np.ndarray) -> float:
    """The jackknife's, from the estimates with one cluster left out each."""
    return float((len(left_out) - 1) * left_out.var())


def _of_scene(values: np.ndarray, methods: np.ndarray, count: int, within: bool) -> np.ndarray:
    """Tau of a scene's runs, then that without each method, (1 + count,)."""
    # signs of all pairs, and sums of their products by the methods of both runs: (method, method, columns, columns)
    signs, member = np.sign(values[:, None] - values[None]), np.eye(count)[methods]
    if within:
        signs *= (methods[:, None] == methods[None])[..., None]
    of_rows = np.tensordot(member, signs[..., None] * signs[..., None, :], (0, 0))
    sums = np.moveaxis(np.tensordot(of_rows, member, (1, 0)), -1, 1)
    whole = sums.sum(axis=(0, 1))
    own = sums[range(count), range(count)]
    return _tau(np.concatenate([whole[None], whole - sums.sum(axis=0) - sums.sum(axis=1) + own]))


def _tau(sums: np.ndarray) -> np.ndarray:
    """Tau of the first two columns given the others, from sums over pairs of products of signs, (..., columns, columns).

    >>> float(_tau(np.array([[4.0, 1.0], [1.0, 4.0]])))
    0.25
    """
    sizes = np.sqrt(np.diagonal(sums, axis1=-2, axis2=-1))
    varies = np.all(sizes.reshape(-1, sizes.shape[-1]) > 0, axis=0)  # what does not vary conditions nothing
    if not varies[:2].all():
        return np.full(sums.shape[:-2], np.nan)
    taus = (sums / (sizes[..., None] * sizes[..., None, :]).clip(1e-300))[..., varies, :][..., varies]
    if taus.shape[-1] == 2:
        return taus[..., 0, 1]
    values, vectors = np.linalg.eigh(np.sin(np.pi / 2 * taus))  # of few runs not all are positive
    P = vectors / values.clip(FLOOR)[..., None, :] @ np.swapaxes(vectors, -1, -2)
    r = -P[..., 0, 1] / np.sqrt(P[..., 0, 0] * P[..., 1, 1])
    return 2 / np.pi * np.arcsin(r.clip(-1, 1))


def permuted(values: np.ndarray, scenes: np.ndarray, methods: np.ndarray) -> float:
    """Two-sided p of tau within groups, from permutations of the second column within each scene's method."""
    order = np.lexsort([methods, scenes])
    x, y, group = values[order, 0], values[order, 1], (scenes * (methods.max() + 1) + methods)[order]
    first, second = np.nonzero(np.triu(group[:, None] == group[None], 1))
    shuffled = np.argsort(
        np.unique(group, return_inverse=True)[1] + np.random.default_rng(SEED).random((DRAWS, len(y)))
    )
    scores = np.concatenate([y[None], y[shuffled]])
    agreement = np.sign(scores[:, first] - scores[:, second]) @ np.sign(x[first] - x[second])
    return float((np.abs(agreement) >= abs(agreement[0])).mean())


def holm(p: pd.Series) -> pd.Series:
    """Holm's step-down correction.

    >>> holm(pd.Series([0.01, 0.04, 0.03])).round(2).tolist()
    [0.03, 0.06, 0.06]
    """
    order = np.argsort(p.to_numpy())
    raised = np.maximum.accumulate(p.to_numpy()[order] * np.arange(len(p), 0, -1)).clip(max=1)
    return pd.Series(raised[np.argsort(order)], p.index)
