"""Steps of second order beside Adam: `python -m notebooks.second_order [RUNS] [--against METHOD] [--out OUT]`.

RUNS    folder of a sweep with `keep_checkpoints = "all"`, or one with curves.csv, by default notebooks/results/second-order

RUNS/SCENE/METHOD/SEED/curve.csv    of every run that has ended (`curves`); what is there already is not made again
RUNS/curves.csv                     all of them, with scene, method and seed
OUT/SCENE.png                       drawn from them (`figure`)

`--against METHOD` prints, as means over the seeds that both have with standard deviations, how many of METHOD's seconds each
method takes to METHOD's last loss (on a straight line of ln loss between checkpoints), and the last held-out dB.

`landscape sweep notebooks/second-order.toml; python -m notebooks.second_order runs/second-order` repeats the stored results.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.progress import track

from analysis.console.failures import program
from analysis.console.plain import say
from figures.scripts import print_files
from figures.style import save
from landscape.errors import InputError
from notebooks.second_order.curves import against, curve
from notebooks.second_order.figure import draw_scene
from splat.model.untrusted import read_table, write_atomically

RESULTS = Path(__file__).parents[1] / "results" / "second-order"
CURVE, CURVES = "curve.csv", "curves.csv"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what is missing, print and draw; returns the exit code."""
    parser = argparse.ArgumentParser("python -m notebooks.second_order", description="Second order beside Adam.")
    parser.add_argument("runs", type=Path, nargs="?", default=RESULTS, help="folder of a sweep, or one with curves.csv")
    parser.add_argument("--against", metavar="METHOD", help="print seconds to this method's last loss")
    parser.add_argument("--out", type=Path, default=Path("runs/second-order-curves"), help="folder of the pictures")
    options = parser.parse_args(arguments)
    return print_files(lambda: _drawn(options.runs, options.against, options.out))


def _drawn(runs: Path, reference: str | None, out: Path) -> Iterator[Path]:
    """The pictures, each when it is there."""
    table = curves(runs)
    if reference:
        say(against(table, reference).to_string(index=False), console=Console())
    for scene, rows in table.groupby("scene"):
        yield save(draw_scene(pd.DataFrame(rows)), out / f"{scene}.png")


def curves(runs: Path) -> pd.DataFrame:
    """The curves of all runs that have ended, or those that were stored.  InputError where there is neither."""
    ended = sorted(path.parent for path in runs.glob("*/*/*/metrics.json"))
    if not ended:
        if (runs / CURVES).is_file():
            return read_table(runs / CURVES)
        raise InputError(f"expected runs that have ended in {runs}, got none; landscape sweep makes them")
    for run in track([run for run in ended if not (run / CURVE).is_file()], "curves", console=Console(stderr=True)):
        write_atomically(run / CURVE, curve(run).to_csv(index=False).encode())
    tables = []
    for run in ended:
        scene, method, seed = run.parts[-3:]
        tables.append(read_table(run / CURVE).assign(scene=scene, method=method, seed=seed))
    table = pd.concat(tables, ignore_index=True)
    write_atomically(runs / CURVES, table.to_csv(index=False).encode())
    return table


if __name__ == "__main__":
    program(main)
