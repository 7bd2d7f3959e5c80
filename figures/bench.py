"""Figure: how time grows with Gaussians, pixels, views and (on the CPU) threads, on logarithmic axes, from a bench.csv.

`python -m figures.bench BENCH/bench.csv` draws it beside the table.  The grey lines have slope 1 (threads: slope -1).
"""

from functools import partial
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from analysis.console.failures import program
from figures.scripts import table_script
from figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, literal, new_figure, style

LABELS = {"gaussians": "Gaussians", "pixels": "pixels", "views": "views", "threads": "threads"}
LOOKS = {
    "gradient": ("gradient", BLACK, "o"),
    "linearize": ("linearisation", ORANGE, "s"),
    "H v 1": ("H v, K = 1", VERMILION, "^"),
    "H v 4": ("H v, K = 4, each", BLUE, "v"),
    "H v 8": ("H v, K = 8, each", GREEN, "D"),
}


def draw(table: pd.DataFrame) -> Figure:
    """Minimum times of what was scaled; table: the lines of bench.csv."""
    with style():
        figure = new_figure(3.2)
        panels = figure.subplots(2, 2, sharey=True)
        for axes, (study, label) in zip(panels.flat, LABELS.items(), strict=True):
            lines = pd.DataFrame(table[table["study"] == study])
            axes.set_visible(not lines.empty)
            if not lines.empty:
                _panel(axes, lines, study)
            axes.set_xlabel(label)
        for axes in panels[:, 0]:
            axes.set_ylabel("time (ms)")
        scene = str(table.loc[table["study"] == "gaussians", "scene"].iloc[0])
        figure.suptitle(literal(scene), fontsize=7.5)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, handletextpad=0.3, columnspacing=1)
    return figure


def _panel(axes: Axes, lines: pd.DataFrame, study: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(True)
    for stage, (label, colour, marker) in LOOKS.items():
        part = pd.DataFrame(lines[lines["stage"] == stage]).sort_values(by=study)
        axes.plot(
            part[study], part["minimum_ms"], color=colour, marker=marker, markersize=3, linewidth=0.9, label=label
        )
    gradient = pd.DataFrame(lines[lines["stage"] == "gradient"]).sort_values(by=study)
    values, times = gradient[study].to_numpy(float), gradient["minimum_ms"].to_numpy()
    slope = -1 if study == "threads" else 1
    proportional = times[-1] * (values / values[-1]) ** slope
    axes.plot(values, proportional, color="0.75", linewidth=0.8, zorder=0, label="in proportion")
    axes.set_xticks(values, [short(value) for value in values])
    axes.xaxis.set_minor_locator(NullLocator())


def short(count: float) -> str:
    """A count in two or three characters.

    >>> short(3), short(1261), short(190512), short(762048)
    ('3', '1.3k', '191k', '762k')
    """
    if count < 1000:
        return f"{count:g}"
    thousands = count / 1000
    return f"{thousands:.1f}k" if thousands < 9.95 else f"{thousands:.0f}k"


def draw_named(path: Path) -> list[tuple[str, Figure]]:
    """The figure of a bench.csv, named as that is."""
    return [(path.stem, draw(pd.read_csv(path)))]


if __name__ == "__main__":
    what = "the scaling recorded by `landscape bench` beside its table"
    program(partial(table_script, draw_named, what, "bench.csv", "bench"))
