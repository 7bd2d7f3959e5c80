"""Every estimator of `landscape` and `splat.curvature.traces` at the settings that the accuracy study compares.

A method is run on an operator that counts, with a seed, and returns an `Answer` for each part of its quantity:

    traces            one part a block
    ends              "largest" and "smallest"
    sum of |lambda|, effective rank                    one part, from one spectral density ("sums")
    diagonal          one part, a vector

Work other than products H v is counted in products: PASS for a pass over the pixels that computes the diagonal block of every
Gaussian and the ends of their spectra; JACOBIAN for a product with the images' Jacobian.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from math import inf, nan
from typing import Literal

import torch
from jaxtyping import Float64
from scipy.stats import t as student
from torch import Tensor

from analysis.bench.accuracy.cases import Case, MeteredOperator
from analysis.bench.speed.scene import OPERATIONS
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds
from landscape.eigen.power import PowerSettings, power_ends
from landscape.spectrum.absolute_sum import absolute_sum
from landscape.spectrum.anisotropy import effective_rank
from landscape.spectrum.density import spectral_density
from landscape.traces.diagonal import Method as DiagonalMethod
from landscape.traces.diagonal import estimate_diagonal
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import Method as TraceMethod
from landscape.traces.trace import PAPER, TraceSettings, estimate_traces
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.traces import ONE_PERCENT, exact_traces

Origin = Literal["default", "own", "peer"]
PASS = 1.35  # 1.2 for the pass, 0.15 for the ends
# a product's operations without those of its backward pass
JACOBIAN = OPERATIONS["J u 1"] / (OPERATIONS["J u 1"] + OPERATIONS["tangent of backward 1"])
BUDGETS = (12, 24, 48, 96)  # matvecs a block
FEW_BUDGETS = (12, 36)  # on a checkpoint, whose products are expensive
LEFT_OUT = (  # on a checkpoint: on matrices these are no better than another method
    "Hutchinson, Gaussian",
    "Hutchinson, adaptive",
    "chosen by",
    "PyHessian",
    "lobpcg",
    "power iteration",
    "in blocks",
)
TOLERANCES = (1e-1, 1e-2)  # of residuals; 1e-3 is the default
DENSITIES = ((2, 12), (4, 24), (8, 48))  # start vectors and steps; by default 192 products, divided adaptively
PROBES = (8, 16, 64)  # of a diagonal; 32 is the default
CONFIDENCE = 0.95
SKETCHES: dict[TraceMethod, str] = {"hutch++": "Hutch++", "xtrace": "XTrace"}


@dataclass(frozen=True, eq=False)
class Answer:
    """An estimate.  error: as the method reports it, nan without; low, high: its interval.  All are vectors for a diagonal."""

    part: str
    value: float | Float64[Tensor, " n"]
    error: float | Float64[Tensor, " n"] = nan
    low: float | Float64[Tensor, " n"] = nan
    high: float | Float64[Tensor, " n"] = nan


Run = Callable[[Case, MeteredOperator, int], list[Answer]]
"""A method's run on a case, with its operator and a seed: an answer for each part."""
Applies = Callable[[Case], bool]


def always(_: Case) -> bool:
    return True


def is_scene(case: Case) -> bool:
    return case.objective is not None


def is_matrix(case: Case) -> bool:
    return case.objective is None


@dataclass(frozen=True, eq=False)
class Method:
    """One estimator at one setting.

    estimator: a common name of the same estimator in several packages, "" of one package alone.
    """

    quantity: str
    name: str
    settings: str
    run: Run
    origin: Origin = "own"
    applies: Applies = always
    estimator: str = ""


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def affordable(method: Method) -> bool:
    """Whether a method is run on a checkpoint, where the true diagonal is not known."""
    return method.quantity != "diagonal" and not any(name in method.name for name in LEFT_OUT)


def own_methods(budgets: tuple[int, ...] = BUDGETS) -> Iterator[Method]:
    """The methods of this library; the origin of its defaults is "default"."""
    yield from trace_methods(budgets)
    yield from end_methods()
    yield from density_methods()
    yield from diagonal_methods()


# --- traces -----------------------------------------------------------------------------------------------------------


def trace_methods(budgets: tuple[int, ...]) -> Iterator[Method]:
    yield _traces("chosen by its probes", "rtol 0.05", TraceSettings(), "default", is_matrix)
    for rtol in (0.2, 0.1):
        yield _traces("chosen by its probes", f"rtol {rtol:g}", TraceSettings(rtol=rtol))
    for rtol in (0.2, 0.1, 0.05):
        yield _traces("Hutchinson, adaptive", f"rtol {rtol:g}", TraceSettings(rtol=rtol, method="hutchinson"))
    yield _traces("StableGS", "10 probes", PAPER)
    for budget in budgets:
        fixed = TraceSettings.fixed(budget)
        yield _traces("Hutchinson, Rademacher", f"{budget} probes", fixed)
        yield _traces("Hutchinson, Gaussian", f"{budget} probes", replace(fixed, distribution="gaussian"))
        yield _traces("Hutchinson, one probe for all", f"{budget} probes", replace(fixed, reading="full"))
        for method, name in SKETCHES.items():
            if budget >= TraceSettings(max_probes=100, method=method).least:
                yield _traces(name, f"{budget} matvecs", replace(fixed, method=method))
    yield _exact("rtol 0.01", ONE_PERCENT, "default")
    for samples in (8, 64):
        yield _exact(f"{samples} samples", TraceSettings.fixed(samples))


