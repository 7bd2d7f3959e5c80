"""The accuracy study: products H v and seconds against true error, every estimator and setting, beside what people use.

OUT/accuracy.csv          a line a case, quantity, part, method, settings and seed: matvecs, seconds, true and reported error,
                          whether the truth was where the method said (of a diagonal: in which share of the rows)
OUT/accuracy_points.csv   the same, a line a case, quantity, method and settings: means; of errors root mean squares over
                          parts and seeds
OUT/accuracy_ratios.csv   what the defaults need over what the best peer, and our own best other setting, need
OUT/accuracy_QUANTITY.png drawn by `figures.accuracy` from accuracy_points.csv

Errors are shares of a scale: of the sum of |H_ii| over the block (traces), of |diag H|, and of the value itself (ends, sums
over the spectrum; of the larger end where an end is zero).  Errors below the round-off of the products count as that.
Matvecs and seconds are those of all parts of a quantity together.

**At equal true error.**  The default's error e over all seeds, and its mean matvecs; a rival's matvecs at the error e are
read from the polygon through its settings (logarithmic axes, the least error so far).  The interval of the ratio is a
bootstrap over seeds.  An end of the polygon gives a bound.  What is asked holds ("yes") where the whole interval is below
it, "no" where all of it is above, and is "open" otherwise.  Peers without a stopping rule are given the right budget, as an
oracle would.

**Which defaults the figures support.**  `exact_traces` on splats (a third of the best peer's work at equal error, and no
error at all without SSIM); a Lanczos run for both ends, to 1e-3 (looser saves two to four products, other bases and blocks
nothing).  A single Krylov run of another package needs as few products, because no method needs fewer: ours adds the
measured residuals and the round-off.  **Which they do not:** Hutchinson for traces where a few eigenvalues dominate (power law,
low rank), where XTrace or Hutch++ need an eighth of the products; on flat or clustered spectra it is the best.  Nor random
signs for the diagonal there (XDiag needs a quarter).  The quadrature's 6 x 32 against fewer and shorter runs is open: its
errors differ by less than seeds do.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import nan
from time import perf_counter

import pandas as pd
import torch
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from analysis.accuracy_cases import Case, Meter, matrix_cases, splat_cases
from analysis.accuracy_checkpoint import BUDGETS as FEW_BUDGETS
from analysis.accuracy_checkpoint import affordable, checkpoint_case
from analysis.accuracy_methods import BUDGETS, Answer, Method, own_methods
from analysis.accuracy_peers import peer_methods
from analysis.accuracy_ratios import points, ratio_table, ratios
from analysis.drawing import draw
from analysis.options import BenchOptions
from landscape.operator import DenseOperator
from landscape.probes import draw_probes
from splat.checkpoint import write_atomically

SEED = 0
# of the repetitions: a scene has five blocks' traces to each seed; other quantities vary less, or take longer
SEEDS_OF_FAMILY = {"matrices": 1.0, "splats": 0.2, "checkpoint": 0.14}
SEEDS_OF_QUANTITY = {"traces": 1.0, "ends": 0.2, "sums": 0.4, "diagonal": 0.2}
FEWEST_SEEDS = 2  # a bootstrap needs two at least
PROBES = 8  # quadratic forms of the comparison of precisions


@dataclass(frozen=True)
class Run:
    """One part of one run."""

    case: str
    family: str
    quantity: str
    part: str
    method: str
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
    meter = Meter(case)
    start = perf_counter()
    answers = method.run(case, meter, seed)
    seconds = perf_counter() - start - meter.spent + meter.seconds
    runs = []
    for answer in answers:
        sums = method.quantity == "sums"
        quantity, part = (answer.part, "all") if sums else (method.quantity, answer.part)
        about = (case.name, case.family, quantity, part, method.name, method.settings, method.origin, seed)
        runs.append(Run(*about, meter.matvecs, seconds, *scored(case, quantity, answer)))
    return runs


def scored(case: Case, quantity: str, answer: Answer) -> tuple[float, float, float]:
    """True error, reported error, and whether the truth is in the interval (with room for round-off); nan: none reported."""
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
            names = {"sum of |lambda|": "absolute_sum"}
            value = getattr(truth, names.get(quantity, quantity.replace(" ", "_")))
            scale = abs(value)
    return torch.tensor(value, dtype=torch.float64), scale


# --- precision --------------------------------------------------------------------------------------------------------


def precision_runs(case: Case, seed: int) -> Iterator[Run]:
    """z . H z with the products and the sums in either precision, against both in float64 with the same z.

    The error is of the mean of a few forms, over the mean of |z| |H z|: what rounding alone adds to an estimate.
    """
    exact = case.matrix.double()
    Z = draw_probes(case.operator.dim, PROBES, torch.Generator().manual_seed(seed), torch.float64, "rademacher")
    truth = quadratic_forms(exact, Z, torch.float64)
    scale = float((Z.norm(dim=0) * (exact @ Z).norm(dim=0)).mean())
    ways = {
        "float64": (torch.float64, torch.float64),
        "float32 products, float64 sums": (torch.float32, torch.float64),
        "float32": (torch.float32, torch.float32),
    }
    for name, (products, sums) in ways.items():
        start = perf_counter()
        found = quadratic_forms(exact.to(products), Z, sums)
        seconds = perf_counter() - start
        error = abs(float(found.double().mean() - truth.mean())) / scale
        about = (case.name, case.family, "precision", "z.Hz", name, f"{PROBES} probes", "own", seed)
        yield Run(*about, PROBES, seconds, error, nan, nan)


def quadratic_forms(matrix: Tensor, Z: Tensor, sums: torch.dtype) -> Tensor:
    """z . H z, H z in the matrix' precision, the sum over rows in another."""
    Z = Z.to(matrix.dtype)
    return (Z.to(sums) * (matrix @ Z).to(sums)).sum(dim=0)


