"""Figure: the landscape along one or several trainings, from the table that `landscape trajectory` wrote.

`python -m figures.trajectory OUT/trajectories.csv` draws beside the table.  Every panel has a logarithmic axis of magnitudes,
hollow where the number is negative, and the same steps; what is left off, as it is 0 within round-off of the panel's largest,
the legend says.  A method has one colour, its trainings differ by their lines.  The title says what became of the steepest
curvature of each method.
"""

import textwrap
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from analysis.console.failures import program
from analysis.records.quantities import extent
from analysis.records.run_files import ENDS, read_trajectory
from figures.scripts import table_script
from figures.style import BLACK, RUNS, few_decades, literal, new_figure, style
from landscape.errors import InputError

PANELS = {
    "lambda_max": ENDS["lambda_max"],
    "lambda_min": ENDS["lambda_min"],
    "trace_quats": "trace of rotation",
    "trace_means": "trace of position",
    "participation_ratio": "participation ratio",
    "gaussians": "Gaussians",
}
UNITS = (
    "traces, eigenvalues: loss per squared unit of the parameters\n"
    "bands: 95% (traces), residuals (eigenvalues), else brackets"
)
NEGATIVE, LINES = "−λ min", ("-", "--", ":", "-.")  # title where all are negative; of the trainings of a method
ROUND_OFF = float(np.finfo(np.float32).eps)
PANEL, ROOM = 1.12, 0.08  # inches of height; of the steps, beside them
LEGEND_LINE, WRAP = 0.14, 58
ARROW: dict[str, Any] = {"marker": r"$\uparrow$", "markersize": 7, "linestyle": "none"}  # stands on a lower bound


def draw(table: pd.DataFrame) -> Figure:
    """table: rows of `analysis/train/trajectory.py`, with the name of the run that each belongs to as "run".

    Raises InputError where nothing was measured.
    """
    measured = with_ends(pd.DataFrame(table[table["state"] != "skipped"]))
    if measured["lambda_max"].dropna().empty:
        raise InputError("expected at least one record that was not skipped, got none")
    if negative := not (np.asarray(measured["lambda_min"], dtype=float) >= 0).any():
        low, at, high = (-measured[f"lambda_min{end}"] for end in ("_high", "", "_low"))
        measured = measured.assign(lambda_min_low=low, lambda_min=at, lambda_min_high=high)
    first, last = (float(end(measured["step"].to_numpy(float))) for end in (np.min, np.max))
    room = ROOM * (last - first) or 1.0
    methods: dict[str, list[str]] = {}
    for name in map(str, table["run"].unique()):
        methods.setdefault(name.rpartition("/")[0] or name, []).append(name)
    runs: dict[str, dict[str, Any]] = {
        name: {"color": RUNS[i % len(RUNS)], "linestyle": LINES[k % len(LINES)]}
        for i, names in enumerate(methods.values())
        for k, name in enumerate(names)
    }
    with style():
        figure = new_figure(PANEL * 3 + LEGEND_LINE * (len(methods) + len(runs) + 6))
        for axes, (name, title) in zip(figure.subplots(3, 2).flat, PANELS.items(), strict=True):
            axes.set_title(NEGATIVE if negative and name == "lambda_min" else literal(title))
            over_steps(axes, measured, runs, name)
            axes.set_xlim(first - room, last + room)
            axes.grid(True)
            axes.xaxis.set_major_locator(step_ticks())
            if not any(np.isfinite(line.get_ydata()).any() for line in axes.lines):
                axes.set(xticks=[], yticks=[], xlabel="")
                axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
        for axes in figure.axes[-2:]:
            axes.set_xlabel("step")
        title = "\n".join(_happened(*each, measured) for each in methods.items())
        figure.suptitle(title, fontsize=7.5, x=0.02, ha="left")
        handles = [Line2D([], [], label=literal(name), **look) for name, look in runs.items()]
        handles += marker_words(measured, *PANELS)
        handles.append(Line2D([], [], linestyle="none", label=UNITS))
        figure.legend(handles=handles, loc="outside lower center", ncols=1)
    return figure


