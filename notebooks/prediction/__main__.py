"""Measures of the trainings of notebooks/prediction.toml: `python -m notebooks.prediction RUNS [--only CELL] [--out TABLE]`.

RUNS    folder of the sweep; of every training that has ended, RUNS/SCENE/CELL/SEED, a row at its end and one for each level of
        LEVELS (`notebooks.prediction.rows`)

    scene, cell, seed, at      at: "end", or dB of the training views
    reached                    False where the training never was as good: no further column has a value
    psnr_train, psnr_test      dB, means over the views
    ..._error                  `notebooks.prediction.rows`
    ensemble                   with the other seeds whose trainings have ended too; again when there are more of them
    digest, scene_digest       of the checkpoint's Gaussians, and of its views
    commit, date, seconds      of the code, of the measuring, of the processor

The table is written after each row.  What it has is measured again only where the training was made again.
`OMP_NUM_THREADS=1` keeps to one processor.

    landscape sweep notebooks/prediction.toml; python -m notebooks.prediction runs/prediction

repeats the stored table, once its rows are taken out.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from time import process_time

import pandas as pd
from rich.console import Console

from analysis.console.failures import program
from analysis.console.plain import say
from analysis.records.provenance import provenance
from analysis.records.run_files import CHECKPOINT, METRICS
from analysis.train.command import REACHED
from landscape.errors import InputError
from notebooks.prediction.rows import Row, ensemble_columns, measured_row
from splat.model.untrusted import read_table, write_atomically
from splat.training.checkpoint import load_checkpoint

RESULTS = Path(__file__).parents[1] / "results" / "prediction.csv"
END, LEVELS = "end", (30.0, 33.0, 36.0)  # as the sweep's save_at_psnr
ENSEMBLE = "ensemble_seeds"
MEASURES = (
    "trace", "trace_means", "lambda_max", "lambda_min", "order_fragility", "order_fragility_new", "field_sharpness",
    "field_sharpness_new", "critical_sharpness", "open_curvature", "ensemble", "coadaptation",
)  # fmt: skip
COLUMNS = (
    "scene", "cell", "seed", "at", "reached", "step", "psnr_train", "psnr_test", "gaussians",
    *(name + suffix for name in MEASURES for suffix in ("", "_error")),
    "eigenvalue_ratio", "participation_ratio", "participation_ratio_low", "participation_ratio_high", "open_ratio",
    ENSEMBLE, "digest", "scene_digest", "commit", "date", "seconds",
)  # fmt: skip
Key = tuple[str, str, int, str]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the table lacks; returns the exit code."""
    parser = argparse.ArgumentParser("python -m notebooks.prediction", description="Measures of a sweep's trainings.")
    parser.add_argument("runs", type=Path, help="folder of the sweep")
    parser.add_argument("--only", action="append", default=[], metavar="SCENE/CELL/SEED", help="these, or a first part")
    parser.add_argument("--out", type=Path, default=RESULTS, help="the table")
    options = parser.parse_args(arguments)
    console, found = Console(stderr=True), checkpoints(options.runs, options.only)
    rows: dict[Key, Row] = {}
    if options.out.is_file():
        for row in read_table(options.out, dtype={"at": str}).to_dict("records"):
            rows[row["scene"], row["cell"], row["seed"], row["at"]] = row
    for key, path in found.items():
        begun = process_time()
        row: Row | None = rows.get(key)
        if row and str(row["digest"]) != (load_checkpoint(path).state if path else "nan"):
            row = None  # the training was made again
        others = [other for seed, other in _seeds(options.runs, key, path).items() if seed != key[2]]
        if row is None:
            row = Row(zip(COLUMNS[:4], key, strict=True)) | {"reached": path is not None, "seconds": 0.0}
            row |= measured_row(path) if path else {}
        elif not path or row[ENSEMBLE] == len(others):
            continue
        if path:
            row |= ensemble_columns(path, others) if others else {ENSEMBLE: 0}
        here = provenance(seed=0)
        row |= {"commit": here.commit, "date": here.created[:10], "seconds": row["seconds"] + process_time() - begun}
        rows[key] = row
        options.out.parent.mkdir(parents=True, exist_ok=True)
        table = pd.DataFrame([rows[each] for each in sorted(rows)], columns=list(COLUMNS))
        write_atomically(options.out, table.to_csv(index=False, float_format="%.6g").encode())
        say(f"{'/'.join(map(str, key))}: {row['seconds']:.0f} s", console=console)
    return 0


def checkpoints(runs: Path, only: Sequence[str]) -> dict[Key, Path | None]:
    """The checkpoints of every training that has ended, None for a level that was not reached.  InputError without any."""
    found: dict[Key, Path | None] = {}
    for run in sorted(path.parent for path in runs.glob(f"*/*/*/{METRICS}")):
        scene, cell, seed = run.parts[-3:]
        if only and not any(f"{scene}/{cell}/{seed}/".startswith(f"{name}/") for name in only):
            continue
        for at, path in _of_run(run).items():
            found[scene, cell, int(seed), at] = path
    if not found:
        raise InputError(f"expected trainings that have ended in {runs}, got none; landscape sweep makes them")
    return found


def _of_run(run: Path) -> dict[str, Path | None]:
    levels = {f"{level:g}": run / REACHED.format(level) / CHECKPOINT for level in LEVELS}
    return {END: run / CHECKPOINT} | {at: path if path.is_file() else None for at, path in levels.items()}


def _seeds(runs: Path, key: Key, path: Path | None) -> dict[int, Path]:
    """The checkpoints of the same cell and level by seed, of trainings that have ended; none for a level not reached."""
    scene, cell, _, at = key
    ended = [each.parent for each in (runs / scene / cell).glob(f"*/{METRICS}")] if path else []
    return {int(run.name): there for run in sorted(ended) if (there := _of_run(run)[at])}


if __name__ == "__main__":
    program(main)
