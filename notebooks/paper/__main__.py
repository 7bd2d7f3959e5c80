"""The paper's ten statements, judged on a study: `python -m notebooks.paper [STUDY ...] [--out OUT]`.

STUDY   folders that hold runs, such as that of a sweep; a table study.csv; or a folder with one, by default notebooks/results

OUT/study.csv        the runs (`notebooks.paper.study`)
OUT/claims.csv       the effects behind each verdict (`notebooks.paper.statements`)
OUT/predictors.csv   rank correlation of quantities with the score (`notebooks.paper.predictors`)
OUT/*.png, *.pdf     the figures, OUT/captions.md their captions and the ten verdicts (`notebooks.paper.figures`)
OUT/prediction/      tables, figures and page of the prediction.csv beside the study (`notebooks.paper.found`)

`landscape sweep notebooks/study_small.toml; python -m notebooks.paper runs/study-small` repeats the stored results.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.markup import escape

from analysis.console.failures import program
from analysis.console.plain import say
from analysis.records.run_files import read_trajectory
from figures.scripts import print_files
from notebooks.paper.effects import UNTESTED
from notebooks.paper.figures import RESULTS, make
from notebooks.paper.found import make as write_found
from notebooks.paper.predictors import predictors
from notebooks.paper.statements import LEAST, Judgement, effect_table, judgements
from notebooks.paper.study import study, unended
from notebooks.paper.table import FILE
from notebooks.prediction.answers import FILE as PREDICTION
from splat.training.checkpoint import write_atomically

STYLES = {"holds": "green", "holds in part": "yellow", "does not hold": "red"} | dict.fromkeys(
    ("undecided", UNTESTED), "dim"
)
ALONG = "trajectories.csv"  # beside study.csv: the records along some of its trainings


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge, print, write and draw; returns the exit code."""
    parser = argparse.ArgumentParser("python -m notebooks.paper", description="The paper's statements on a study.")
    parser.add_argument(
        "study", type=Path, nargs="*", default=[RESULTS], help="run folders, or a folder with study.csv"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/paper"), help="folder of the tables and figures")
    options = parser.parse_args(arguments)
    return print_files(lambda: _made(options.study, options.out))


def _made(paths: Sequence[Path], out: Path):
    """The files, each when it is there."""
    console, along = Console(), paths[0] / ALONG
    rows = study([path / FILE if (path / FILE).is_file() else path for path in paths])
    found, related = judgements(rows), predictors(rows)
    out.mkdir(parents=True, exist_ok=True)
    say(*(f"left out, as it has not ended: {run}" for run in unended(paths)), style="yellow", console=console)
    tell(rows, found, console)
    for name, table in {FILE: rows, "claims.csv": effect_table(found), "predictors.csv": related}.items():
        write_atomically(out / name, table.to_csv(index=False).encode())
        yield out / name
    yield from make(rows, found, related, out, read_trajectory(along) if along.is_file() else None)
    if (stored := paths[0] / PREDICTION).is_file():
        yield from write_found(stored, found, out / "prediction")


def tell(rows: pd.DataFrame, found: Sequence[Judgement], console: Console) -> None:
    """Print the verdicts, and the methods with too few seeds for one."""
    seeds = pd.DataFrame(
        rows.groupby(["scene", "views", "steps", "method"], sort=False)["seed"].nunique()
    ).reset_index()
    if few := [f"{row['method']} ({row['seed']})" for row in seeds.to_dict("records") if row["seed"] < LEAST]:
        say(f"fewer than {LEAST} seeds, which decide nothing: {', '.join(few)}", console=console)
    for each in found:
        style = STYLES[each.verdict]
        console.print(f"\n[bold]{each.number}.[/] {escape(each.statement)} ({each.source})", highlight=False)
        console.print(f"   [{style}]{each.verdict}[/]: {escape(each.finding)}", highlight=False)


if __name__ == "__main__":
    program(main)
