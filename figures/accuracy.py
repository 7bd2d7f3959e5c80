"""Figures: true error against products H v, a panel a case, one figure a quantity, from a recorded accuracy.csv.

`python -m figures.accuracy BENCH/accuracy.csv` draws accuracy_QUANTITY beside the table.  Lines join the settings of a
method; down and to the left is better.  The star is the library's default.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from analysis.console.failures import program
from figures.scripts import table_script
from figures.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, literal, new_figure, style
from splat.model.untrusted import read_table

COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, "0.45", BLACK, "saddlebrown", "olive")
LINES = {"own": ("-", "o"), "peer": ("--", "^")}
PANEL = 1.5  # inches of height
LEGEND_LINE = 0.14


def draw(table: pd.DataFrame, quantity: str) -> Figure:
    """The cases of one quantity; table: the lines of accuracy.csv."""
    part = pd.DataFrame(table[table["quantity"] == quantity])
    cases = list(part["case"].unique())
    names = {origin: sorted(part.loc[part["origin"] == origin, "method"].unique()) for origin in LINES}
    looks = {
        (origin, name): (COLOURS[i % len(COLOURS)], *LINES[origin])
        for origin, found in names.items()
        for i, name in enumerate(found)
    }
    rows = -(-len(cases) // 2)
    with style():
        figure = new_figure(PANEL * rows + LEGEND_LINE * (len(looks) + 1))
        panels = figure.subplots(rows, 2, squeeze=False)
        for axes, case in zip(panels.flat, cases, strict=False):
            _panel(axes, pd.DataFrame(part[part["case"] == case]), looks)
            axes.set_title(literal(str(case)))
        for axes in panels.flat[len(cases) :]:
            axes.set_visible(False)
        for axes in panels[:, 0]:
            axes.set_ylabel("true error")
        for axes in panels.flat[max(len(cases) - 2, 0) : len(cases)]:  # the lowest of each column
            axes.set_xlabel("products H v")
        handles = {label: h for axes in panels.flat for h, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        figure.suptitle(literal(quantity), fontsize=7.5)
        figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=1, handletextpad=0.4)
    return figure


def _panel(axes: Axes, part: pd.DataFrame, looks: dict[tuple[str, str], tuple[str, str, str]]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(True)
    for (origin, method), (colour, line, marker) in looks.items():
        points = part[(part["origin"] == origin) & (part["method"] == method) & np.isfinite(part["true_error"])]
        points = pd.DataFrame(points).sort_values(by="matvecs")
        axes.plot(
            points["matvecs"], points["true_error"], line, color=colour, marker=marker, markersize=2.5, linewidth=0.8,
            label=literal(method),
        )  # fmt: skip
    default = part[part["origin"] == "default"]
    axes.plot(default["matvecs"], default["true_error"], "*", markersize=7, color=BLACK, label="default")


def draw_all(path: Path) -> Iterator[tuple[str, Figure]]:
    """A figure for each quantity of accuracy.csv, and the name of its file."""
    table = read_table(path)
    for quantity in table["quantity"].unique():
        words = "".join(c if c.isalpha() else "_" for c in quantity).strip("_")
        yield f"accuracy_{words}", draw(table, quantity)


if __name__ == "__main__":
    what = "error against work as recorded by `landscape bench accuracy`"
    program(partial(table_script, draw_all, what, "accuracy.csv", "bench accuracy"))