# --- the command ------------------------------------------------------------------------------------------------------


def run_accuracy(options: BenchOptions) -> int:
    """Run every method on every case; print, write and draw what came of it; 0."""
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
        ]
        progress.update(bar, total=len(jobs))
        for case, method, seed in jobs:
            progress.update(bar, description=f"accuracy: {case.name}, {method.name}"[:60])
            runs += measure(case, method, SEED + seed)
            progress.advance(bar)
        for case in cases:
            if isinstance(case.operator, DenseOperator):
                runs += precision_runs(case, SEED)
    for sentence in missing:
        console.print(sentence, style="yellow", highlight=False, soft_wrap=True)
    _report(pd.DataFrame(vars(run) for run in runs), options, cases, console)
    return 0


def _cases(options: BenchOptions) -> list[Case]:
    if options.checkpoint is not None:
        return [checkpoint_case(options.checkpoint, options.out, options.downscale)]
    return [*splat_cases(SEED), *matrix_cases(SEED)]


def seeds_of(case: Case, method: Method, repetitions: int) -> int:
    share = SEEDS_OF_FAMILY[case.family] * SEEDS_OF_QUANTITY[method.quantity]
    return max(FEWEST_SEEDS, round(share * repetitions))


def _report(table: pd.DataFrame, options: BenchOptions, cases: Sequence[Case], console: Console) -> None:
    floors = {case.name: case.round_off for case in cases}
    means = points(table, floors)
    found = ratios(table, floors)
    for against in ("peer", "own"):
        part = pd.DataFrame(found[found["against"] == against])
        title = {
            "peer": "the defaults at equal true error: over the best peer",
            "own": "over our own best other setting",
        }
        console.print(ratio_table(part, title[against]))
    for name, data in {"accuracy": table, "accuracy_points": means, "accuracy_ratios": found}.items():
        path = options.out / f"{name}.csv"
        write_atomically(path, data.to_csv(index=False).encode())
        console.print(path, soft_wrap=True, highlight=False)
    draw("accuracy", options.out / "accuracy_points.csv")
    console.print(f"{options.out}/accuracy_*.png", soft_wrap=True, highlight=False)
    verdicts = [row["holds"] for row in found.to_dict("records") if row["against"] == "peer" and row["holds"]]
    counts = (f"{verdicts.count(word)} {word}" for word in ("yes", "no", "open"))
    console.print(f"of {len(verdicts)} that are asked for: {', '.join(counts)}", highlight=False)
