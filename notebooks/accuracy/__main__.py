"""The accuracy study: products H v and seconds against true error, of every estimator and setting and of other packages.

    OUT/accuracy.csv          a line for each case, quantity, part, method, settings and seed: matvecs, seconds, true and
                              reported error, whether the interval contains the truth (of a diagonal: the share of rows)
    OUT/accuracy_points.csv   a line for each case, quantity, method and settings: means over parts and seeds, of errors root
                              mean squares
    OUT/accuracy_ratios.csv   work of the default over that of the best peer ("peer") and of our best other setting ("own")
    OUT/accuracy_QUANTITY.png drawn by `figures.accuracy` from accuracy_points.csv

Errors are relative to a scale: the sum of |H_ii| over the block (traces), |diag H|, and the value itself (ends, sums over the
spectrum; the larger end where an end is zero).  Errors below the round-off of the products count as that.  Matvecs and seconds
are those of all parts of a quantity together.

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
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import nan
from time import perf_counter
from typing import get_args

import pandas as pd
import torch
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from analysis.bench.accuracy.cases import Case, MeteredOperator, matrix_cases, splat_cases
from analysis.bench.accuracy.checkpoint import checkpoint_case
from analysis.bench.accuracy.methods import BUDGETS, FEW_BUDGETS, Answer, Method, affordable, own_methods
from analysis.bench.accuracy.peers import peer_methods
from analysis.bench.accuracy.ratios import points, ratio_table, ratios
from analysis.bench.options import BenchOptions, Quantity
from analysis.bench.tables import rich_table, write_table
from analysis.console.drawing import draw
from analysis.console.plain import say
from landscape.errors import InputError
from landscape.operators.operator import DenseOperator, SymmetricOperator
from landscape.probes import draw_probes

SEED = 0
TITLES = {"peer": "the defaults at equal true error: over the best peer", "own": "over our own best other setting"}
# seeds over --repetitions: a scene gives five blocks' traces for each seed; other quantities vary less or take longer
SEEDS_OF_FAMILY = {"matrices": 1.0, "splats": 0.2, "checkpoint": 0.14}
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


@dataclass(frozen=True)
class Run:
    """One part of one run."""

    case: str
    family: str
    quantity: str
    part: str
    method: str
    estimator: str
    settings: str
    origin: str
    seed: int
    matvecs: float
    seconds: float
    true_error: float
    reported_error: float
    covered: float


def measure(case: Case, method: Method, seed: int) -> list[Run]:
    """Run a method on a case and compare its answers with the truth."""
    meter = MeteredOperator(case)
    start = perf_counter()
    answers = method.run(case, meter, seed)
    seconds = perf_counter() - start - meter.spent + meter.seconds
    runs = []
    for answer in answers:
        sums = method.quantity == "sums"
        quantity, part = (answer.part, "all") if sums else (method.quantity, answer.part)
        estimator = method.estimator or method.name
        about = (case.name, case.family, quantity, part, method.name, estimator, method.settings, method.origin, seed)
        runs.append(Run(*about, meter.matvecs, seconds, *scored(case, quantity, answer)))
    return runs


def scored(case: Case, quantity: str, answer: Answer) -> tuple[float, float, float]:
    """True error, reported error, and whether the interval, widened by round-off, contains the truth; nan: none reported."""
    truth, scale = truth_of(case, quantity, answer.part)
    as_vector = torch.as_tensor(answer.value, dtype=torch.float64)
    low, high, error = (torch.as_tensor(x, dtype=torch.float64) for x in (answer.low, answer.high, answer.error))
    slack = case.round_off * scale
    inside = ((low - slack <= truth) & (truth <= high + slack)).double()
    covered = nan if bool(low.isnan().any()) else float(inside.mean())
    true_error = float((as_vector - truth).norm()) / scale
    return true_error, float(error.norm()) / scale, covered


def truth_of(case: Case, quantity: str, part: str) -> tuple[Tensor, float]:
    """The true value and the scale of its errors."""
    truth = case.truth
    match quantity:
        case "traces":
            value, scale = truth.traces[part], truth.scales[part]
        case "ends":
            value, larger = getattr(truth, part), max(abs(truth.largest), abs(truth.smallest))
            scale = abs(value) if abs(value) > case.round_off * larger else larger
        case "diagonal":
            assert truth.diagonal is not None
            return truth.diagonal, float(truth.diagonal.norm())
        case _:
            name = "absolute_sum" if quantity == "sum of |lambda|" else quantity.replace(" ", "_")
            value = getattr(truth, name)
            scale = abs(value)
    return torch.tensor(value, dtype=torch.float64), scale


# --- precision --------------------------------------------------------------------------------------------------------


def precision_runs(case: Case, seed: int) -> Iterator[Run]:
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


def run_accuracy(options: BenchOptions) -> int:
    """Run every method on every case; print, write and draw the results; returns the exit code 0."""
    console, errors = Console(), Console(stderr=True)
    options.out.mkdir(parents=True, exist_ok=True)
    runs: list[Run] = []
    with Progress(console=errors, transient=True) as progress:
        bar = progress.add_task("accuracy: making the cases", total=None)
        cases = _cases(options)
        budgets = BUDGETS if options.checkpoint is None else FEW_BUDGETS
        peers, missing = peer_methods(budgets)
        methods = [*own_methods(budgets), *peers]
        jobs = [
            (case, method, seed)
            for case in cases
            for method in methods
            for seed in range(seeds_of(case, method, options.repetitions))
            if method.applies(case) and (case.family != "checkpoint" or affordable(method))
            if method.quantity in (options.quantity or get_args(Quantity))
        ]
        progress.update(bar, total=len(jobs))
        for case, method, seed in jobs:
            progress.update(bar, description=f"accuracy: {case.name}, {method.name}"[:60])
            runs += measure(case, method, SEED + seed)
            progress.advance(bar)
        for case in cases:
            if isinstance(case.operator, DenseOperator) and not options.quantity:
                runs += [run for seed in range(PRECISION_SEEDS) for run in precision_runs(case, SEED + seed)]
    say(*missing, style="yellow", console=console)
    _report(pd.DataFrame(vars(run) for run in runs), options, cases, console)
    return 0


def _cases(options: BenchOptions) -> list[Case]:
    if options.scenes < 1:
        raise InputError(f"expected at least 1 scene of each kind, got --scenes {options.scenes}")
    if options.checkpoint is not None:
        if options.case or options.scenes > 1:
            raise InputError("expected neither --case nor --scenes beside a checkpoint, which is the only case")
        return [checkpoint_case(options.checkpoint, options.out, options.downscale)]
    matrices, scenes = {case.name: case for case in matrix_cases(SEED)}, splat_cases(SEED, options.scenes)
    if strange := set(options.case) - {*matrices, *scenes}:
        names = ", ".join(map(repr, (*scenes, *matrices)))
        raise InputError(f"expected --case to be one of {names}, got {', '.join(map(repr, sorted(strange)))}")
    chosen = options.case or (*scenes, *matrices)
    return [scenes[name]() if name in scenes else matrices[name] for name in chosen]


def seeds_of(case: Case, method: Method, repetitions: int) -> int:
    of_both = SEEDS_OF_FAMILY[case.family] * SEEDS_OF_QUANTITY[method.quantity]
    share = SEEDS_OF_BOTH.get((case.family, method.quantity), of_both)
    share *= OTHERS if method.origin == "own" else 1.0
    return max(FEWEST_SEEDS, round(share * repetitions))


def _report(table: pd.DataFrame, options: BenchOptions, cases: Sequence[Case], console: Console) -> None:
    floors = {case.name: case.round_off for case in cases}
    means = points(table, floors)
    found = ratios(table, floors)
    for against, title in TITLES.items():
        console.print(rich_table(ratio_table(pd.DataFrame(found[found["against"] == against])), title))
    rounding = means[means["quantity"] == "precision"].pivot(index="case", columns="method", values="true_error")
    if len(rounding):
        shown = rounding.reset_index().filter(["case", *PRECISIONS])
        console.print(rich_table(shown, "what rounding adds to z.Hz, over |z| |Hz|"))
    for name, data in {"accuracy": table, "accuracy_points": means, "accuracy_ratios": found}.items():
        write_table(data, options.out / f"{name}.csv", console)
    say(*draw("accuracy", options.out / "accuracy_points.csv"), f"{options.out}/accuracy_*.png", console=console)
    verdicts = [row["holds"] for row in found.to_dict("records") if row["against"] == "peer" and row["holds"]]
    counts = (f"{verdicts.count(word)} {word}" for word in ("yes", "no", "open"))
    say(f"of {len(verdicts)} that are asked for: {', '.join(counts)}", console=console)
