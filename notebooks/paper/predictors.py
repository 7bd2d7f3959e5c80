"""Rank correlation of measured quantities with the score on held-out views, over all trainings of a study.

    tau         Kendall's tau-b with PSNR within each scene, its mean over the scenes; of one of these kinds:
    all         of all runs of a scene
    given       the same given the controls, PSNR on training views and ln N: what a quantity tells beyond these two
    within      of the pairs of runs that differ in the seed alone
    holm        p after Holm's correction for all quantities of the kind

Tau, its interval and p are those of `notebooks.statistics`; of "within" p is from permutations of the scores.
Correlation does not imply cause: methods differ in many quantities at once.
"""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from analysis.records.findings import ATTRIBUTES
from analysis.records.schema import INDICES
from notebooks.paper.effects import SCORE
from notebooks.statistics import LEAST, holm, interval, jackknife, permuted

CONTROLS = ("train_psnr", "gaussians")
QUANTITIES = (
    *CONTROLS, *(f"trace_{name}" for name in ATTRIBUTES), "lambda_max", "lambda_second", "lambda_min", *INDICES,
    *(f"{name}_{metric}" for metric in ("scene", "optimiser") for name in INDICES),
    "finite_curvature", "depth_gradient", "needles", "one_gaussian", "opacity_one_view",
)  # fmt: skip
COLUMNS = ("quantity", "kind", "tau", "low", "high", "p", "holm", "n", "clusters")


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
