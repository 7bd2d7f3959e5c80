"""A trained scene as a case of the accuracy study.  Its truth is a long run, kept in OUT/truth.json:

    traces    `exact_traces` of SAMPLES samples
    ends      Lanczos to a residual of FINE
    sums      quadrature with STARTS x STEPS products

The file belongs to one checkpoint at one size of its pictures; for another it is computed again.  The truth of the sums is
known to half its brackets, a few percent; estimates that are more accurate cannot be compared.  There is no truth of the
diagonal, which would take a product for every row.
"""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import torch

from analysis.bench.accuracy.cases import Case, Truth
from analysis.bench.workloads import workload_of
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.spectrum.absolute_sum import absolute_sum
from landscape.spectrum.anisotropy import effective_rank
from landscape.spectrum.density import ActiveSpace, spectral_density
from landscape.traces.trace import TraceSettings, total_trace
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.training.checkpoint import write_atomically

SAMPLES, FINE, MOST = 128, 1e-6, 250  # MOST: products of the search for the ends
STARTS, STEPS = 6, 24
TRUTH = "truth.json"


def checkpoint_case(path: Path, out: Path, downscale: float = 1.0) -> Case:
    """The case of a checkpoint; its truth is read from OUT/truth.json, or computed and written there."""
    if not path.is_file():
        raise FileNotFoundError(f"expected a checkpoint as written by `landscape train`, got no file {path}")
    workload = workload_of(path)
    if downscale != 1:
        workload = workload.resized(1 / downscale)
    objective = SceneObjective(
        workload.gaussians, workload.views, workload.loss, workload.background, workload.settings
    )
    hessian = SceneHessian(objective)
    key = {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "downscale": downscale, "dim": hessian.dim}
    stored = out / TRUTH
    kept = json.loads(stored.read_text()) if stored.is_file() else {}
    if kept.get("of") != key:
        kept = {"of": key, "truth": asdict(_truth(objective, hessian))}
        write_atomically(stored, json.dumps(kept, indent=1).encode())
    active = ActiveSpace(hessian.project, hessian.rank)
    return Case(workload.name, "checkpoint", hessian, Truth(**kept["truth"]), None, objective, active)


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
    rank = effective_rank(ends, density).value
    assert rank is not None
    return Truth(
        traces={name: trace.value for name, trace in traces.items()},
        scales=scales,
        largest=float(ends.largest.values[0]),
        smallest=float(ends.smallest.values[0]),
        absolute_sum=absolute_sum(density).value or 0.0,
        effective_rank=rank,
        diagonal=None,
    )
