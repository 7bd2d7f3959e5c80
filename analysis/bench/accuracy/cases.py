"""Operators whose true numbers are known, and a trained scene as one.  Its truth is a long run, kept in OUT/truth.json:

    traces    `exact_traces` of SAMPLES samples
    ends      Lanczos to a residual of FINE
    sums      quadrature with STARTS x STEPS products

The file belongs to one checkpoint.  The truth of the sums is known to half its brackets, a few
percent; that of the diagonal, which would take a product for every row, is not.

The scale of a block's trace is sum |H_ii| over the block (over all rows where the block is zero).  That of an end of the
spectrum is its magnitude, as in the stopping rules of all methods (the larger end's, where it is zero to round-off).
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter

import torch
from jaxtyping import Float64
from torch import Tensor

from analysis.bench.workloads import workload_of
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds
from landscape.operators.operator import SymmetricOperator, require_vectors
from landscape.spectrum.absolute_sum import absolute_sum
from landscape.spectrum.anisotropy import participation_ratio
from landscape.spectrum.density import ActiveSpace, spectral_density
from landscape.traces.trace import TraceSettings, total_trace
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.model.untrusted import read_json, write_atomically

SAMPLES, FINE, MOST = 128, 1e-6, 250  # MOST: products of the search for the ends
STARTS, STEPS = 6, 24
TRUTH = "truth.json"


@dataclass(frozen=True, eq=False)
class Truth:
    """True values that estimates are compared with.  diagonal: None where not known."""

    traces: Mapping[str, float]
    scales: Mapping[str, float]
    largest: float
    smallest: float
    absolute_sum: float
    participation_ratio: float
    diagonal: Float64[Tensor, " n"] | None


@dataclass(frozen=True, eq=False)
class Case:
    """An operator with its true values.

    family: of its kind, for which some methods are.  price: seconds of a product with k vectors; None: those measured.
    objective: the scene, None of a matrix.
    """

    name: str
    family: str
    operator: SymmetricOperator
    truth: Truth
    price: Callable[[int], float] | None = None
    objective: SceneObjective | None = None
    active: ActiveSpace | None = None

    @property
    def round_off(self) -> float:
        """Round-off of an estimate, relative to its scale: sqrt(rows) eps, of independent roundings in every row."""
        return self.operator.dim**0.5 * torch.finfo(self.operator.dtype).eps

    @property
    def scene(self) -> SceneObjective:
        """The objective, of a case that is a scene."""
        assert self.objective is not None
        return self.objective

    @cached_property
    def ends(self) -> EigenEnds:
        """Both ends, by `extreme_eigenpairs` with its defaults."""
        return extreme_eigenpairs(self.operator, torch.Generator().manual_seed(0))


class MeteredOperator:
    """The operator of a case, which counts its products.

    matvecs: vectors applied, and other work charged.  seconds: of the products, at the case's price where it has one; spent:
    of the products as measured.
    """

    def __init__(self, case: Case) -> None:
        self.inner, self.price = case.operator, case.price
        self.dim, self.blocks, self.dtype = case.operator.dim, case.operator.blocks, case.operator.dtype
        self.matvecs, self.seconds, self.spent = 0.0, 0.0, 0.0

    def apply(self, V: Tensor) -> Tensor:
        require_vectors(V, self.dim, self.dtype)
        start = perf_counter()
        result = self.inner.apply(V)
        spent = perf_counter() - start
        self.matvecs += V.shape[1]
        self.spent += spent
        self.seconds += spent if self.price is None else self.price(V.shape[1])
        return result

    def charge(self, matvecs: float) -> None:
        """Count other work, in units of a product with one vector."""
        self.matvecs += matvecs


def checkpoint_case(path: Path, out: Path) -> Case:
    """The case of a checkpoint; its truth is read from OUT/truth.json, or computed and written there."""
    if not path.is_file():
        raise FileNotFoundError(f"expected a checkpoint as written by `landscape train`, got no file {path}")
    of = workload_of(path)
    objective = SceneObjective(of.gaussians, of.views, of.loss, of.background, of.settings)
    hessian = SceneHessian(objective)
    key = {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "dim": hessian.dim}
    stored = out / TRUTH
    kept = read_json(stored) if stored.is_file() else {}
    if kept.get("of") != key:
        kept = {"of": key, "truth": asdict(_truth(objective, hessian))}
        write_atomically(stored, json.dumps(kept, indent=1).encode())
    active = ActiveSpace(hessian.project, hessian.rank)
    return Case(of.name, "checkpoint", hessian, Truth(**kept["truth"]), None, objective, active)


def _truth(objective: SceneObjective, hessian: SceneHessian) -> Truth:
    def generator(stream: int) -> torch.Generator:
        return torch.Generator().manual_seed(1_000_000 + stream)  # far from the seeds of the methods' runs

    traces = exact_traces(objective, generator(0), TraceSettings.fixed(SAMPLES))
    scales = {
        name: float(part.abs().sum()) for name, part in objective.block_diagonal(approximate=True).diagonals.items()
    }
    ends = extreme_eigenpairs(hessian, generator(1), EigenSettings(rtol=FINE, basis=128, max_matvecs=MOST))
    active, trace = ActiveSpace(hessian.project, hessian.rank), total_trace(traces)
    density = spectral_density(hessian, generator(2), STARTS * STEPS, STARTS, active=active, ends=ends, trace=trace)
    rank = participation_ratio(ends, density).value
    assert rank is not None
    return Truth(
        traces={name: trace.value for name, trace in traces.items()},
        scales=scales,
        largest=float(ends.largest.values[0]),
        smallest=float(ends.smallest.values[0]),
        absolute_sum=absolute_sum(density).value or 0.0,
        participation_ratio=rank,
        diagonal=None,
    )
