"""`landscape bench accuracy RUN`: products H v and seconds against true error, of every estimator on one's own scene.

    OUT/accuracy.csv          a line for each method and settings: means over parts and seeds of matvecs, seconds, true and
                              reported error (root mean squares), and how often the interval holds the truth
    OUT/accuracy_QUANTITY.png drawn by `figures.accuracy` from it
    OUT/truth.json            the truth, a long run (`cases`)

A method is run on an operator that counts, with a seed, and returns an `Answer` for each part of its quantity: traces for each
block, ends "largest" and "smallest", sum of |lambda| and participation ratio from one spectral density ("sums").

Work other than products H v is counted in products: PASS for a pass over the pixels that computes the diagonal block of every
Gaussian and the ends of their spectra; JACOBIAN for a product with the images' Jacobian.

Errors are relative to a scale: the sum of |H_ii| over the block (traces), |diag H|, and the value itself (ends, sums over the
spectrum; the larger end where an end is zero).  Errors below the round-off of the products count as that.  Matvecs and seconds
are those of all parts of a quantity together.

`python -m notebooks.accuracy` studies them on matrices and small scenes, beside other packages.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from time import perf_counter
from typing import Literal

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float64
from rich.console import Console
from rich.progress import track
from torch import Tensor

from analysis.bench.accuracy.cases import Case, MeteredOperator, checkpoint_case
from analysis.bench.tables import rich_table, write_table
from analysis.console.drawing import draw
from analysis.console.plain import say
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds
from landscape.spectrum.absolute_sum import absolute_sum
from landscape.spectrum.anisotropy import participation_ratio
from landscape.spectrum.density import spectral_density
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import Method as TraceMethod
from landscape.traces.trace import PAPER, TraceSettings, estimate_traces
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.traces import ONE_PERCENT, exact_traces

Origin = Literal["default", "own", "peer"]
PASS = 1.35  # 1.2 for the pass, 0.15 for the ends
# operations of a pixel and a Gaussian along the tangents, over those with the way back (`render.formulas`)
JACOBIAN = 25 / (25 + 46)
BUDGETS = (12, 36)  # matvecs a block
TOLERANCES = (1e-1, 1e-2)  # of residuals; 1e-3 is the default
DENSITIES = ((2, 12), (4, 24), (8, 48))  # start vectors and steps; by default 192 products, divided adaptively
SKETCHES: dict[TraceMethod, str] = {"hutch++": "Hutch++", "xtrace": "XTrace"}


@dataclass(frozen=True, eq=False)
class Answer:
    """An estimate.  error: as the method reports it, nan without; low, high: its interval.  All are vectors for a diagonal."""

    part: str
    value: float | Float64[Tensor, " n"]
    error: float | Float64[Tensor, " n"] = nan
    low: float | Float64[Tensor, " n"] = nan
    high: float | Float64[Tensor, " n"] = nan


Works = Callable[[Case, MeteredOperator, int], list[Answer]]
"""A method's run on a case, with its operator and a seed: an answer for each part."""
Applies = Callable[[Case], bool]


def is_scene(case: Case) -> bool:
    return case.objective is not None


@dataclass(frozen=True, eq=False)
class Method:
    """One estimator at one setting.

    estimator: a common name of the same estimator in several packages, "" of one package alone.
    """

    quantity: str
    name: str
    settings: str
    run: Works
    origin: Origin = "own"
    applies: Applies = lambda _: True
    estimator: str = ""


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene_methods(budgets: tuple[int, ...] = BUDGETS) -> Iterator[Method]:
    """The methods that are compared on a scene; the origin of the defaults is "default"."""
    yield traces("StableGS", "10 probes", PAPER)
    for budget in budgets:
        fixed = TraceSettings.fixed(budget)
        yield traces("Hutchinson, Rademacher", f"{budget} probes", fixed)
        yield traces("Hutchinson, one probe for all", f"{budget} probes", replace(fixed, reading="full"))
        for method, name in SKETCHES.items():
            if budget >= TraceSettings(max_probes=100, method=method).least:
                yield traces(name, f"{budget} matvecs", replace(fixed, method=method))
    yield _exact("rtol 0.01", ONE_PERCENT, "default")
    for samples in (8, 64):
        yield _exact(f"{samples} samples", TraceSettings.fixed(samples))
    yield lanczos("rtol 0.001", EigenSettings(), applies=is_scene)
    yield Method("ends", "led by own blocks", "rtol 0.001", _from_blocks, "default", is_scene)
    for rtol in TOLERANCES:
        yield lanczos(f"rtol {rtol:g}", EigenSettings(rtol=rtol))
    yield lanczos("basis 20", EigenSettings(basis=20))
    yield _density("as it goes", "default")
    for starts, steps in DENSITIES:
        yield _density(f"{starts} x {steps}", "own", matvecs=starts * steps, starts=starts)
    yield _density("as it goes, trace and ends known", "own", known=True)


