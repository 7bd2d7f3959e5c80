"""Methods of the study beside those of a scene (`analysis.bench.accuracy.command`): of matrices, and of the diagonal."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from math import inf

import torch
from scipy.stats import t as student

from analysis.bench.accuracy.cases import Case, MeteredOperator
from analysis.bench.accuracy.command import (
    PASS,
    Answer,
    Method,
    Origin,
    end_answers,
    generator,
    is_scene,
    lanczos,
    scene_methods,
    traces,
)
from landscape.eigen.eigen import EigenSettings
from landscape.eigen.power import PowerSettings, power_ends
from landscape.traces.diagonal import DiagonalEstimate, estimate_diagonal
from landscape.traces.trace import TraceSettings
from notebooks.accuracy.sketched_diagonal import chosen_diagonal

BUDGETS = (12, 24, 48, 96)  # matvecs a block
PROBES = (8, 16, 64)  # of a diagonal; 32 is the default
CONFIDENCE = 0.95


def is_matrix(case: Case) -> bool:
    return case.objective is None


def own_methods(budgets: tuple[int, ...] = BUDGETS) -> Iterator[Method]:
    """The methods of this library; the origin of its defaults is "default"."""
    yield from scene_methods(budgets)
    yield traces("chosen by its probes", "rtol 0.05", TraceSettings(), "default", is_matrix)
    for rtol in (0.2, 0.1):
        yield traces("chosen by its probes", f"rtol {rtol:g}", TraceSettings(rtol=rtol))
    for rtol in (0.2, 0.1, 0.05):
        yield traces("Hutchinson, adaptive", f"rtol {rtol:g}", TraceSettings(rtol=rtol, method="hutchinson"))
    for budget in budgets:
        settings = replace(TraceSettings.fixed(budget), distribution="gaussian")
        yield traces("Hutchinson, Gaussian", f"{budget} probes", settings)
    yield lanczos("rtol 0.001", EigenSettings(), "default", is_matrix)
    yield lanczos("block 2", EigenSettings(block=2))
    for rtol in (1e-1, 1e-2, 1e-3):
        yield Method("ends", "power iteration, shifted", f"rtol {rtol:g}", partial(_power, rtol=rtol))
    yield from diagonal_methods()


def _power(_: Case, operator: MeteredOperator, seed: int, rtol: float) -> list[Answer]:
    return end_answers(power_ends(operator, generator(seed), PowerSettings(rtol, max_matvecs=300)))


# --- the diagonal -----------------------------------------------------------------------------------------------------


def diagonal_methods() -> Iterator[Method]:
    names = {"chosen by its probes": chosen_diagonal, "random signs": estimate_diagonal}
    for probes, (name, estimate) in product((32, *PROBES), names.items()):
        origin: Origin = "default" if (probes, estimate) == (32, chosen_diagonal) else "own"
        run = partial(_diagonal, probes=probes, estimate=estimate)
        yield Method("diagonal", name, f"{probes} probes", run, origin)
    yield Method("diagonal", "own blocks, pixels alone", "one pass", _diagonal_of_blocks, applies=is_scene)


def _diagonal(
    _: Case, operator: MeteredOperator, seed: int, probes: int, estimate: Callable[..., DiagonalEstimate]
) -> list[Answer]:
    found = estimate(operator, generator(seed), probes)
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
