"""The answers of the study on shuffled scores, where nothing can predict: `python -m notebooks.prediction.shuffled`.

A draw gives each cell's PSNR on the views held out, of all its seeds, to another cell of the same scene and time, and answers
anew (`notebooks.prediction.answers`).  The table, by default notebooks/results/prediction_shuffled.csv:

    draw, at        the draw's number, the time
    measures        that are judged: those without the bars
    predicts        of them that "predict"
    beyond          whose interval of 95% has no 0
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.progress import track

from analysis.console.failures import program
from analysis.console.plain import say
from notebooks.prediction.answers import BARS, ENOUGH, FEWEST_SCENES, FILE, SCORE, answer, answers, read_prediction
from splat.model.untrusted import write_atomically

RESULTS = Path(__file__).parents[1] / "results"
SHUFFLED = "prediction_shuffled.csv"
COLUMNS = ("draw", "at", "measures", "predicts", "beyond")


def main(arguments: Sequence[str] | None = None) -> int:
    """Shuffle, answer and write; returns the exit code."""
    parser = argparse.ArgumentParser(
        "python -m notebooks.prediction.shuffled", description="Answers on shuffled scores."
    )
    parser.add_argument("table", type=Path, nargs="?", default=RESULTS / FILE, help="of notebooks.prediction")
    parser.add_argument("--draws", type=int, default=100, help="shuffled studies")
    parser.add_argument("--out", type=Path, default=RESULTS / SHUFFLED, help="the table")
    options = parser.parse_args(arguments)
    rows, console, lines = read_prediction(options.table), Console(stderr=True), []
    for draw in track(range(options.draws), "shuffled studies", console=console):
        lines += tallies(answers(shuffled(rows, draw)), draw)
    table = pd.DataFrame(lines, columns=list(COLUMNS))
    write_atomically(options.out, table.to_csv(index=False).encode())
    say(told(table), console=Console())
    return 0


def shuffled(rows: pd.DataFrame, draw: int) -> pd.DataFrame:
    """The rows with the scores of other cells; without a score where the other cell has none at that time and seed."""
    rng, source = np.random.default_rng(draw), pd.Series("", rows.index)
    for _, part in rows.dropna(subset=[SCORE]).groupby(["scene", "at"]):
        cells = sorted({*part["cell"]})
        other = dict(zip(cells, rng.permutation(cells), strict=True))
        source[part.index] = [other[cell] for cell in part["cell"]]
    scores = rows.set_index(["scene", "cell", "seed", "at"])[SCORE]
    others = pd.MultiIndex.from_arrays([rows["scene"], source, rows["seed"], rows["at"]])
    return rows.assign(**{SCORE: scores.reindex(others).to_numpy()})


def tallies(found: pd.DataFrame, draw: int) -> list[dict]:
    """A row for each time that enough scenes have, as the command writes it."""
    judged = pd.DataFrame(found[~found["measure"].isin(BARS) & (found["scenes"] >= FEWEST_SCENES)])
    lines = []
    for at, part in judged.groupby("at", sort=False):
        said = [answer(line, ENOUGH) for line in part.to_dict("records")]  # as of a study that is large enough
        beyond = int(((part["low"] > 0) | (part["high"] < 0)).to_numpy().sum())
        lines.append(
            {"draw": draw, "at": at, "measures": len(part), "predicts": said.count("predicts"), "beyond": beyond}
        )
    return lines


def told(table: pd.DataFrame) -> str:
    """The table in a sentence."""
    wrong = {draw for draw, predicts in zip(table["draw"], table["predicts"]) if predicts}
    share = table["beyond"].sum() / table["measures"].sum()
    return (
        f"Of {len({*table['draw']})} studies with shuffled scores {len(wrong)} said of any measure, at any time, that it "
        f"predicts; {share:.1%} of the intervals have no 0."
    )


if __name__ == "__main__":
    program(main)
