"""Figure: the landscape along one or several trainings, from the table that `landscape trajectory` wrote.

`python -m figures.trajectory OUT/trajectories.csv` draws beside the table.  Bands show 95% intervals of the traces, residuals
of the eigenvalues, and brackets of the indices; a triangle is a lower bound, where no more is known of an index.  An axis is
logarithmic where all of its values are positive and span more than a decade.  |lambda_max / lambda_min| has hollow markers
where the quotient is negative.
"""

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from analysis.console.failures import program
from analysis.records.findings import ATTRIBUTES, attribute_name
from analysis.records.quantities import exponent_of, power_of_ten, unit_suffix
from analysis.records.run_files import ENDS, read_trajectory
from figures.scripts import table_script
from figures.style import BLACK, RUNS, literal, new_figure, style
from landscape.errors import InputError

INDICES = {"eigenvalue_ratio": "|λmax / λmin|", "participation_ratio": "participation ratio"}
UNITS = "traces, eigenvalues: loss per squared stored unit"
PANEL = 1.12  # inches of height
LEGEND_LINE = 0.14


def draw(table: pd.DataFrame) -> Figure:
    """table: rows of `analysis/train/trajectory.py`, with the name of the run that each belongs to as "run".

    Raises InputError where nothing was measured.
    """
    measured = pd.DataFrame(table[table["state"] != "skipped"])
    if measured["lambda_max"].dropna().empty:
        raise InputError(
            "expected at least one record that was not skipped, got none; train with a larger --probe-share"
        )
    runs = {str(name): RUNS[i % len(RUNS)] for i, name in enumerate(table["run"].unique())}
    with style():
        figure = new_figure(PANEL * 5 + LEGEND_LINE * (len(runs) + 5))
        panels = figure.subplots(5, 2)
        for axes, name in zip(panels.flat, ATTRIBUTES, strict=False):
            columns = f"trace_{name}", f"trace_{name}_low", f"trace_{name}_high"
            _bands(axes, measured, runs, columns, f"trace of {attribute_name(name)}")
        _gaussians(panels[2, 1], table, runs)
        for axes, (name, title) in zip(panels[3], ENDS.items(), strict=True):
            error = measured[f"{name}_error"]
            known = measured.assign(low=measured[name] - error, high=measured[name] + error)
            _bands(axes, known, runs, (name, "low", "high"), title)
        for axes, (name, title) in zip(panels[4], INDICES.items(), strict=True):
            axes.set_title(title)
            index_over_steps(axes, measured, runs, name)
            axes.set_xlabel("step")
        for axes in panels.flat:
            axes.grid(True)
            axes.xaxis.set_major_locator(step_ticks())
            if not any(np.isfinite(line.get_ydata()).any() for line in axes.lines):
                axes.set(xticks=[], yticks=[], xlabel="")
                axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
        handles = [Line2D([], [], color=colour, label=literal(name)) for name, colour in runs.items()]
        handles += marker_words(measured, *INDICES)
        handles.append(Line2D([], [], linestyle="none", label=UNITS))
        figure.legend(handles=handles, loc="outside lower center", ncols=1)
    return figure


def step_ticks() -> MaxNLocator:
    """Locator of a few ticks at steps as round as recorded ones: 100, 200, 300 instead of 120, 180, 240."""
    return MaxNLocator(4, integer=True, steps=[1, 2, 2.5, 5, 10])


