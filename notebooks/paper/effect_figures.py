"""Figures: the effects behind the verdicts on the paper's statements, and what goes with the score."""

import textwrap

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from figures.style import BLUE, UNDETERMINED, VERMILION, new_figure, style
from notebooks.names import words_of
from notebooks.paper.effects import UNTESTED
from notebooks.statistics import digits, interval_text

GIVEN, SIGNIFICANT = "given training PSNR, ln N", 0.05
KINDS = {"all": "all runs", "given": GIVEN, "within": "seeds of a method"}
VERDICTS = {"holds": BLUE, "holds in part": BLUE, "does not hold": VERMILION} | dict.fromkeys(
    ("undecided", UNTESTED), UNDETERMINED
)
ROW, CLAIM, WRAP = 0.17, 0.36, 52  # inches; characters
EDGES = -1.2, 2.2  # of the claims: what lies beyond is drawn at the edge


def draw_claims(table: pd.DataFrame) -> Figure:
    """A row for each statement, under its verdict's colour: its first effect as a share of the paper's, with what was measured.

    0: no effect, or the bound; 1: the paper's number; of ratios their logarithms.  An effect without a number in the paper is
    told in words alone; one training has no interval and a hollow dot.
    """
    firsts = [part.iloc[0].to_dict() for _, part in table.fillna({"unit": ""}).groupby("statement")]
    with style():
        figure = new_figure(0.8 + CLAIM * len(firsts), 6.8)
        axes = figure.add_subplot()
        for place, line in zip(range(len(firsts))[::-1], firsts):
            colour = VERDICTS[line["verdict"]]
            shares = np.clip([_share(line, name) for name in ("value", "low", "high")], *EDGES)
            if np.isfinite(shares[0]):
                axes.hlines(place, *np.sort(shares[1:]), color=colour, linewidth=1.2, clip_on=False)
                axes.plot(
                    shares[0],
                    place,
                    "o",
                    color=colour,
                    markerfacecolor=colour if line["n"] > 1 else "white",
                    markersize=4,
                    clip_on=False,
                )
            axes.annotate(_measured(line), (1.01, place), xycoords=("axes fraction", "data"), color=colour, va="center")
        for place, words in {0: "no effect", 1: "the paper"}.items():
            axes.axvline(place, color="0.5", linewidth=0.6)
            axes.annotate(words, (place, 1.01), xycoords=("data", "axes fraction"), ha="center")
        names = [textwrap.fill(f"{line['statement']}. {line['text']}", WRAP) for line in firsts]
        axes.set_yticks(range(len(firsts))[::-1], names)
        axes.set(xlim=EDGES, ylim=(-0.6, len(firsts) - 0.4))
        axes.set_xlabel("effect over the paper's; intervals of 95%, at the edge where they are longer")
        axes.grid(True, axis="x")
    return figure


def _share(line: dict, name: str) -> float:
    """Where a number of an effect lies from no effect, 0, to the paper's, 1; nan without a number in the paper."""
    value, null, claimed = (line[key] for key in (name, "null", "claimed"))
    if line["unit"] == "×":
        value, null, claimed = (np.log(max(each, 0.0) or np.nan) for each in (value, null, claimed))
    return (value - null) / (claimed - null) if claimed != null else np.nan


def _measured(line: dict) -> str:
    """The effect in its own unit and its verdict, two lines."""
    if not line["n"]:
        return "not measured"
    form = "+.2f" if line["unit"] == "dB" else ""
    found = interval_text(line, "value", form, f" {line['unit']}".rstrip()) if line["n"] > 1 else digits(line["value"])
    return f"{found}\n{line['verdict']}"


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
