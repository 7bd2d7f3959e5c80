"""Results of the cells of a sweep: a row a cell, and mean and standard deviation over the seeds.

OUT/results.csv   scene, method, seed, status ("done", "failed", "under way" or "to do"); once it is trained: psnr (dB),
                  ssim, lpips, avge of the held-out views, train_psnr, ..., gaussians, wall_seconds, cpu_seconds, threads
                  (that its steps might use; none where a resume changed them), peak_memory (bytes of the process), cpu_ratio
                  (of cpu_seconds to those of the first method, of the same scene and seed); where it was probed,
                  trace_ATTRIBUTE, lambda_max, lambda_min, each with its _error (standard error or residual), of the latter
                  also the _reason why the search ended ("... budget": the end may lie farther out), and the anisotropy
                  indices with _low and _high, without value where one of these is unbounded; with the split control,
                  split_INDEX: its factor on the index
OUT/summary.csv   scene, method, and of every number its _mean, its sample standard deviation _std and the count _n
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from msgspec import structs
from rich import box
from rich.table import Table

from analysis.records.findings import attribute_name, of_budgets
from analysis.records.quantities import PLACES, PLUS_MINUS, SCORES, quantity
from analysis.records.records import ProbeRecord, read_record
from analysis.records.run_files import ViewScores, read_scores
from analysis.records.schema import INDICES, Index
from analysis.records.tables import columns_of
from analysis.runs.sweep.sweep_file import Cell, Sweep
from splat.training.checkpoint import write_atomically

RESULTS, SUMMARY, PROBE = "results.csv", "summary.csv", "probe"
TRAINING = SCORES | {"gaussians": "Gaussians", "cpu_ratio": "CPU time ×"}
DECIMALS = PLACES | {"gaussians": 0, "cpu_ratio": 2}
SPLIT = "split_"
REASONS = {"lambda_max_reason": "max", "lambda_min_reason": "min"}
ACROSS = 3  # quantities in a table, each with its deviation: as many as 80 columns hold beside scene and method


def write_results(sweep: Sweep, statuses: Mapping[str, str]) -> pd.DataFrame:
    """Write both files from what lies in the folders; returns the rows.  statuses: of each cell, by name."""
    rows = results(sweep.cells, statuses)
    sweep.out.mkdir(parents=True, exist_ok=True)
    for name, frame in ((RESULTS, rows), (SUMMARY, summarize(rows))):
        write_atomically(sweep.out / name, frame.to_csv(index=False).encode())
    return rows


def results(cells: Sequence[Cell], statuses: Mapping[str, str]) -> pd.DataFrame:
    """A row for each cell, in their order."""
    rows = [
        {"scene": cell.scene, "method": cell.method, "seed": cell.seed, "status": statuses[cell.name]}
        | (metrics_of(cell.out) | probe_of(cell.out) if statuses[cell.name] == "done" else {})
        for cell in cells
    ]
    return with_ratios(pd.DataFrame(rows))


def with_ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with `cpu_ratio`.

    >>> rows = pd.DataFrame({"scene": "fern", "method": ["3dgs", "sam"], "seed": 0, "cpu_seconds": [9.0, 18.0]})
    >>> with_ratios(rows)["cpu_ratio"].tolist()
    [1.0, 2.0]
    """
    if "cpu_seconds" in rows:
        first = rows[rows["method"] == rows["method"].iloc[0]].set_index(["scene", "seed"])["cpu_seconds"]
        keys = pd.MultiIndex.from_arrays([rows["scene"], rows["seed"]])
        rows["cpu_ratio"] = rows["cpu_seconds"] / first.reindex(keys).to_numpy()
    return rows


