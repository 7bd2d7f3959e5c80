"""Figure after the paper's Fig. 7: the anisotropy index over two trainings, where they ended, and where they began.

`python -m figures.fig7 RUN_3DGS RUN_STABLEGS --out fig7.png`.  Above: |lambda_max / lambda_min| (Eq. (3); open:
negative) with its bracket, of records of a training, which confirm no end by renders, behind it the range of all seeds where
the runs are a sweep's METHOD/SEED, and the loss around both checkpoints along the two steepest eigenvectors.  Below: the same
around the start of the first run, and sections through all three along e_1 and e_2.  All axes are those of the two ends
(`manifold`), but for the start's surface, whose title says how much farther it reaches (a start may be hundreds of times wider
than an end), and the sections' losses, which hold the sections alone.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.console.failures import program
from analysis.records.quantities import rough
from analysis.records.run_files import RECORDS, read_trajectory
from figures.manifold import Scale, landscape_of, require_same_function, runs_script, section, start_of, surface
from figures.style import BLUE, RUNS, literal, new_figure, style
from figures.trajectory import marker_words, over_steps, step_ticks
from landscape.errors import InputError

PAGE = 6.9  # inches
BEGINNING, UNIT = "start", "e₁, e₂: units of the parameters"
BAR: dict[str, Any] = {"shrink": 0.6, "aspect": 14}  # without a name: the title above has it


def draw(runs: Sequence[Path]) -> Figure:
    """Fig. 7 of two runs.  ValueError names every record that is missing, each with the command that makes it."""
    names = names_of(runs)
    *found, start = read_all(
        *(partial(_measured, run, name) for run, name in zip(runs, names, strict=True)),
        *(partial(landscape_of, run) for run in runs),
        partial(start_of, runs[0]),
    )
    measured, ends = pd.concat(found[:2], ignore_index=True), found[2:]
    require_same_function(runs)
    scale, wide = Scale.of(*ends), Scale.of(start)
    across = scale.of_sections(*ends, start)
    with style():
        figure = new_figure(4.4, PAGE)
        index = figure.add_subplot(2, 3, 1)
        over_steps(
            index,
            measured,
            {name: {"color": each} for name, each in zip(names, RUNS, strict=False)},
            "eigenvalue_ratio",
        )
        counts = [_seeds(index, *each) for each in zip(runs, names, RUNS, strict=False)]
        of = "one training each" if max(counts) == 1 else f"bands: {' and '.join(map(str, sorted({*counts})))} seeds"
        title = f"Anisotropy index, {of}\n(no renders confirm its eigenvalues)"
        index.set(xlabel="step", ylabel="|λ max / λ min|", title=title)
        index.xaxis.set_major_locator(step_ticks())
        index.grid(True)
        drawn = [surface(figure, (2, 3, 2 + i), end, scale, f"{names[i]}, end") for i, end in enumerate(ends)]
        figure.colorbar(drawn[0][1], ax=[axes for axes, _ in drawn], **BAR)
        wider = rough(wide.reach / scale.reach)
        title = f"{BEGINNING} of {names[0]}, a window\n{wider} times as wide as at the last checkpoints"
        around, colours = surface(figure, (2, 3, 4), start, wide, title)
        figure.colorbar(colours, ax=around, **BAR)
        for axis, direction in enumerate(("e₁", "e₂")):
            axes = figure.add_subplot(2, 3, 5 + axis)
            section(axes, start, across, axis, color=BLUE, linestyle="--")
            for end, colour in zip(ends, RUNS, strict=False):
                section(axes, end, across, axis, color=colour)
            axes.set(xlabel=across.flat_label(direction), ylabel=across.loss_label, title=f"Section along {direction}")
        handles = [figure.axes[-1].lines[i] for i in (1, 2, 0)]
        for line, name in zip(handles, (*names, BEGINNING), strict=True):
            line.set_label(literal(name))
        figure.legend(
            handles=[
                *handles,
                *marker_words(measured, "eigenvalue_ratio"),
                Line2D([], [], linestyle="none", label=UNIT),
            ],
            loc="outside lower center",
            ncols=5,
        )
    return figure


def names_of(runs: Sequence[Path]) -> list[str]:
    """Names of the folders; those of their parents where the folders have the same name, as with a sweep's METHOD/SEED."""
    if len(runs) != 2:
        raise InputError(f"expected two runs, of 3DGS and of StableGS, got {len(runs)}")
    first, second = (run.resolve() for run in runs)
    if first == second:
        raise InputError(f"expected two different runs, got {runs[0]} twice")
    while first.name == second.name:
        first, second = first.parent, second.parent
    return [first.name, second.name]


def read_all(*reads: Callable[[], Any]) -> list[Any]:
    """Results of all readers.  ValueError with a line for everything that is missing or wrong."""
    found, missing = [], []
    for read in reads:
        try:
            found.append(read())
        except (FileNotFoundError, ValueError) as error:
            missing.append(str(error))
    if missing:
        raise InputError("\n".join(missing))
    return found


def _measured(run: Path, name: str) -> pd.DataFrame:
    """The run's records of its training, under its name."""
    if not (run / RECORDS).is_file():
        raise FileNotFoundError(f"expected {RECORDS} in the run {run}, found none; train anew with --probe-every")
    table = read_trajectory(run / RECORDS)
    table = pd.DataFrame(table[table["state"] != "skipped"]).assign(run=name)
    if table.empty:
        raise InputError(f"expected records in {run / RECORDS}, all were skipped")
    return table


def _seeds(axes: Axes, run: Path, name: str, colour: str) -> int:
    """Draw the range of the index over the seeds beside a sweep's run of this method, where it has bounds; their number."""
    beside = sorted(run.parent.glob(f"*/{RECORDS}")) if name != run.name else [run / RECORDS]
    table = pd.concat(map(read_trajectory, beside), ignore_index=True)
    bounded = np.isfinite(table[["eigenvalue_ratio_low", "eigenvalue_ratio_high"]]).all(axis=1)
    sizes = table[bounded].assign(eigenvalue_ratio=table["eigenvalue_ratio"].abs())
    band = sizes.groupby("step")["eigenvalue_ratio"].agg(["min", "max"])
    axes.fill_between(band.index, band["min"], band["max"], color=colour, alpha=0.15, linewidth=0)
    return len(beside)


if __name__ == "__main__":
    program(partial(runs_script, draw, "fig7"))
