"""Correlation of measured quantities with the score on held-out views, over all trainings of a study.

    rho         Spearman's rank correlation with PSNR, of one of these kinds:
    all         of the runs, ranked within each scene
    within      of these ranks minus their mean over the method: between the seeds of one method
    between     of the methods' means

Each with a 95% interval from a bootstrap, which draws runs (between: methods) with replacement.  Correlation does not imply
cause: methods differ in many quantities at once.
"""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from analysis.records.findings import ATTRIBUTES
from analysis.records.schema import INDICES
from notebooks.paper.effects import SCORE

QUANTITIES = (
    "train_psnr", "gaussians", *(f"trace_{name}" for name in ATTRIBUTES), "lambda_max", "lambda_second", "lambda_min", *INDICES,
    *(f"{name}_{metric}" for metric in ("scene", "optimiser") for name in INDICES),
    "finite_curvature", "depth_gradient", "needles", "one_gaussian", "opacity_one_view",
)  # fmt: skip
SEED, DRAWS, LIMITS = 0, 2000, (0.025, 0.975)  # of the bootstrap
LEAST = 5


def predictors(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each quantity and kind: quantity, kind, rho, low, high, n.

    Left out: kinds with fewer than LEAST runs or methods, and quantities that most runs lack, as the others' correlations would
    be over different runs.
    """
    rng = np.random.default_rng(SEED)

    def lines() -> Iterator[dict]:
        for name in QUANTITIES:
            if name not in rows or 2 * len(pd.Series(rows[name]).dropna()) < len(rows):
                continue
            known = pd.DataFrame(rows[["scene", "method", name, SCORE]].dropna())
            for kind, pairs in _pairs(known, name).items():
                if len(pairs) >= LEAST and (np.ptp(pairs, axis=0) > 0).all():
                    low, high = _bootstrap(pairs, rng)
                    rho = float(np.corrcoef(pairs.T)[0, 1])
                    yield {"quantity": name, "kind": kind, "rho": rho, "low": low, "high": high, "n": len(pairs)}

    return pd.DataFrame(lines(), columns=["quantity", "kind", "rho", "low", "high", "n"])


def _pairs(known: pd.DataFrame, name: str) -> dict[str, np.ndarray]:
    """(n, 2) ranks of the quantity and of the score, by kind."""
    columns, groups = [name, SCORE], [known["scene"], known["method"]]
    ranks = pd.DataFrame(known.groupby("scene")[columns].rank(pct=True))
    means = pd.DataFrame(known.groupby(["scene", "method"])[columns].mean())
    between = pd.DataFrame(means.groupby("scene").rank(pct=True))
    within = ranks - pd.DataFrame(ranks.groupby(groups).transform("mean"))
    several = pd.Series(known.groupby(["scene", "method"])[name].transform("size")).to_numpy() > 1
    return {"all": ranks.to_numpy(), "within": within.to_numpy()[several], "between": between.to_numpy()}


def _bootstrap(pairs: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    drawn = pairs[rng.integers(len(pairs), size=(DRAWS, len(pairs)))]
    centred = drawn - drawn.mean(axis=1, keepdims=True)
    spread = np.sqrt((centred**2).sum(axis=1)).prod(axis=1)
    found = (centred.prod(axis=2).sum(axis=1) / np.where(spread > 0, spread, np.nan))[spread > 0]
    low, high = np.quantile(found, LIMITS)
    return float(low), float(high)
