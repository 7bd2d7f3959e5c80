"""Figures: the effects behind the verdicts on the paper's statements, and what goes with the score.

`python -m figures.claims OUT` draws OUT/claims.png from OUT/claims.csv and OUT/predictors.png from OUT/predictors.csv, as
`landscape claims` wrote them.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.records.findings import attribute_name
from figures.style import BLUE, VERMILION, folder_script, new_figure, save, style

UNITS = {"×": "StableGS over 3DGS, or a ratio (×)", "dB": "PSNR gained (dB)", "": "share or correlation"}
KINDS = {"all": "all runs", "between": "means of methods", "within": "seeds of a method"}
ROW = 0.17  # inches
FAR = 1e4  # a ratio beyond this, or below its inverse, ends at the edge


def draw_claims(table: pd.DataFrame) -> Figure:
    """One row an effect, a panel a unit."""
    known = pd.DataFrame(table[table["n"] >= 2]).fillna({"unit": ""})
    parts = {unit: pd.DataFrame(known[known["unit"] == unit]) for unit in UNITS}
    panels = [(unit, part) for unit, part in parts.items() if len(part)]
    with style():
        figure = new_figure(0.7 + sum(0.45 + ROW * len(part) for _, part in panels), 6.8)
        heights = [len(part) + 2 for _, part in panels] or [1]
        axes = figure.subplots(max(len(panels), 1), 1, squeeze=False, height_ratios=heights)[:, 0]
        for each, (unit, part) in zip(axes, panels):
            _effects(each, part, unit)
        if not panels:
            axes[0].set_axis_off()
            axes[0].text(0.5, 0.5, "fewer than two seeds: no intervals", ha="center")
    return figure


def _effects(axes: Axes, part: pd.DataFrame, unit: str) -> None:
    places = np.arange(len(part))[::-1]
    value, low, high = (part[name].to_numpy(float) for name in ("value", "low", "high"))
    if unit == "×":
        axes.set_xscale("log")
        value, low, high = (np.clip(x, 1 / FAR, FAR) for x in (value, low, high))
    axes.hlines(places, low, high, color=BLUE, linewidth=1.2)
    axes.plot(value, places, "o", color=BLUE, markersize=3.5)
    axes.plot(part["claimed"], places, "D", color=VERMILION, markersize=3.5, markerfacecolor="white")
    axes.plot(part["null"], places, "|", color="0.5", markersize=8)
    axes.set_yticks(places, [f"{row['statement']}  {row['effect']}" for row in part.to_dict("records")])
    axes.set_ylim(-0.7, len(part) - 0.3)
    axes.set_xlabel(UNITS[unit])
    axes.grid(True, axis="x")


def draw_predictors(table: pd.DataFrame) -> Figure:
    """A panel for each kind of correlation, a row a quantity."""
    names = list(dict.fromkeys(table["quantity"]))[::-1]
    with style():
        figure = new_figure(0.8 + ROW * max(len(names), 3), 6.8)
        panels = figure.subplots(1, len(KINDS), sharex=True, sharey=True)
        for axes, (kind, title) in zip(panels, KINDS.items(), strict=True):
            part = pd.DataFrame(table[table["kind"] == kind])
            places = [names.index(name) for name in part["quantity"]]
            decided = ((part["low"] > 0) | (part["high"] < 0)).to_numpy(bool)
            colours = np.where(decided, VERMILION, "0.55")
            axes.hlines(places, part["low"], part["high"], color=list(colours), linewidth=1.2)
            axes.scatter(part["rho"], places, color=list(colours), s=11, zorder=2)
            axes.axvline(0, color="0.5", linewidth=0.6)
            axes.set_title(f"{title} (n = {max(part['n'], default=0)})", loc="left")
            axes.grid(True, axis="x")
        panels[0].set_yticks(range(len(names)), [_words(name) for name in names])
        panels[0].set_xlim(-1.05, 1.05)
        panels[1].set_xlabel("rank correlation with PSNR on held-out views; red: the interval excludes 0")
    return figure


def _words(name: str) -> str:
    """
    >>> _words("trace_means"), _words("effective_rank")
    ('trace of position', 'effective rank')
    """
    if name.startswith("trace_"):
        return f"trace of {attribute_name(name.removeprefix('trace_'))}"
    return (
        name.replace("lambda_max", "λ1").replace("lambda_second", "λ2").replace("lambda_min", "λ min").replace("_", " ")
    )


def draw(folder: Path, suffix: str) -> list[Path]:
    drawn = {"claims": draw_claims, "predictors": draw_predictors}
    return [
        save(make(pd.read_csv(folder / f"{name}.csv")), folder / f"{name}.{suffix}") for name, make in drawn.items()
    ]


if __name__ == "__main__":
    folder_script(draw, "the effects behind the verdicts", "claims")
