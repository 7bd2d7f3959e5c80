"""Ratios of an accuracy study: the defaults' work over the rivals' at equal true error.

`notebooks.accuracy` has the definitions; `table` is its table of runs, `floors` the round-off of each case.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.bench.accuracy.command import squares

SCENES = {"traces": 0.5, "ends": 0.85}  # largest ratios that are asked for on scenes and checkpoints, by quantity
MATRICES = 1.1  # the same on matrices, for every quantity
DRAWS = 200  # of the bootstrap
LIMITS = (0.025, 0.975)  # of a 95% interval
MEANS = ("error", "needs", "rival_needs", "ratio", "seconds_ratio")  # columns averaged over scenes
QUANTITIES = ("traces", "ends", "sum of |lambda|", "participation ratio", "diagonal")


@dataclass(frozen=True, eq=False)
class Curve:
    """The settings of one method.  squares, costs: squared errors and costs, (settings, seeds)."""

    squares: np.ndarray
    costs: np.ndarray

    @classmethod
    def of(cls, runs: pd.DataFrame, cost: str) -> "Curve":
        by_seed = pd.DataFrame(runs.groupby(["settings", "seed"], sort=False)[["square", cost]].mean()).reset_index()
        grids = [by_seed.pivot(index="settings", columns="seed", values=name).to_numpy() for name in ("square", cost)]
        return cls(*grids)

    def drawn(self, rng: np.random.Generator | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Root mean square errors and mean costs of the settings: over all seeds, or over a bootstrap sample of them."""
        seeds = self.costs.shape[1]
        chosen = np.arange(seeds) if rng is None else rng.integers(seeds, size=seeds)
        return np.sqrt(self.squares[:, chosen].mean(axis=1)), self.costs[:, chosen].mean(axis=1)


def needed(errors: np.ndarray, costs: np.ndarray, goal: float) -> tuple[float, str]:
    """Work that a method needs for an error, and the sign of the ratio's bound: "" exact, "≥" need may be less, "≤" more.

    A setting reaches an error if no costlier setting has a larger one (`notebooks.accuracy`).

    >>> errors, costs = np.array([1e-1, 1e-3]), np.array([10.0, 1000.0])
    >>> needed(errors, costs, 1e-2)[0].round(9), needed(errors, costs, 0.5), needed(errors, costs, 1e-9)
    (np.float64(100.0), (10.0, '≥'), (1000.0, '≤'))
    >>> needed(np.array([1e-2, 1e-1, 1e-3]), np.array([1.0, 10.0, 1000.0]), 1e-2)[0].round(9)  # at 1 by chance
    np.float64(100.0)
    """
    order = np.argsort(costs)
    costs, errors = costs[order], errors[order]
    worst = np.maximum.accumulate(np.where(np.isfinite(errors), errors, 0.0)[::-1])[::-1]
    # a setting that failed has the error of the cheaper ones, and does not raise theirs
    errors = np.minimum.accumulate(np.where(np.isfinite(errors), worst, np.inf))
    if goal >= errors[0]:
        return float(costs[0]), "≥" if goal > errors[0] else ""
    if goal < errors[-1]:
        return float(costs[-1]), "≤"
    k = int(np.argmax(errors <= goal))
    if not np.isfinite(errors[k - 1]):
        return float(costs[k]), "≥"
    share = np.log(errors[k - 1] / goal) / np.log(errors[k - 1] / errors[k])
    return np.exp(np.log(costs[k - 1]) + share * np.log(costs[k] / costs[k - 1])), ""


def ratios(table: pd.DataFrame, floors: Mapping[str, float]) -> pd.DataFrame:
    """A line for each case, quantity and kind of rival ("peer", "own"): work of the default over that of the best rival.

    With several scenes, also a line for all of them for each quantity in SCENES (`_together`).
    """
    table = table.assign(square=squares(table, floors))
    rng, lines, drawn = np.random.default_rng(0), [], {}
    places = table[["case", "family", "quantity"]].drop_duplicates().itertuples(index=False, name=None)
    for case, family, quantity in places:
        part = pd.DataFrame(table[(table["case"] == case) & (table["quantity"] == quantity)])
        default = pd.DataFrame(part[part["origin"] == "default"])
        for against in ("peer", "own"):
            rivals = pd.DataFrame(part[part["origin"] == against])
            if rivals.empty or default.empty or quantity not in QUANTITIES:
                continue
            asked = _asked(family, quantity) if against == "peer" else np.nan
            line = {"case": case, "family": family, "quantity": quantity, "against": against}
            compared, draws = _compared(default, rivals, "matvecs", rng)
            seconds, _ = _compared(default, rivals, "seconds", rng)
            line |= compared | {"seconds_ratio": seconds["ratio"], "seconds_bound": seconds["bound"], "asked": asked}
            lines.append(line | {"holds": verdict(line, asked)})
            if family == "splats" and not np.isnan(asked):
                drawn.setdefault(quantity, []).append((lines[-1], draws))
    lines += [_together(found) for found in drawn.values() if len(found) > 1]
    return pd.DataFrame(lines)


