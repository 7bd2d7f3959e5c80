"""Pictures of `landscape prune`, `next-view` and `uncertainty`: `python -m figures.uses RUN/prune`"""

import textwrap
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis.commands.options import GEOMETRY, TWICE
from analysis.console.failures import program
from analysis.records.quantities import quantity
from figures.scripts import folder_script
from figures.style import BLUE, FIELD_MAP, GREEN, ORANGE, PURPLE, SKY, VERMILION, literal, new_figure, save, style
from landscape.errors import InputError
from splat.model.untrusted import read_arrays, read_table

SCORES = {
    "removal_error": ("removal error, loss", VERMILION),
    "removal_error_l2": ("removal error, squared", ORANGE),
    "log_det_11": ("log det, 11 x 11", BLUE),
    "log_det_6": ("log det, 6 x 6 (PUP)", SKY),
    "gn_diagonal": ("Gauss-Newton diagonal", GREEN),
    "opacity": ("opacity", "black"),
    "size_opacity": ("size x opacity", PURPLE),
}
MEASURES = {"train_psnr": "training views, PSNR (dB)", "test_psnr": "held-out views, PSNR (dB)"}
WRAP, HALF = 54, 26  # characters in a line of the figure, and in half of one


def _rows(table: pd.DataFrame, **known: str | bool) -> Any:
    """Rows of a table with these values."""
    for name, value in known.items():
        table = table.loc[table[name] == value]
    return table


def draw_curve(curve: pd.DataFrame) -> Figure:
    """PSNR by the share of Gaussians removed; crosses: after some steps of training."""
    measures = [name for name in MEASURES if name in curve]
    curve = curve.assign(refined=curve["steps"] > 0)
    with style():
        figure = new_figure(2.6, 3.3 * len(measures))
        for axes, measure in zip(figure.subplots(1, len(measures), squeeze=False)[0], measures, strict=True):
            for name, (words, colour) in SCORES.items():
                plain, after = (_rows(curve, score=name, refined=refined) for refined in (False, True))
                axes.plot(100 * plain["removed"], plain[measure], color=colour, label=words, marker=".", markersize=3)
                axes.plot(100 * after["removed"], after[measure], color=colour, marker="x", linestyle="none")
            axes.set(xlabel="Gaussians removed (%)", ylabel=MEASURES[measure])
            axes.grid(visible=True)
        steps = curve.steps.max()
        title = f"x: after {steps} steps of training" if steps else None
        axes.legend(title=title, loc="lower left", title_fontsize=6.5)  # pyright: ignore[reportPossiblyUnboundVariable]
    return figure


def draw_gains(table: pd.DataFrame) -> Figure:
    """How far every candidate is behind the best, with twice its error, the picks first; the best by other rules are named."""
    best, reach = {rule: np.nanargmax(table[rule].to_numpy(float)) for rule in GEOMETRY}, TWICE * table["error"]
    labels = []
    for place, (view, pick) in enumerate(zip(table["view"].tolist(), table["pick"].tolist(), strict=True)):
        named = [f"pick {pick:.0f}"] * (float(pick) > 0) + [rule for rule, at in best.items() if at == place]
        words = f"{Path(str(view)).name} ({', '.join(named)})" if named else Path(str(view)).name
        labels.append(literal(textwrap.fill(words, HALF)))
    lines = np.array([1 + label.count("\n") for label in labels])
    rows, equal = lines.cumsum() - lines / 2, int(np.sum(table["behind"] <= reach))
    said = f"{equal} of {len(table)} candidates are equal within twice their error"
    with style():
        figure = new_figure(1.0 + 0.16 * lines.sum())
        axes = figure.subplots()
        axes.errorbar(-table["behind"], rows, xerr=reach, fmt="o", color=BLUE, markersize=3, linewidth=0.8)
        axes.set_yticks(rows, labels)
        axes.invert_yaxis()
        axes.xaxis.set_major_locator(MaxNLocator(3))
        words = "gain less that of the best, ± twice the error of the difference"
        figure.supxlabel(textwrap.fill(words, WRAP), fontsize=7)
        one = "One candidate is better than all others by more than twice the error"
        figure.suptitle(textwrap.fill(said if equal > 1 else one, WRAP), fontsize=7.5)
        axes.grid(visible=True)
    return figure


PICTURES = {"curve": draw_curve, "gains": draw_gains}


def draw_uncertainty(path: Path) -> Figure:
    """A held-out view: its photograph, its error, and the standard deviations of its pixels by blocks and by the diagonal."""
    words = {
        "photograph": "photograph",
        "error": "|error|",
        "block": "uncertainty (blocks)",
        "diagonal": "uncertainty (diagonal)",
    }
    maps = read_arrays(path)
    with style():
        height, width = maps["error"].shape
        figure = new_figure(6.6 / len(words) * height / width + 0.4, 6.6)
        for axes, (name, title) in zip(figure.subplots(1, len(words)), words.items(), strict=True):
            top = None if name == "photograph" else np.quantile(maps[name], 0.99) or 1.0
            axes.imshow(maps[name], cmap=FIELD_MAP, vmin=0, vmax=top)
            scale = "" if top is None else f"from 0 to {quantity(float(top))}"
            axes.set(title=title, xticks=[], yticks=[], xlabel=scale)
    return figure


def draw(folder: Path, suffix: str = "png") -> list[Path]:
    """Draw the pictures whose numbers are in the folder; returns their files."""
    views, tables = sorted(folder.glob("view-*.npz")), [name for name in PICTURES if (folder / f"{name}.csv").is_file()]
    if not (views or tables):
        raise InputError(
            f"expected what landscape prune --curve, next-view or uncertainty writes in {folder}, found none"
        )
    return [save(draw_uncertainty(path), path.with_suffix(f".{suffix}")) for path in views] + [
        save(PICTURES[name](read_table(folder / f"{name}.csv")), folder / f"{name}.{suffix}") for name in tables
    ]


if __name__ == "__main__":
    program(partial(folder_script, draw, "what curvature is good for", "prune"))
