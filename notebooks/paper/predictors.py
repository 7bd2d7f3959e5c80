"""Rank correlation of measured quantities with the score on held-out views, over all trainings of a study.

    tau         Kendall's tau-b with PSNR within each scene, its mean over the scenes; of one of these kinds:
    all         of all runs of a scene
    given       the same given the controls, PSNR on training views and ln N: what a quantity tells beyond these two
    within      of the pairs of runs that differ in the seed alone

With r = sin(pi tau / 2) of quantity, score and controls among each other (Greiner: Pearson's r of normal variables that have
these ranks) and P = r^-1, r given the controls is -P_01 / sqrt(P_00 P_11), and tau given them 2 / pi asin of it.  Kendall's own
partial tau, the same formula in tau, is not 0 where normal variables are independent given the controls.

Interval    of 95%, by the jackknife over clusters.  All runs of a method are one cluster, as its seeds differ by less than
            methods do; where there are LEAST scenes and more, these are clusters too, and the variances are those of methods
            plus those of scenes minus those of both (Cameron, Gelbach & Miller 2011).  With fewer scenes the interval is for
            these scenes alone.  Student's t has one degree of freedom less than the fewest clusters.
p           of "all" and "given" from the same t; of "within" from DRAWS permutations of the scores among the seeds of a method
holm        p after Holm's correction for all quantities of the kind

Correlation does not imply cause: methods differ in many quantities at once.
"""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from analysis.records.findings import ATTRIBUTES
from analysis.records.schema import INDICES
from notebooks.paper.effects import SCORE

CONTROLS = ("train_psnr", "gaussians")
QUANTITIES = (
    *CONTROLS, *(f"trace_{name}" for name in ATTRIBUTES), "lambda_max", "lambda_second", "lambda_min", *INDICES,
    *(f"{name}_{metric}" for metric in ("scene", "optimiser") for name in INDICES),
    "finite_curvature", "depth_gradient", "needles", "one_gaussian", "opacity_one_view",
)  # fmt: skip
COLUMNS = ("quantity", "kind", "tau", "low", "high", "p", "holm", "n", "clusters")
SEED, DRAWS = 0, 999
LEAST, FLOOR = 5, 1e-3


def predictors(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each quantity and kind, with the columns COLUMNS; n: runs.

    Left out: methods with one seed of a scene, kinds with fewer than LEAST clusters, and quantities that most runs lack, as the
    others' correlations would be over different runs.  A control is left out of its own condition.
    """
    table = pd.DataFrame(_lines(rows), columns=[name for name in COLUMNS if name != "holm"])
    table["holm"] = table.groupby("kind")["p"].transform(holm)
    return table.reindex(columns=list(COLUMNS))


def _lines(rows: pd.DataFrame) -> Iterator[dict]:
    for name in QUANTITIES:
        controls = [control for control in CONTROLS if control in rows and control != name]
        if name not in rows or 2 * len(pd.Series(rows[name]).dropna()) < len(rows):
            continue
        # machines repeat a training; all kinds are of the same runs
        keys, columns = ["scene", "method", "seed"], [*dict.fromkeys([name, SCORE, *controls])]
        once = pd.DataFrame(rows[keys + columns].dropna().groupby(keys, sort=False).mean())
        known = once.reset_index().groupby(keys[:2], sort=False).filter(lambda runs: len(runs) > 1)
        scenes, methods = (pd.factorize(known[key])[0] for key in keys[:2])
        for kind, given in {"all": [], "given": controls, "within": []}.items():
            values = known[[name, SCORE, *given]].to_numpy(float)
            tau, error, clusters = jackknife(values, scenes, methods, within=kind == "within")
            if clusters < LEAST or np.isnan(tau) or tau == error == 0:
                continue
            line = {"quantity": name, "kind": kind, "tau": tau, **interval(tau, error, clusters)}
            if kind == "within":
                line["p"] = permuted(values, scenes, methods)
            yield line | {"n": len(values), "clusters": clusters}


def interval(tau: float, error: float, clusters: int) -> dict[str, float]:
    """Ends of the 95% interval and two-sided p, of Student's t."""
    half = float(stdtrit(clusters - 1, 0.975)) * error
    p = 2 * float(stdtr(clusters - 1, -abs(tau) / max(error, 1e-300)))
    return {"low": max(tau - half, -1.0), "high": min(tau + half, 1.0), "p": p}


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