def index_over_steps(axes: Axes, measured: pd.DataFrame, runs: dict[str, str], name: str) -> None:
    """An index of every run over the steps, its magnitude on a logarithmic axis, with its bracket.  runs: name -> colour.

    Hollow where it is negative.  Of one that has only a lower bound, the bound is drawn, as a triangle; without one, nothing.
    The first run is drawn broad, below the others, so that it is seen where another one coincides with it.
    """
    axes.set_yscale("log")
    for place, (run, colour) in enumerate(runs.items()):
        broad = 1.0 if place or len(runs) == 1 else 2.2
        part = pd.DataFrame(measured[(measured["run"] == run) & measured[name].notna()])
        steps, values = part["step"].to_numpy(float), part[name].to_numpy(float)
        magnitudes = np.abs(values)
        ends = np.stack([np.abs(part[f"{name}_low"].to_numpy(float)), np.abs(part[f"{name}_high"].to_numpy(float))])
        unbounded = ~np.isfinite(ends).all(axis=0)
        low = np.fmin(np.nanmin(ends, axis=0, initial=np.inf), magnitudes)
        shown = np.where(unbounded, low, magnitudes)
        shown[shown == 0] = np.nan  # for which a logarithmic axis has no place
        high = np.where(unbounded, shown, np.fmax(ends.max(axis=0), magnitudes))
        axes.fill_between(steps, np.where(shown > 0, low, np.nan), high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(steps, shown, color=colour, linewidth=1.1 * broad)
        for kind, marker in ((~unbounded, "o"), (unbounded, "^")):
            for sign, face in ((values >= 0, colour), (values < 0, "white")):
                chosen = kind & sign
                axes.plot(
                    steps[chosen], shown[chosen], marker, color=colour, markerfacecolor=face, markersize=3 * broad,
                    linestyle="none",
                )  # fmt: skip
    _few_decades(axes)


def marker_words(measured: pd.DataFrame, *names: str) -> list[Line2D]:
    """Legend of hollow markers and triangles, where one of the indices has any."""
    values = measured[list(names)].to_numpy(float)
    ends = np.stack([measured[[f"{name}{end}" for name in names]].to_numpy(float) for end in ("_low", "_high")])
    bounds = np.isfinite(values) & ~np.isfinite(ends).all(axis=0)
    look: dict[str, Any] = {"color": BLACK, "markersize": 3, "linestyle": "none"}
    hollow = Line2D([], [], marker="o", markerfacecolor="white", label="open: the index is negative", **look)
    triangle = Line2D([], [], marker="^", label="triangle: at least so large", **look)
    return [hollow] * bool((values < 0).any()) + [triangle] * bool(bounds.any())


def _bands(axes: Axes, measured: pd.DataFrame, runs: dict[str, str], columns: tuple[str, str, str], title: str) -> None:
    """Curves of every run with their bands.  columns: of the values, and of both ends of the bands."""
    lowest = float(np.nanmin(measured[columns[1]].to_numpy(float)))
    highest = float(np.nanmax(measured[columns[2]].to_numpy(float)))
    logarithmic = lowest > 0 and highest > 10 * lowest
    exponent = 0 if logarithmic else exponent_of(measured[columns[0]].to_numpy(float))
    axes.set_title(f"{literal(title)}\n{unit_suffix(exponent).strip()}".strip())
    for run, colour in runs.items():
        part = pd.DataFrame(measured[measured["run"] == run])
        value, low, high = (part[name].to_numpy(float) / 10.0**exponent for name in columns)
        axes.fill_between(part["step"], low, high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(part["step"], value, "-o", color=colour, markersize=2)
    if logarithmic:
        axes.set_yscale("log")
        _few_decades(axes)
    else:
        axes.yaxis.set_major_locator(MaxNLocator(4))


def _gaussians(axes: Axes, table: pd.DataFrame, runs: dict[str, str]) -> None:
    axes.set_title("Gaussians")
    for run, colour in runs.items():
        part = table[table["run"] == run]
        axes.plot(part["step"], part["gaussians"], "-o", color=colour, markersize=2)
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))


def _few_decades(axes: Axes) -> None:
    """Ticks of a logarithmic axis: decades, or where it spans less than two of them, also 2 and 5."""
    low, high = axes.get_ylim()
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100 * low else (1.0,), numticks=6))
    axes.yaxis.set_major_formatter(FuncFormatter(_tick))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _tick(value: float, _: int | None) -> str:
    """
    >>> _tick(20.0, None), _tick(1e-5, None), _tick(5e-5, None)
    ('20', '10⁻⁵', '5×10⁻⁵')
    """
    exponent = math.floor(math.log10(value) + 1e-9)
    if -3 <= exponent <= 3:
        return f"{value:g}"
    leading = round(value / 10.0**exponent)
    return power_of_ten(exponent) if leading == 1 else f"{leading}×{power_of_ten(exponent)}"


def draw_named(path: Path) -> list[tuple[str, Figure]]:
    """The figure of a trajectories.csv, named as that is.  InputError where the path is a folder."""
    if path.is_dir():
        raise InputError(
            f"expected the table trajectories.csv as written by landscape trajectory, got the folder {path}; "
            "name the table in it, or run landscape trajectory on the runs"
        )
    return [(path.stem, draw(read_trajectory(path)))]


if __name__ == "__main__":
    what = "the landscape along trainings, as written by `landscape trajectory`"
    program(partial(table_script, draw_named, what, "trajectories.csv", "trajectory"))