def summarize(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean, sample standard deviation and count of every number, for each scene and method, in the order of the rows.

    >>> rows = pd.DataFrame({"scene": "fern", "method": "sam", "seed": [0, 1], "status": "done", "psnr": [18.0, 20.0]})
    >>> summarize(rows).round(3).to_dict("records")
    [{'scene': 'fern', 'method': 'sam', 'psnr_mean': 19.0, 'psnr_std': 1.414, 'psnr_n': 2}]
    """
    numbers = [name for name in rows if name not in ("scene", "method", "seed", "status", *REASONS)]
    if not numbers:
        return rows.filter(items=["scene", "method"]).drop_duplicates()
    grouped = rows.groupby(["scene", "method"], sort=False)[numbers].agg(["mean", "std", "count"])
    grouped.columns = [f"{name}_{'n' if what == 'count' else what}" for name, what in grouped.columns]
    return grouped.reset_index()


def metrics_of(run: Path) -> dict[str, float]:
    """Scores, seconds and the number of Gaussians of a run."""
    found = read_scores(run)
    row: dict[str, float] = {}
    for part, prefix in ((found.test, ""), (found.train, "train_")):
        row |= {
            f"{prefix}{key}": _number(value)
            for key, value in structs.asdict(part or ViewScores()).items()
            if key != "views"
        }
    names = {"wall_seconds": "wall", "cpu_seconds": "cpu", "threads": "threads", "peak_memory": "peak"}
    seconds = {column: _number(getattr(found.seconds, name, None)) for column, name in names.items()}
    return row | {"gaussians": found.gaussians} | seconds


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def probe_of(run: Path) -> dict[str, float | str | None]:
    """Traces, ends and indices of the run's record; nothing without one."""
    if not (run / PROBE).is_dir():
        return {}
    data = read_record(run / PROBE, ProbeRecord).data
    row: dict[str, float | str | None] = {}
    for name, trace in data.traces.items():
        row |= {f"trace_{name}": trace.value, f"trace_{name}_error": trace.standard_error}
    ends = {"max": data.eigenvalues.max, "min": data.eigenvalues.min}
    for name, end in ends.items():
        row |= {f"lambda_{name}": end.value, f"lambda_{name}_error": end.residual}
    row |= {name: ends[end].reason or "" for name, end in REASONS.items()}
    for name, index in data.anisotropy.items():
        row |= {name: _bounded(index), f"{name}_low": index.low, f"{name}_high": index.high}
    row |= columns_of(data.measures or {})
    effects = data.split_control.effects if data.split_control else ()
    whole = [effect for effect in effects if (effect.operator, effect.block) == ("hessian", "all")]
    return row | {f"{SPLIT}{effect.index}": _bounded(effect) for effect in whole}


def _bounded(index: Index) -> float | None:
    """The value that a mean may be taken of: none where the number may be without bound."""
    return None if index.low is None or index.high is None else index.value


def unfinished(rows: pd.DataFrame) -> list[str]:
    """Lines on ends of the spectrum that may lie farther out than the means have them, with the cells."""
    cells: dict[str, list[str]] = {}
    for row in rows.reindex(columns=["scene", "method", "seed", *REASONS]).dropna().to_dict("records"):
        for line in of_budgets({end: row[name] for name, end in REASONS.items()}):
            cells.setdefault(line.text, []).append(f"{row['scene']}/{row['method']}/{row['seed']}")
    return [f"{', '.join(names)}: {text}" for text, names in cells.items()]


def tables(summary: pd.DataFrame) -> list[Table]:
    """Scores and time; and, where cells were probed, curvature: mean ± standard deviation."""
    traces = {name: attribute_name(name.removeprefix("trace_")) for name in _columns(summary, "trace_")}
    ends = {"lambda_max": "λ max", "lambda_min": "λ min"}
    indices = {name: name.replace("_", " ") for name in INDICES}
    split = {f"{SPLIT}{name}": title for name, title in indices.items()}
    parts = {
        "mean ± standard deviation over the seeds": TRAINING,
        "traces": traces,
        "extreme eigenvalues": ends,
        "anisotropy": indices,
        "what splitting every Gaussian in two multiplies the anisotropy by": split,
    }
    found = []
    for title, columns in parts.items():
        known = _known(summary, columns)
        groups = [known[i : i + ACROSS] for i in range(0, len(known), ACROSS)]
        found += [_table(summary, title, {name: columns[name] for name in group}) for group in groups]
    return found


def _columns(summary: pd.DataFrame, prefix: str) -> list[str]:
    names = [name.removesuffix("_mean") for name in summary if name.startswith(prefix) and name.endswith("_mean")]
    return [name for name in names if not name.endswith("_error")]


def _known(summary: pd.DataFrame, columns: Mapping[str, str]) -> list[str]:
    return [name for name in columns if f"{name}_n" in summary and summary[f"{name}_n"].to_numpy().any()]


def _table(summary: pd.DataFrame, title: str, columns: Mapping[str, str]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), title=title)
    table.add_column("scene", no_wrap=True)
    table.add_column("method", no_wrap=True)
    table.add_column("n", justify="right")
    for heading in columns.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for row in summary.to_dict("records"):
        most = max(int(row[f"{name}_n"]) for name in columns)
        table.add_row(row["scene"], row["method"], str(most), *(_cell(row, name, most) for name in columns))
    return table


def _cell(row: Mapping[Any, Any], name: str, most: int) -> str:
    """Mean and deviation, and how many they are of where that is not all."""
    mean, deviation, n = (row[f"{name}_{what}"] for what in ("mean", "std", "n"))
    if not n:
        return quantity(None)
    parts = [mean] if n < 2 or math.isnan(deviation) else [mean, deviation]
    text = PLUS_MINUS.join(f"{part:.{DECIMALS[name]}f}" for part in parts) if name in DECIMALS else quantity(*parts)
    return text if n == most else f"{text} (n = {n})"
