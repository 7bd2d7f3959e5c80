"""`landscape claims`: verdicts on the paper's statements from the runs of a study.

OUT/study.csv        the runs (`analysis.runs.claims.study`); the command accepts this file in place of the runs
OUT/claims.csv       the effects behind each verdict (`analysis.runs.claims.statements`)
OUT/predictors.csv   correlation of quantities with the score (`analysis.runs.claims.predictors`)
OUT/claims.json      the nine judgements
OUT/claims.png, claim-N.png, predictors.png   drawn by `figures.claims`
OUT/claims.html      all of it on a self-contained page
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.markup import escape

from analysis.console.drawing import draw
from analysis.console.plain import say
from analysis.records.json_files import json_text, plain
from analysis.records.report import pictures_in, template_environment
from analysis.runs.claims.predictors import predictors
from analysis.runs.claims.statements import LEAST, Judgement, effect_table, judgements
from analysis.runs.claims.study import study, unended
from analysis.runs.claims.table import FILE
from analysis.runs.options import ClaimsOptions
from splat.training.checkpoint import write_atomically

STYLES = {"holds": "green", "holds in part": "yellow", "does not hold": "red", "cannot be tested here": "dim"}
PICTURES = {
    "predictors": "Rank correlation of each measured quantity with PSNR on held-out views, with its 95% interval."
}


def run_claims(options: ClaimsOptions) -> int:
    """Judge, print, write; returns the exit code."""
    rows, console = study(options.runs), Console()
    found, related = judgements(rows), predictors(rows)
    out = options.out or (options.runs[0] if options.runs[0].is_dir() else options.runs[0].parent) / "claims"
    out.mkdir(parents=True, exist_ok=True)
    for name, table in {FILE: rows, "claims.csv": effect_table(found), "predictors.csv": related}.items():
        write_atomically(out / name, table.to_csv(index=False).encode())
    write_atomically(out / "claims.json", json_text(plain([asdict(each) for each in found])).encode())
    say(*(f"left out, as it has not ended: {run}" for run in unended(options.runs)), style="yellow", console=console)
    say(*draw("claims", out), style="yellow", console=console)
    write_atomically(out / "claims.html", render_page(rows, found, out).encode())
    _print(rows, found, console)
    say(f"open {out / 'claims.html'}; numbers: {FILE}, claims.csv, predictors.csv", console=console)
    return 0


def runs_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Number of seeds of each method, by scene, steps and views."""
    counts = rows.groupby(["scene", "views", "steps", "method"], sort=False)["seed"].nunique()
    return pd.DataFrame(counts).reset_index().rename(columns={"seed": "seeds"})


def _print(rows: pd.DataFrame, found: Sequence[Judgement], console: Console) -> None:
    few = runs_of(rows).query("seeds < @LEAST")
    if len(few):
        names = ", ".join(f"{row['method']} ({row['seeds']})" for row in few.to_dict("records"))
        say(f"fewer than {LEAST} seeds, which decide nothing: {names}", console=console)
    for each in found:
        style = STYLES[each.verdict]
        console.print(f"\n[bold]{each.number}.[/] {escape(each.statement)} ({each.source})", highlight=False)
        console.print(f"   [{style}]{each.verdict}[/]: {escape(each.finding)}", highlight=False)


def render_page(rows: pd.DataFrame, found: Sequence[Judgement], out: Path) -> str:
    """The page as text, with the pictures that lie in the folder."""
    template = template_environment().get_template("claims.html.jinja")
    words = {f"claim-{each.number}": f"{each.statement} {each.verdict}: {each.finding}" for each in found}
    drawn = {each["name"]: each for each in pictures_in(out, words)}
    return template.render(
        judgements=found, own=drawn, runs=runs_of(rows).to_dict("records"), pictures=pictures_in(out, PICTURES)
    )
