"""Figures: the effects behind the verdicts on the paper's statements, and what goes with the score."""

import textwrap

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from analysis.records.findings import attribute_name
from figures.style import BLUE, UNDETERMINED, VERMILION, new_figure, style
from notebooks.paper.effects import UNTESTED

UNITS = {"×": "ratio (×)", "dB": "PSNR gained (dB)", "": "share or correlation"}
GIVEN, SIGNIFICANT = "given training PSNR, ln N", 0.05
KINDS = {"all": "all runs", "given": GIVEN, "within": "seeds of a method"}
VERDICTS = {"holds": BLUE, "holds in part": BLUE, "does not hold": VERMILION} | dict.fromkeys(
    ("undecided", UNTESTED), UNDETERMINED
)
ROW, PANEL, WRAP = 0.17, 1.05, 76  # inches; characters
CROWDED = 1e3  # from the least ratio to the largest: powers of ten alone are labelled
FAR = 1e4  # a ratio beyond this, or below its inverse, ends at the edge


def draw_claims(table: pd.DataFrame) -> Figure:
    """A panel for each statement, under its verdict; a row for each of its effects."""
    parts = [pd.DataFrame(part) for _, part in table.fillna({"unit": ""}).groupby("statement")]
    with style():
        figure = new_figure(sum(PANEL + ROW * len(part) for part in parts), 6.8)
        panels = figure.subplots(len(parts), 1, squeeze=False, height_ratios=[len(part) + 2 for part in parts])[:, 0]
        for axes, part in zip(panels, parts, strict=True):
            _effects(axes, part)
        words = "dot: measured, with its 95% interval; diamond: the paper; upright line: no effect, or the bound"
        figure.supxlabel(words, fontsize=6.5)
    return figure


def _effects(axes: Axes, part: pd.DataFrame) -> None:
    """Effects of one statement, or words where there is none.  Hollow: of a single training, which has no interval."""
    places, unit, verdict = np.arange(len(part))[::-1], part["unit"].iloc[0], part["verdict"].iloc[0]
    value, low, high, claimed = (part[name].to_numpy(float) for name in ("value", "low", "high", "claimed"))
    several = part["n"].to_numpy() >= 2
    if unit == "×":
        axes.set_xscale("log")
        ends = np.concatenate([x[np.isfinite(x) & (x > 0)] for x in (value, low, high, claimed)])
        wide = ends.size and ends.max() > CROWDED * ends.min()
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0), numticks=8))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        value, low, high = (np.clip(x, 1 / FAR, FAR) for x in (value, low, high))
    axes.hlines(places[several], low[several], high[several], color=BLUE, linewidth=1.2)
    for chosen, face in ((several, BLUE), (~several, "white")):
        axes.plot(value[chosen], places[chosen], "o", color=BLUE, markerfacecolor=face, markersize=3.5)
    axes.plot(claimed, places, "D", color=VERMILION, markersize=3.5, markerfacecolor="white")
    axes.plot(part["null"], places, "|", color="0.5", markersize=8)
    for place, n in zip(places, part["n"]):
        if n < 2:
            words = "one training" if n else "not measured"
            axes.annotate(words, (1.01, place), xycoords=("axes fraction", "data"), color=UNDETERMINED, va="center")
    axes.set_yticks(places, list(part["effect"]))
    axes.set_ylim(-0.7, len(part) - 0.3)
    axes.set_xlabel(UNITS[unit])
    statement = textwrap.fill(f"{part['statement'].iloc[0]}. {part['text'].iloc[0]}", WRAP)
    axes.set_title(f"{statement}\n{verdict}", loc="left", color=VERDICTS[verdict])
    axes.grid(True, axis="x")


WORDS = {  # of quantities whose names do not say it
    "train_psnr": "PSNR on training views",
    "gaussians": "number of Gaussians",
    "lambda_max": "λ max",
    "lambda_second": "second largest λ",
    "lambda_min": "λ min",
    "eigenvalue_ratio": "λ max / λ min",
    "negative_ratio": "|λ min| / λ max",
    "finite_curvature": "curvature by steps of Adam",
    "depth_gradient": "gradient, depth : lateral",
    "needles": "share of e₁ on needles",
    "one_gaussian": "share of e₁ on one Gaussian",
    "opacity_one_view": "opacity's curvature ~ one view",
}


def draw_predictors(table: pd.DataFrame) -> Figure:
    """A panel for each kind of tau, a row a quantity."""
    names = list(dict.fromkeys(table["quantity"]))[::-1]
    with style():
        figure = new_figure(0.8 + ROW * max(len(names), 3), 6.8)
        panels = figure.subplots(1, len(KINDS), sharex=True, sharey=True)
        for axes, (kind, title) in zip(panels, KINDS.items(), strict=True):
            part = pd.DataFrame(table[table["kind"] == kind])
            places = [names.index(name) for name in part["quantity"]]
            colours = np.where(part["holm"] < SIGNIFICANT, VERMILION, "0.55")
            axes.hlines(places, part["low"], part["high"], color=list(colours), linewidth=1.2)
            axes.scatter(part["tau"], places, color=list(colours), s=11, zorder=2)
            axes.axvline(0, color="0.5", linewidth=0.6)
            axes.set_title(title, loc="left")
            axes.grid(True, axis="x")
        panels[0].set_yticks(range(len(names)), [words_of(name) for name in names])
        panels[0].set_xlim(-1.05, 1.05)
        words = f"Kendall's tau with PSNR on held-out views, {max(table['n'], default=0)} runs"
        panels[1].set_xlabel(f"{words}; orange: p < {SIGNIFICANT} after Holm's correction")
    return figure


def words_of(quantity: str) -> str:
    """What a quantity of a run is called in a figure.

    >>> words_of("trace_means"), words_of("one_gaussian"), words_of("share_scene")
    ('trace of position', 'share of e₁ on one Gaussian', 'share, scene units')
    """
    for metric in ("scene", "optimiser"):
        if quantity.endswith(f"_{metric}"):
            return f"{words_of(quantity.removesuffix(f'_{metric}'))}, {metric} units"
    if quantity.startswith("trace_"):
        return f"trace of {attribute_name(quantity.removeprefix('trace_'))}"
    return WORDS.get(quantity, quantity.replace("_", " "))
