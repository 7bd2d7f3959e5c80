"""The accuracy study: work against true error of every estimator, beside other packages: `python -m notebooks.accuracy`.

    OUT/accuracy.csv          a line for each case, quantity, part, method, settings and seed: matvecs, seconds, true and
                              reported error, whether the interval contains the truth (of a diagonal: the share of rows)
    OUT/accuracy_points.csv   a line for each case, quantity, method and settings: means over parts and seeds
    OUT/accuracy_ratios.csv   work of the default over that of the best peer ("peer") and of our best other setting ("own")
    OUT/accuracy_QUANTITY.png drawn by `figures.accuracy` from accuracy_points.csv

**At equal true error.**  A ratio is the default's mean matvecs over those that a rival needs for the default's error e, the
root mean square over all seeds.

- A rival's matvecs at e are interpolated between its settings, in log error against log matvecs.  A setting's error is the
  largest of its error and those of the costlier settings: being better than one with more work is chance, and a user who does
  not know the truth would not have stopped there.
- Beyond the cheapest and the costliest setting the ratio is a bound, "≥" or "≤".
- The same estimator in several packages is one rival: the best of several equal ones would look better than each.
- Peers without a stopping rule get the budget that reaches e, which their users cannot know.
- The ratio's interval is a bootstrap over seeds.  The ratio asked for holds ("yes") where the whole interval is at most that,
  does not ("no") where the whole interval is above, and is "open" otherwise.

`python -m notebooks.accuracy` repeats all of it; `--quantity ends --case flat` a part.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from math import nan
from pathlib import Path
from time import perf_counter

import pandas as pd
import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from analysis.bench.accuracy.cases import Case
from analysis.bench.accuracy.command import Method, Run, measure, points
from analysis.bench.tables import rich_table, write_table
from analysis.console.drawing import draw
from analysis.console.failures import program
from analysis.console.plain import say
from landscape.errors import InputError
from landscape.operators.operator import DenseOperator, SymmetricOperator
from landscape.probes import draw_probes
from notebooks.accuracy.cases import StudyCase, matrix_cases, splat_cases
from notebooks.accuracy.methods import own_methods
from notebooks.accuracy.peers import peer_methods
from notebooks.accuracy.ratios import ratio_table, ratios

QUANTITIES = ("traces", "ends", "sums", "diagonal")
SEED = 0
TITLES = {"peer": "the defaults at equal true error: over the best peer", "own": "over our own best other setting"}
# seeds over --repetitions: a scene gives five blocks' traces for each seed; other quantities vary less or take longer
SEEDS_OF_FAMILY = {"matrices": 1.0, "splats": 0.2}
SEEDS_OF_QUANTITY = {"traces": 3.0, "ends": 0.5, "sums": 0.5, "diagonal": 1.0}
# in place of the product of both: a rival that misses an end in one run of 20 needs more than 4 seeds
SEEDS_OF_BOTH = {("splats", "ends"): 1.0}
OTHERS = 0.25  # factor of the seeds of our settings other than the default, of which no ratio is asked
FEWEST_SEEDS = 2  # for a bootstrap
PROBES = 8  # quadratic forms of the comparison of precisions
PRECISION_SEEDS = 5
PRECISIONS = {  # of the products, and of the sums over rows
    "float64": (torch.float64, torch.float64),
    "float32 products, float64 sums": (torch.float32, torch.float64),
    "float32": (torch.float32, torch.float32),
}


# --- precision --------------------------------------------------------------------------------------------------------


def precision_runs(case: StudyCase, seed: int) -> Iterator[Run]:
    """The error of z . H z due to rounding: products and sums in either precision, against both in float64 with the same z.

    The error is that of the mean over PROBES vectors z, over the mean of |z| |H z|.
    """
    products = case.products
    if products is None:
        assert isinstance(case.operator, DenseOperator)
        products = {dtype: DenseOperator(case.operator.matrix.to(dtype)) for dtype in (torch.float32, torch.float64)}
    Z = draw_probes(case.operator.dim, PROBES, torch.Generator().manual_seed(seed), torch.float64, "rademacher")
    truth = quadratic_forms(products[torch.float64], Z, torch.float64)
    scale = float((Z.norm(dim=0) * products[torch.float64].apply(Z).norm(dim=0)).mean())
    for name, (kernels, sums) in PRECISIONS.items():
        start = perf_counter()
        found = quadratic_forms(products[kernels], Z, sums)
        seconds = perf_counter() - start
        error = abs(float(found.double().mean() - truth.mean())) / scale
        about = (case.name, case.family, "precision", "z.Hz", name, name, f"{PROBES} probes", "own", seed)
        yield Run(*about, PROBES, seconds, error, nan, nan)


def quadratic_forms(operator: SymmetricOperator, Z: Tensor, sums: torch.dtype) -> Tensor:
    """z . H z, with H z in the operator's precision and the sum over rows in that of `sums`."""
    Z = Z.to(operator.dtype)
    return (Z.to(sums) * operator.apply(Z).to(sums)).sum(dim=0)