def _traces(name: str, text: str, settings: TraceSettings, origin: Origin = "own", applies: Applies = always) -> Method:
    def run(_: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        return _trace_answers(estimate_traces(operator, generator(seed), settings))

    return Method("traces", name, text, run, origin, applies)


def _exact(text: str, settings: TraceSettings, origin: Origin = "own") -> Method:
    def run(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        found = exact_traces(case.scene, generator(seed), settings)
        passes = 2 if case.scene.couples_pixels else 1
        operator.charge(passes * PASS + JACOBIAN * sum(x.matvecs for x in found.values()))
        return _trace_answers(found)

    return Method("traces", "exact pass, sampled coupling", text, run, origin, is_scene)


def _trace_answers(found: Mapping[str, TraceEstimate]) -> list[Answer]:
    return [Answer(part, x.value, x.standard_error, x.low, x.high) for part, x in found.items()]


# --- both ends --------------------------------------------------------------------------------------------------------


def end_methods() -> Iterator[Method]:
    yield _lanczos("rtol 0.001", EigenSettings(), "default", is_matrix)
    yield _lanczos("rtol 0.001", EigenSettings(), applies=is_scene)
    yield Method("ends", "led by own blocks", "rtol 0.001", _from_blocks, "default", is_scene)
    for rtol in TOLERANCES:
        yield _lanczos(f"rtol {rtol:g}", EigenSettings(rtol=rtol))
    yield _lanczos("basis 20", EigenSettings(basis=20))
    yield _lanczos("block 2", EigenSettings(block=2))
    for rtol in (1e-1, 1e-2, 1e-3):
        yield Method("ends", "power iteration, shifted", f"rtol {rtol:g}", partial(_power, rtol=rtol))


def _lanczos(text: str, settings: EigenSettings, origin: Origin = "own", applies: Applies = always) -> Method:
    def run(_: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        return _end_answers(extreme_eigenpairs(operator, generator(seed), settings))

    name = "Lanczos, both ends"
    return Method("ends", name if settings.block == 1 else f"{name}, in blocks", text, run, origin, applies)


def _from_blocks(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
    """Ends from the start vectors of `landscape probe`, but without the pixelwise blocks, which that has from the traces."""
    start = BlockEigenvectors(case.scene, case.scene.block_diagonal(approximate=True)).warm_start()
    operator.charge(PASS)
    return _end_answers(extreme_eigenpairs(operator, generator(seed), start=start))


def _power(_: Case, operator: MeteredOperator, seed: int, rtol: float) -> list[Answer]:
    return _end_answers(power_ends(operator, generator(seed), PowerSettings(rtol, max_matvecs=300)))


def _end_answers(ends: EigenEnds) -> list[Answer]:
    """Eigenvalues with their residuals."""
    pairs = {"largest": ends.largest, "smallest": ends.smallest}
    return [
        Answer(part, float(p.values[0]), float(p.residuals[0]), *p.interval()) for part, p in pairs.items() if len(p)
    ]


# --- sums over the spectrum -------------------------------------------------------------------------------------------


def density_methods() -> Iterator[Method]:
    """Sums from one density.  Products for the ends (`Case.ends`) do not count, as a probe has both ends."""
    yield _density("as it goes", "default")
    for starts, steps in DENSITIES:
        yield _density(f"{starts} x {steps}", "own", matvecs=starts * steps, starts=starts)
    yield _density("as it goes, trace and ends known", "own", known=True)


def _density(text: str, origin: Origin, known: bool = False, **division: int) -> Method:
    """known: with the true trace and the ends given, as in a probe; their products do not count."""

    def run(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        before = {"ends": case.ends, "trace": (sum(case.truth.traces.values()), 0.0)} if known else {}
        density = spectral_density(operator, generator(seed + 1), active=case.active, **division, **before)
        found = {"sum of |lambda|": absolute_sum(density), "effective rank": effective_rank(case.ends, density)}
        return [
            Answer(part, nan if x.value is None else x.value, (x.high - x.low) / 2, x.low, x.high)
            for part, x in found.items()
        ]

    return Method("sums", "Lanczos quadrature", text, run, origin)


# --- the diagonal -----------------------------------------------------------------------------------------------------


def diagonal_methods() -> Iterator[Method]:
    names: dict[DiagonalMethod, str] = {"auto": "chosen by its probes", "signs": "random signs"}
    for probes, (method, name) in product((32, *PROBES), names.items()):
        origin: Origin = "default" if (probes, method) == (32, "auto") else "own"
        run = partial(_diagonal, probes=probes, method=method)
        yield Method("diagonal", name, f"{probes} probes", run, origin)
    yield Method("diagonal", "own blocks, no coupling", "one pass", _diagonal_of_blocks, applies=is_scene)


def _diagonal(_: Case, operator: MeteredOperator, seed: int, probes: int, method: DiagonalMethod) -> list[Answer]:
    found = estimate_diagonal(operator, generator(seed), probes, method=method)
    half = float(student.ppf((1 + CONFIDENCE) / 2, found.samples.shape[1] - 1)) * found.standard_errors
    return [Answer("all", found.values, found.standard_errors, found.values - half, found.values + half)]


def _diagonal_of_blocks(case: Case, operator: MeteredOperator, _: int) -> list[Answer]:
    """The diagonal of the Gaussians' approximate blocks, without radial directions of quaternions; exact without SSIM."""
    parts = case.scene.block_diagonal(approximate=True).diagonals_across(case.scene.active.quats)
    values = torch.empty(case.operator.dim, dtype=torch.float64)
    for name, rows in case.operator.blocks.items():
        values[rows] = parts[name].reshape(-1)
    operator.charge(PASS)
    error = torch.full_like(values, inf if case.scene.couples_pixels else 0.0)
    return [Answer("all", values, error, values - error, values + error)]
