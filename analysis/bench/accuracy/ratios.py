"""Summaries of an accuracy study: a point a setting, and the defaults' work over others' at equal true error.

See `analysis.bench.accuracy.command` for the definition; the numbers are those of its table of runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

SCENES = {"traces": 0.5, "ends": 0.85}  # what the project promises of scenes and checkpoints, by quantity
MATRICES = 1.1  # and of matrices, any quantity
DRAWS = 200  # of the bootstrap
LIMITS = (0.025, 0.975)  # of a 95% interval
MEANS = ("error", "needs", "rival_needs", "ratio", "seconds_ratio")  # of scenes together
QUANTITIES = ("traces", "ends", "sum of |lambda|", "effective rank", "mass quantile", "diagonal")
SETTING = ["case", "family", "quantity", "origin", "method", "settings"]


def points(table: pd.DataFrame, floors: Mapping[str, float]) -> pd.DataFrame:
    """A line a setting: means over seeds and parts, root mean squares of errors."""
    table = table.assign(true_error=_squares(table, floors), reported_error=table["reported_error"].pow(2))
    columns = ["matvecs", "seconds", "true_error", "reported_error", "covered"]
    means = pd.DataFrame(table.groupby(SETTING, sort=False)[columns].mean()).reset_index()
    return means.assign(true_error=means["true_error"].pow(0.5), reported_error=means["reported_error"].pow(0.5))


def _squares(table: pd.DataFrame, floors: Mapping[str, float]) -> np.ndarray:
    """Squared true errors, none below its case's round-off; what failed has an infinite one."""
    floor = table["case"].map(lambda case: floors[case]).where(table["quantity"] != "precision", 0.0)
    return np.maximum(table["true_error"].fillna(np.inf).to_numpy(float), floor.to_numpy(float)) ** 2


@dataclass(frozen=True, eq=False)
class Curve:
    """The settings of one method.  squares, costs: (settings, seeds); a setting's error is the root of its mean square."""

    squares: np.ndarray
    costs: np.ndarray

    @classmethod
    def of(cls, runs: pd.DataFrame, cost: str) -> "Curve":
        by_seed = pd.DataFrame(runs.groupby(["settings", "seed"], sort=False)[["square", cost]].mean()).reset_index()
        grids = [by_seed.pivot(index="settings", columns="seed", values=name).to_numpy() for name in ("square", cost)]
        return cls(*grids)

    def drawn(self, rng: np.random.Generator | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Errors and costs of the settings over all seeds, or over as many drawn with replacement."""
        seeds = self.costs.shape[1]  # fewer of our settings that are not the default
        chosen = np.arange(seeds) if rng is None else rng.integers(seeds, size=seeds)
        return np.sqrt(self.squares[:, chosen].mean(axis=1)), self.costs[:, chosen].mean(axis=1)


def needed(errors: np.ndarray, costs: np.ndarray, goal: float) -> tuple[float, str]:
    """Work that a method needs for an error, and whether it is exact (""), an upper ("≥" of a ratio) or a lower bound ("≤").

    It has an error where none of its costlier settings has a larger one: see `analysis.bench.accuracy.command`.

    >>> errors, costs = np.array([1e-1, 1e-3]), np.array([10.0, 1000.0])
    >>> needed(errors, costs, 1e-2)[0].round(9), needed(errors, costs, 0.5), needed(errors, costs, 1e-9)
    (np.float64(100.0), (10.0, '≥'), (1000.0, '≤'))
    >>> needed(np.array([1e-2, 1e-1, 1e-3]), np.array([1.0, 10.0, 1000.0]), 1e-2)[0].round(9)  # at 1 by chance
    np.float64(100.0)
    """
    order = np.argsort(costs)
    costs, errors = costs[order], errors[order]
    worst = np.maximum.accumulate(np.where(np.isfinite(errors), errors, 0.0)[::-1])[::-1]
    # a setting that failed says nothing of the cheaper ones, and costs what it costs for their error
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
    """A line a case, quantity and kind of rival ("peer", "own"): the default's matvecs and seconds over the best rival's.

    Where there are several scenes, a line more for each quantity that they are asked for (`_together`).
    """
    table = table.assign(square=_squares(table, floors))
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
    """The scenes' geometric means; a bound where one of them is a bound (which way, where they agree)."""

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
    """Largest ratio that is asked for; nan: none."""
    return MATRICES if family == "matrices" else SCENES.get(quantity, np.nan)


def _compared(
    default: pd.DataFrame, rivals: pd.DataFrame, cost: str, rng: np.random.Generator
) -> tuple[dict, np.ndarray]:
    """The ratio with the best rival, its bootstrap interval, and the two points compared; and the bootstrap's ratios."""
    own = Curve.of(default, cost)
    others = {str(name): Curve.of(runs, cost) for name, runs in rivals.groupby("estimator", sort=False)}
    errors, costs = own.drawn()
    found = {name: needed(*curve.drawn(), errors[0]) for name, curve in others.items()}
    best = _best(found)
    draws = []
    for _ in range(DRAWS):
        error, mine = own.drawn(rng)
        again = {name: needed(*curve.drawn(rng), error[0]) for name, curve in others.items()}
        draws.append(mine[0] / again[_best(again)][0])
    low, high = np.quantile(draws, LIMITS)
    need, bound = found[best]
    compared = {
        "error": errors[0], "needs": costs[0], "rival": best, "rival_needs": need,
        "ratio": costs[0] / need, "bound": bound, "low": low, "high": high,
    }  # fmt: skip
    return compared, np.array(draws)


def _best(found: Mapping[str, tuple[float, str]]) -> str:
    """Name of the method that needs least; methods whose settings end above the error count only where all do."""
    return min(found, key=lambda name: (found[name][1] == "≤", found[name][0] * (-1 if found[name][1] == "≤" else 1)))


def verdict(line: Mapping[str, object], asked: float) -> str:
    """ "yes" or "no" where interval and bound leave no doubt."""
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
