"""Figure: training loss and held-out PSNR of steps of second order beside Adam, over seconds and over passes.

Lines: means over the seeds that have ended, at equal steps; bands: from the lowest seed to the highest.
"""

import pandas as pd
from matplotlib.figure import Figure

from figures.style import RUNS, literal, new_figure, style

ACROSS = {"cpu": "seconds of one processor", "passes": "passes over the pixels of a view"}
UP = {"loss": "training loss", "held_out": "held-out PSNR, dB"}
PAGE = 6.9


def draw_scene(table: pd.DataFrame) -> Figure:
    """table: the rows of one scene."""
    with style():
        figure = new_figure(4.2, PAGE)
        panels = figure.subplots(2, 2, sharex="col", sharey="row")
        for colour, (name, rows) in zip(RUNS, table.groupby("method", sort=False), strict=False):
            by_step = rows.groupby("step")
            for i, y in enumerate(UP):
                for j, x in enumerate(ACROSS):
                    across = by_step[x].mean()
                    panels[i, j].plot(across, by_step[y].mean(), color=colour, label=literal(str(name)))
                    panels[i, j].fill_between(
                        across, by_step[y].min(), by_step[y].max(), color=colour, alpha=0.2, linewidth=0
                    )
        for i, (y, words) in enumerate(UP.items()):
            panels[i, 0].set_ylabel(words)
            for axes in panels[i]:
                axes.grid(True)
                if y == "loss":
                    axes.set_yscale("log")
        for j, words in enumerate(ACROSS.values()):
            panels[1, j].set_xlabel(words)
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle("lines: means over the seeds; bands: from the lowest to the highest", fontsize=7)
    return figure