def with_ends(measured: pd.DataFrame) -> pd.DataFrame:
    """The rows with both ends of an interval for every panel: of eigenvalues from their errors, exact for the Gaussians."""
    errors = {name: measured[f"{name}_error"] for name in ENDS} | {"gaussians": 0.0}
    low = {f"{name}_low": measured[name] - error for name, error in errors.items()}
    high = {f"{name}_high": measured[name] + error for name, error in errors.items()}
    return measured.assign(**low, **high)


def _happened(method: str, runs: list[str], measured: pd.DataFrame) -> str:
    """What became of the steepest curvature in the trainings of a method, in words."""
    known = [pd.DataFrame(measured[(measured["run"] == run) & (measured["lambda_max"] > 0)]) for run in runs]
    if min(map(len, known)) < 2:
        return literal(f"{method}: one record of λ max")
    grown = extent(float(each["lambda_max"].iloc[-1] / each["lambda_max"].iloc[0]) for each in known)
    some = "one run" if len(runs) == 1 else f"{len(runs)} runs"
    first, last = known[0]["step"].iloc[0], known[0]["step"].iloc[-1]
    return textwrap.fill(literal(f"{method}: λ max × {grown} from step {first:,} to {last:,} ({some})"), WRAP)


def step_ticks() -> MaxNLocator:
    """Locator of a few ticks at steps as round as recorded ones: 100, 200, 300 instead of 120, 180, 240."""
    return MaxNLocator(4, integer=True, steps=[1, 2, 2.5, 5, 10])


def over_steps(axes: Axes, measured: pd.DataFrame, runs: dict[str, dict[str, Any]], name: str) -> None:
    """A number of every run over the steps, its magnitude on a logarithmic axis, with its interval.  runs: name -> look.

    Hollow where it is negative.  Of one with only a lower bound an arrow stands on that, without a line; without one, nothing.
    """
    axes.set_yscale("log")
    axes.margins(ROOM, 0.12)
    least = ROUND_OFF * measured[name].abs().max()
    for run, look_of in runs.items():
        colour = look_of["color"]
        part = pd.DataFrame(measured[(measured["run"] == run) & measured[name].notna()])
        steps, values = part["step"].to_numpy(float), part[name].to_numpy(float)
        ends = np.stack([part[f"{name}_{end}"].to_numpy(float) for end in ("low", "high")])
        bounded, (low, high) = np.isfinite(ends).all(axis=0), np.abs(ends)
        shown = np.where(bounded & (np.abs(values) > least), np.abs(values), np.nan)  # 0 has no place on the axis
        inner = np.where(ends[0] * ends[1] < 0, 0.0, np.fmin(np.fmin(low, high), shown))
        outer = np.fmax(np.fmax(low, high), shown)
        outer[outer <= least] = np.nan
        axes.fill_between(steps, inner, outer, color=colour, alpha=0.25, linewidth=0)
        axes.plot(steps, shown, linewidth=1.1, **look_of)
        for sign, face in ((values >= 0, colour), (values < 0, "white")):
            look: dict[str, Any] = {"markerfacecolor": face, "markersize": 3, "linestyle": "none"}
            axes.plot(steps[sign], shown[sign], "o", color=colour, **look)
        bound = np.fmin(low, high)[~bounded]
        axes.plot(steps[~bounded], np.where(bound > 0, bound, np.nan), color=colour, **ARROW)
    few_decades(axes.yaxis)


def marker_words(measured: pd.DataFrame, *names: str) -> list[Line2D]:
    """Legend of hollow markers, arrows and what is left off, where one of the indices has any."""
    values = measured[list(names)].to_numpy(float)
    ends = np.stack([measured[[f"{name}{end}" for name in names]].to_numpy(float) for end in ("_low", "_high")])
    bounds = np.isfinite(values) & ~np.isfinite(ends).all(axis=0)
    look: dict[str, Any] = {"color": BLACK, "markersize": 3, "linestyle": "none"}
    hollow = Line2D([], [], marker="o", markerfacecolor="white", label="open: the number is negative", **look)
    arrow = Line2D([], [], color=BLACK, label="arrow: at least so large", **ARROW)
    tiny = abs(values) <= ROUND_OFF * np.nanmax(abs(values), axis=0, initial=0)
    left_off = Line2D([], [], linestyle="none", label="left off: 0 within round-off")
    shown = (hollow, ((values < 0) & ~tiny).any()), (arrow, bounds.any()), (left_off, tiny.any())
    return [handle for handle, there in shown if there]


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