def _together(found: Sequence[tuple[Mapping, np.ndarray]]) -> dict:
    """The scenes' geometric means; a bound where any of them is one, "≈" where the signs differ."""

    def mean(values: Sequence) -> np.ndarray:
        return np.exp(np.log(values).mean(axis=0))

    scenes = [scene for scene, _ in found]
    line = dict(scenes[0]) | {"case": f"all {len(found)} scenes", "rival": "the best of each"}
    line |= {key: float(mean([scene[key] for scene in scenes])) for key in MEANS}
    for bound in ("bound", "seconds_bound"):
        bounds = {scene[bound] for scene in scenes} - {""}
        line[bound] = bounds.pop() if len(bounds) == 1 else "≈" if bounds else ""
    low, high = np.quantile(mean([draws for _, draws in found]), LIMITS)
    line |= {"low": float(low), "high": float(high)}
    return line | {"holds": verdict(line, float(scenes[0]["asked"]))}


def _asked(family: str, quantity: str) -> float:
    """Largest ratio that is asked for; nan without."""
    return MATRICES if family == "matrices" else SCENES.get(quantity, np.nan)


def _compared(
    default: pd.DataFrame, rivals: pd.DataFrame, cost: str, rng: np.random.Generator
) -> tuple[dict, np.ndarray]:
    """The ratio with the best rival, its interval and the two points compared; and the ratios of the bootstrap."""
    ours = Curve.of(default, cost)
    others = {str(name): Curve.of(runs, cost) for name, runs in rivals.groupby("estimator", sort=False)}
    errors, costs = ours.drawn()
    found = {name: needed(*curve.drawn(), errors[0]) for name, curve in others.items()}
    best = _best(found)
    draws = []
    for _ in range(DRAWS):
        error, needs = ours.drawn(rng)
        again = {name: needed(*curve.drawn(rng), error[0]) for name, curve in others.items()}
        draws.append(needs[0] / again[_best(again)][0])
    low, high = np.quantile(draws, LIMITS)
    need, bound = found[best]
    compared = {
        "error": errors[0], "needs": costs[0], "rival": best, "rival_needs": need,
        "ratio": costs[0] / need, "bound": bound, "low": low, "high": high,
    }  # fmt: skip
    return compared, np.array(draws)


def _best(found: Mapping[str, tuple[float, str]]) -> str:
    """Name of the method that needs least; methods that do not reach the error count only where none does."""
    return min(found, key=lambda name: (found[name][1] == "≤", found[name][0] * (-1 if found[name][1] == "≤" else 1)))


def verdict(line: Mapping[str, object], asked: float) -> str:
    """ "yes" or "no" where interval and bound decide, else "open"; "" where no ratio is asked for."""
    low, high, bound = float(line["low"]), float(line["high"]), line["bound"]  # pyright: ignore[reportArgumentType]
    if np.isnan(asked):
        return ""
    if high <= asked and bound in ("", "≤"):
        return "yes"
    return "no" if low > asked and bound in ("", "≥") else "open"


def ratio_table(found: pd.DataFrame) -> pd.DataFrame:
    """The lines of `ratios` for the terminal."""
    styles = {"yes": "green", "no": "bold red", "open": "yellow"}

    def line(row: Mapping) -> dict:
        return {
            "case": row["case"],
            "quantity": row["quantity"],
            "error": row["error"],
            "H v": round(row["needs"]),
            "best rival": row["rival"],
            "its H v": round(row["rival_needs"]),
            "ratio": f"{row['bound']}{row['ratio']:.2f}",
            "from": row["low"],
            "to": row["high"],
            "asked": row["asked"],
            "holds": f"[{styles[row['holds']]}]{row['holds']}[/]" if row["holds"] else "",
        }

    return pd.DataFrame(map(line, found.to_dict("records")))