def traces(
    name: str, text: str, settings: TraceSettings, origin: Origin = "own", applies: Applies = lambda _: True
) -> Method:
    def run(_: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        return _trace_answers(estimate_traces(operator, generator(seed), settings))

    return Method("traces", name, text, run, origin, applies)


def _exact(text: str, settings: TraceSettings, origin: Origin = "own") -> Method:
    def run(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        found = exact_traces(case.scene, generator(seed), settings)
        passes = 2 if case.scene.couples_pixels else 1
        operator.charge(passes * PASS + JACOBIAN * sum(x.matvecs for x in found.values()))
        return _trace_answers(found)

    return Method("traces", "exact pass, pixel pairs sampled", text, run, origin, is_scene)


def _trace_answers(found: Mapping[str, TraceEstimate]) -> list[Answer]:
    return [Answer(part, x.value, x.standard_error, x.low, x.high) for part, x in found.items()]


def lanczos(text: str, settings: EigenSettings, origin: Origin = "own", applies: Applies = lambda _: True) -> Method:
    def run(_: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        return end_answers(extreme_eigenpairs(operator, generator(seed), settings))

    name = "Lanczos, both extremes"
    return Method("ends", name if settings.block == 1 else f"{name}, in blocks", text, run, origin, applies)


def _from_blocks(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
    """Ends from the start vectors of `landscape probe`, but without the pixelwise blocks, which that has from the traces."""
    start = BlockEigenvectors(case.scene, case.scene.block_diagonal(approximate=True)).warm_start()
    operator.charge(PASS)
    return end_answers(extreme_eigenpairs(operator, generator(seed), start=start))


def end_answers(ends: EigenEnds) -> list[Answer]:
    """Eigenvalues with their residuals."""
    pairs = {"largest": ends.largest, "smallest": ends.smallest}
    return [
        Answer(part, float(p.values[0]), float(p.residuals[0]), *p.interval()) for part, p in pairs.items() if len(p)
    ]


def _density(text: str, origin: Origin, known: bool = False, **division: int) -> Method:
    """Sums from one density beside the ends, whose products do not count.  known: ends and trace given, as in a probe."""

    def run(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        before = {"ends": case.ends, "trace": (sum(case.truth.traces.values()), 0.0)} if known else {}
        density = spectral_density(operator, generator(seed + 1), active=case.active, **division, **before)
        found = {
            "sum of |lambda|": absolute_sum(density),
            "participation ratio": participation_ratio(case.ends, density),
        }
        return [
            Answer(part, nan if x.value is None else x.value, (x.high - x.low) / 2, x.low, x.high)
            for part, x in found.items()
        ]

    return Method("sums", "Lanczos quadrature", text, run, origin)


SETTING = ["case", "family", "quantity", "origin", "method", "settings"]
SHOWN = ["method", "settings", "matvecs", "seconds", "true_error", "reported_error", "covered"]


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


def points(table: pd.DataFrame, floors: Mapping[str, float]) -> pd.DataFrame:
    """A line for each setting: means over seeds and parts, of errors root mean squares."""
    table = table.assign(true_error=squares(table, floors), reported_error=table["reported_error"].pow(2))
    columns = ["matvecs", "seconds", "true_error", "reported_error", "covered"]
    means = pd.DataFrame(table.groupby(SETTING, sort=False)[columns].mean()).reset_index()
    return means.assign(true_error=means["true_error"].pow(0.5), reported_error=means["reported_error"].pow(0.5))


def squares(table: pd.DataFrame, floors: Mapping[str, float]) -> np.ndarray:
    """Squared true errors, at least the squared round-off of the case; infinite where the method failed."""
    floor = table["case"].map(lambda case: floors[case]).where(table["quantity"] != "precision", 0.0)
    return np.maximum(table["true_error"].fillna(np.inf).to_numpy(float), floor.to_numpy(float)) ** 2


def run_accuracy(checkpoint: Path, out: Path, seeds: int) -> int:
    """Run every method with every seed; print, write and draw the results; returns the exit code 0."""
    console, errors = Console(), Console(stderr=True)
    out.mkdir(parents=True, exist_ok=True)
    case = checkpoint_case(checkpoint, out)
    jobs = [(method, seed) for method in scene_methods() if method.applies(case) for seed in range(seeds)]
    shown = track(jobs, "accuracy", console=errors, transient=True)
    table = pd.DataFrame(vars(run) for method, seed in shown for run in measure(case, method, seed))
    means = points(table, {case.name: case.round_off})
    for quantity, lines in means.groupby("quantity", sort=False):
        console.print(rich_table(pd.DataFrame(lines).filter(SHOWN), f"{quantity} of {case.name}"))
    write_table(means, out / "accuracy.csv", console)
    say(*draw("accuracy", out / "accuracy.csv"), f"{out}/accuracy_*.png", console=console)
    return 0