# --- the command ------------------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Run every method on every case; print, write and draw the results; returns the exit code."""
    parser = argparse.ArgumentParser("python -m notebooks.accuracy", description="Work against true error.")
    parser.add_argument("--quantity", action="append", choices=QUANTITIES, default=[], help="study this alone")
    parser.add_argument("--case", action="append", default=[], help="study this scene or matrix alone")
    parser.add_argument("--scenes", type=int, default=1, help="small scenes of each kind, from a seed each")
    parser.add_argument("--repetitions", type=int, default=15, help="what the numbers of seeds are in proportion to")
    parser.add_argument("--out", type=Path, default=Path("runs/accuracy"), help="folder of the tables and figures")
    options = parser.parse_args(arguments)
    console, errors = Console(), Console(stderr=True)
    cases = chosen_cases(options.case, options.scenes)
    options.out.mkdir(parents=True, exist_ok=True)
    peers, missing = peer_methods()
    methods = [method for method in (*own_methods(), *peers) if method.quantity in (options.quantity or QUANTITIES)]
    jobs = [
        (case, method, seed)
        for case in cases
        for method in methods
        if method.applies(case)
        for seed in range(seeds_of(case, method, options.repetitions))
    ]
    shown = track(jobs, "accuracy", console=errors, transient=True)
    runs = [run for case, method, seed in shown for run in measure(case, method, SEED + seed)]
    if not options.quantity:
        runs += [run for case in cases for seed in range(PRECISION_SEEDS) for run in precision_runs(case, SEED + seed)]
    say(*missing, style="yellow", console=console)
    report(pd.DataFrame(vars(run) for run in runs), options.out, {case.name: case.round_off for case in cases}, console)
    return 0


def chosen_cases(names: Sequence[str], scenes: int) -> list[StudyCase]:
    """The cases of these names; all where there are none.  scenes: how many of each kind."""
    if scenes < 1:
        raise InputError(f"expected at least 1 scene of each kind, got --scenes {scenes}")
    matrices, splats = {case.name: case for case in matrix_cases(SEED)}, splat_cases(SEED, scenes)
    if strange := set(names) - {*matrices, *splats}:
        known = ", ".join(map(repr, (*splats, *matrices)))
        raise InputError(f"expected --case to be one of {known}, got {', '.join(map(repr, sorted(strange)))}")
    return [splats[name]() if name in splats else matrices[name] for name in names or (*splats, *matrices)]


def seeds_of(case: Case, method: Method, repetitions: int) -> int:
    of_both = SEEDS_OF_FAMILY[case.family] * SEEDS_OF_QUANTITY[method.quantity]
    share = SEEDS_OF_BOTH.get((case.family, method.quantity), of_both)
    share *= OTHERS if method.origin == "own" else 1.0
    return max(FEWEST_SEEDS, round(share * repetitions))


def report(table: pd.DataFrame, out: Path, floors: Mapping[str, float], console: Console) -> None:
    """Print, write and draw.  floors: round-off of each case."""
    means = points(table, floors)
    found = ratios(table, floors)
    for against, title in TITLES.items():
        console.print(rich_table(ratio_table(pd.DataFrame(found[found["against"] == against])), title))
    rounding = means[means["quantity"] == "precision"].pivot(index="case", columns="method", values="true_error")
    if len(rounding):
        shown = rounding.reset_index().filter(["case", *PRECISIONS])
        console.print(rich_table(shown, "what rounding adds to z.Hz, over |z| |Hz|"))
    for name, data in {"accuracy": table, "accuracy_points": means, "accuracy_ratios": found}.items():
        write_table(data, out / f"{name}.csv", console)
    say(*draw("accuracy", out / "accuracy_points.csv"), f"{out}/accuracy_*.png", console=console)
    verdicts = [row["holds"] for row in found.to_dict("records") if row["against"] == "peer" and row["holds"]]
    counts = (f"{verdicts.count(word)} {word}" for word in ("yes", "no", "open"))
    say(f"of {len(verdicts)} that are asked for: {', '.join(counts)}", console=console)


if __name__ == "__main__":
    program(main)
