"""`landscape trajectory`: the records along several trainings (`analysis/train/trajectory.py`) in one table and one picture.

OUT/trajectories.csv    the rows of all runs, each with its "run": the run's folder, from the one that holds them all
OUT/trajectories.png    drawn by `figures/trajectory.py`, which also draws PDF
"""

import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from analysis.console.drawing import draw
from analysis.console.plain import say
from analysis.records.findings import ATTRIBUTES, attribute_name
from analysis.records.quantities import measured, quantity
from analysis.records.run_files import CHECKPOINT, ENDS, RECORDS, TRAJECTORY_INDICES, read_trajectory
from analysis.records.schema import Index
from analysis.records.tables import bracketed
from analysis.runs.options import TrajectoryOptions
from landscape.errors import InputError
from splat.model.untrusted import replacing

TABLE, PICTURE = "trajectories.csv", "trajectories.png"
ROUND_OFF = 2.0**-21  # of a trace in single precision, over the largest of the same record
VALUES = {f"trace_{name}": f"trace of {attribute_name(name)}" for name in ATTRIBUTES} | ENDS


def run_trajectory(options: TrajectoryOptions) -> int:
    """Gather, draw, print; returns the exit code."""
    table = gathered(options.runs)
    _require_same_function(options.runs)
    common = Path(os.path.commonpath([run.resolve() for run in options.runs]))
    out = options.out or common / "trajectory"
    out.mkdir(parents=True, exist_ok=True)
    path, console = out / TABLE, Console()
    with replacing(path) as partial:
        table.to_csv(partial, index=False, errors="backslashreplace")
    console.print(first_and_last(table))
    doubt = "* the ratio rests on eigenvalues that no renders have confirmed: landscape probe renders them"
    say(doubt, console=console)
    if len(versions := table.filter(["of_formulas"]).dropna().drop_duplicates()) > 1:
        say(f"records of {len(versions)} versions of the formulas do not compare: train again", style="yellow")
    (out / PICTURE).unlink(missing_ok=True)
    say(*draw("trajectory", path), style="yellow", console=console)
    drawn = f"picture: {out / PICTURE}; " if (out / PICTURE).is_file() else ""
    say(f"{drawn}numbers: {path}", console=console)
    return 0


def _require_same_function(runs: Sequence[Path]) -> None:
    """ValueError where the curvatures of the runs that have a checkpoint are those of different functions."""
    from analysis.runs.compare import require_same  # these need torch, which no refusal above waits for
    from splat.training.checkpoint import load_checkpoint

    kept = {str(run): run / CHECKPOINT for run in runs if (run / CHECKPOINT).is_file()}
    if len(kept) > 1:
        require_same(list(kept), [load_checkpoint(path) for path in kept.values()])


def gathered(runs: Sequence[Path]) -> pd.DataFrame:
    """The rows of all runs.  FileNotFoundError or ValueError where a run has none, or is named twice."""
    folders = [run.resolve() for run in runs]
    if not folders:
        raise InputError("expected at least one run, got none; name the folders that landscape train wrote")
    if len(set(folders)) < len(folders):
        raise InputError(f"expected every run once, got {', '.join(str(run) for run in runs)}")
    common = Path(os.path.commonpath(folders))
    tables = []
    for run, folder in zip(runs, folders, strict=True):
        path = folder / RECORDS
        if not folder.is_dir():
            raise FileNotFoundError(f"expected the folder of a run, {run} does not exist; name another")
        if not path.is_file():
            raise FileNotFoundError(
                f"expected {RECORDS} in the run {run}, found none; train with --probe-every, as in "
                f"landscape train SCENE --out {shlex.quote(f'{run}-along')} --probe-every 500"
            )
        table = read_trajectory(path)
        name = folder.name if folder == common else folder.relative_to(common).as_posix()
        table.insert(0, "run", name)
        tables.append(table)
    together = pd.concat(tables, ignore_index=True)
    if set(together["state"]) == {"skipped"}:
        note = str(together["note"].iloc[-1]) if "note" in together else "why is not said"
        raise InputError(f"expected at least one record that was not skipped, got {len(together)} skipped ({note})")
    return together


def first_and_last(table: pd.DataFrame) -> Table:
    """The first and the last record of every run that were measured."""
    result = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    result.add_column("")
    for name in ("first", "last"):
        result.add_column(name, justify="right", no_wrap=True)
    for run, rows in table.groupby("run", sort=False):
        known = rows[rows["state"] != "skipped"]
        skipped = len(rows) - len(known)
        result.add_section()
        if known.empty:
            result.add_row(f"{escape(str(run))}: all {skipped} records were skipped", "", "")
            continue
        ends: list[Mapping[str, Any]] = [known.iloc[0], known.iloc[-1]]
        note = f" ({skipped} skipped)" if skipped else ""
        result.add_row(
            f"[bold]{escape(str(run))}[/]{note}", *(f"step {end['step']:,} ({end['state']})" for end in ends)
        )
        result.add_row("Gaussians", *(f"{end['gaussians']:,}" for end in ends))
        for key, title in VALUES.items():
            result.add_row(title, *(_measured(end, key) for end in ends))
        for key in TRAJECTORY_INDICES:
            mark = "*" if key.endswith("_ratio") and key != "participation_ratio" else ""
            result.add_row(key.replace("_", " ") + mark, *(_bracketed(end, key) for end in ends))
    return result


def _measured(row: Mapping[str, Any], key: str) -> str:
    """Value and error; 0 for an exact trace that round-off alone may have made."""
    value, error = _known(row[key]), _known(row[f"{key}_error"])
    traces = [abs(_known(row[name]) or 0.0) for name in VALUES if name not in ENDS]
    if key not in ENDS and value is not None and error == 0 and abs(value) <= ROUND_OFF * max(traces):
        return quantity(0.0)
    return measured(value, error)


def _bracketed(row: Mapping[str, Any], key: str) -> str:
    value, low, high = (_known(row[name]) for name in (key, f"{key}_low", f"{key}_high"))
    if low is None or high is None:
        return bracketed(Index(value=value, low=low, high=high, note="")).value
    return f"{quantity(value)}\n{quantity(low)} to {quantity(high)}"


def _known(number: float) -> float | None:
    return None if pd.isna(number) else float(number)
