"""The landscape along a training: at every so many steps the traces, both ends of the spectrum, and the anisotropy indices.

RUN/trajectory.csv            a row for each record, rewritten whole after it (below)
RUN/start/checkpoint.pt       where the training began, so that its landscape can be looked at too

The operator is the exact Hessian of the training loss over all training views (`splat.curvature.objective`).  Lanczos begins
at
the
directions of single Gaussians (`splat.curvature.block_eigenvectors`), as a probe does; from the last record's
eigenvectors it takes the
neighbour of an end for it: on a fern of 300 steps, -0.00234 for -0.00259 in 4 of 4 runs.  Records draw from generators of their
own, seeded by the run's seed and the step: they change no bit of the training, and do not depend on each other.

Time.  The records together may take `share` of the seconds that the steps have taken so far.  What one does not use is left to
later ones.  A record that is not expected to fit is skipped; how long it will take is judged by the last one's least work, and
before the first one by the time of a step.  The numbers depend on the seed alone where no time ran out; with share = inf it
never does.

Columns:

step, gaussians        steps made, and the Gaussians after them
state, note            "whole"; "cut": time ended it early, the note says where; "skipped": nothing measured, the note says why
seconds, time_share    that the record took; all records so far over the training's steps so far
visible_gaussians, parameters    Gaussians in sight, and active parameters
matvecs                products H v of the record
trace_A                of each attribute's block, with _error (standard error), _low, _high (95%), _dim and
_reason
lambda_max, lambda_min with _error (residual) and _reason (why it ended)
literal, saddle, share, effective_rank, mass_quantile    the indices (`landscape.spectrum.anisotropy`), with _low and
_high; the last
                       three where there was time for the spectral density
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf, isinf
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
import torch

from analysis.records.run_files import NO_TIME, RECORDS, read_trajectory
from analysis.records.schema import INDICES
from landscape import (
    CountingOperator,
    EigenSettings,
    SpectralDensity,
    TraceSettings,
    anisotropy,
    extreme_eigenpairs,
    spectral_density,
)
from landscape.eigen.pairs import EigenEnds
from landscape.errors import InputError
from landscape.probes import spawn
from landscape.spectrum.anisotropy import Anisotropy
from landscape.spectrum.density import ActiveSpace
from landscape.traces.estimate import TraceEstimate
from landscape.traces.trace import total_trace
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.model.gaussians import ATTRIBUTES
from splat.scenes.view import View
from splat.training.checkpoint import write_atomically
from splat.training.state import Training

START = "start"
Row = dict[str, Any]
LEAST = 32  # renders with their gradients, for each view, that the least record takes (measured on 8,000 Gaussians)
FEWEST_MATVECS = 20  # for the largest eigenvalue
FEWEST_OF_DENSITY = 16  # products that are worth their time
COLUMNS = (
    "step", "gaussians", "state", "note", "seconds", "time_share", "visible_gaussians", "parameters", "matvecs",
    *(f"trace_{name}{key}" for name in ATTRIBUTES for key in ("", "_error", "_low", "_high", "_dim", "_reason")),
    *(f"lambda_{end}{key}" for end in ("max", "min") for key in ("", "_error", "_reason")),
    *(f"{index}{key}" for index in INDICES for key in ("", "_low", "_high")),
)  # fmt: skip


@dataclass(frozen=True)
class TrajectorySettings:
    """every: steps between records; share: of the time of the steps that the records may take, inf for no limit."""

    every: int
    share: float = 0.1
    traces: TraceSettings = field(default_factory=lambda: TraceSettings(rtol=0.05, max_probes=8))
    eigen: EigenSettings = field(default_factory=lambda: EigenSettings(rtol=1e-2, max_matvecs=150))
    density_matvecs: int = 32

    def __post_init__(self) -> None:
        if self.every < 1:
            raise InputError(f"expected probe_every of at least 1 step, got {self.every}")
        if not self.share > 0:
            raise InputError(f"expected probe_share above 0 (0.1: a tenth of the time of the steps), got {self.share}")


@dataclass(frozen=True, eq=False)
class Found:
    """One record.  least: seconds of what every record does; short: what time ended early."""

    traces: dict[str, TraceEstimate]
    ends: EigenEnds
    density: SpectralDensity | None
    matvecs: int
    least: float
    short: tuple[str, ...]

    @property
    def indices(self) -> Anisotropy:
        return anisotropy(self.ends, self.density)


class Trajectory:
    """The records of one run, beside its training.  Reads those that an interrupted run has left, up to the training's step."""

    def __init__(self, run: Path, training: Training, views: Sequence[View], settings: TrajectorySettings) -> None:
        self.run, self.training, self.views, self.settings = run, training, views, settings
        self.rows = _read_rows(run / RECORDS, training.step)
        self.least: tuple[float, int] | None = None  # seconds of the last record's least work, with how many Gaussians
        _compile(training, views)

    def after_step(self, trained: float) -> None:
        """Record where it is time to.  trained: seconds that the steps so far took."""
        step, last = self.training.step, self.training.config.iterations
        if step % self.settings.every and step != last:
            return
        spent = sum(row["seconds"] for row in self.rows)
        allowed = self.settings.share * trained - spent
        row: Row = {"step": step, "gaussians": len(self.training.gaussians), "state": "skipped", "seconds": 0.0}
        least = self._expected(trained / step)
        if allowed < least:
            row["note"] = f"{NO_TIME}: {least:.2g} s were needed at least, {max(allowed, 0.0):.2g} s were allowed"
        else:
            start = perf_counter()
            try:
                row |= self._recorded(allowed)
            except InputError as error:  # such as no Gaussian in sight: the training may still find its way
                row["note"] = str(error)
            row["seconds"] = perf_counter() - start
        row["time_share"] = (spent + row["seconds"]) / trained
        self.rows.append(row)
        # as objects: a whole number stays one beside a row that has none, as it does in rows read again
        table = pd.DataFrame(self.rows, columns=COLUMNS, dtype=object)
        write_atomically(self.run / RECORDS, table.to_csv(index=False).encode())

    @property
    def skipped(self) -> str:
        """How many records were skipped, why the last one was, and what to do, as a sentence; empty where none was."""
        notes = [row["note"] for row in self.rows if row["state"] == "skipped"]
        if not notes:
            return ""
        remedy = "; --probe-share inf sets no limit to their time" if notes[-1].startswith(NO_TIME) else ""
        return f"{len(notes)} of {len(self.rows)} records of the landscape were skipped ({notes[-1]}){remedy}"

    @property
    def hopeless(self) -> str:
        """Before the first record: why every one of this run will be skipped, and what to do; empty where that is not sure.

        The first record's time is that of so many steps, whatever a step takes.
        """
        first, last = LEAST * len(self.views) / self.settings.share, self.training.config.iterations
        if self.rows or last >= first:
            return ""
        return (
            f"every record of the landscape will be skipped: at a share of {self.settings.share:g} of the time of the steps, "
            f"none fits before step {first:,.0f}, and this run has {last:,}; --probe-share inf sets no limit to their time"
        )

    def _expected(self, step: float) -> float:
        """Seconds that the next record takes at least, where a step takes so many."""
        if isinf(self.settings.share):
            return 0.0
        if self.least is None:
            return LEAST * len(self.views) * step
        seconds, gaussians = self.least
        return seconds * len(self.training.gaussians) / gaussians

    def _recorded(self, seconds: float) -> Row:
        objective = self.training.config.objective(self.training.gaussians, self.views)
        found = measure(objective, self._generator(), self.settings, seconds)
        self.least = found.least, len(self.training.gaussians)
        counts = objective.counts
        return {
            "state": "cut" if found.short else "whole",
            "note": f"out of time: {', '.join(found.short)}" if found.short else "",
            "visible_gaussians": counts.active_gaussians,
            "parameters": counts.active_parameters,
            "matvecs": found.matvecs,
            **_columns(found),
        }

    def _generator(self) -> torch.Generator:
        sequence = np.random.SeedSequence([self.training.config.seed, self.training.step])
        device = self.training.gaussians.flat.device
        return torch.Generator(device).manual_seed(int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1)))


def measure(
    objective: SceneObjective, generator: torch.Generator, settings: TrajectorySettings, seconds: float = inf
) -> Found:
    """One record, in about so many seconds, counted from the call."""
    began, streams = perf_counter(), [spawn(generator) for _ in range(3)]

    def left() -> float:
        return seconds - (perf_counter() - began)

    hessian = SceneHessian(objective)
    operator = CountingOperator(hessian)
    traces = exact_traces(objective, streams[0], replace(settings.traces, max_seconds=max(left() / 2, 0.0)))
    fixed = perf_counter() - began
    leads = BlockEigenvectors(objective, *objective.approximate_blocks).warm_start()
    ends = extreme_eigenpairs(operator, streams[1], replace(settings.eigen, max_seconds=max(left(), 0.0)), leads)
    least = fixed + FEWEST_MATVECS * operator.seconds / operator.matvecs
    short = [f"trace of {name}" for name, trace in traces.items() if trace.reason == "time budget"]
    pairs = {"lambda_max": ends.largest, "lambda_min": ends.smallest}
    short += [name for name, end in pairs.items() if end.reason == "time budget"]
    matvecs = int(min(settings.density_matvecs, left() * operator.matvecs / operator.seconds))
    density = None
    if matvecs < FEWEST_OF_DENSITY:
        short.append("spectral density")
    else:
        active, trace = ActiveSpace(hessian.project, hessian.rank), total_trace(traces)
        density = spectral_density(operator, streams[2], matvecs, active=active, ends=ends, trace=trace)
    return Found(traces, ends, density, operator.matvecs, least, tuple(short))


def _columns(found: Found) -> Row:
    row: Row = {}
    for name, trace in found.traces.items():
        numbers = {"": trace.value, "_error": trace.standard_error, "_low": trace.low, "_high": trace.high}
        row |= {f"trace_{name}{key}": value for key, value in numbers.items()}
        row |= {f"trace_{name}_dim": trace.dim, f"trace_{name}_reason": trace.reason}
    for name, pairs in {"lambda_max": found.ends.largest, "lambda_min": found.ends.smallest}.items():
        row |= {
            name: float(pairs.values[0]),
            f"{name}_error": float(pairs.residuals[0]),
            f"{name}_reason": pairs.reason,
        }
    for name, bracket in found.indices.record().items():
        assert isinstance(bracket, dict)
        row |= {name: bracket["value"], f"{name}_low": bracket["low"], f"{name}_high": bracket["high"]}
    return row


def _read_rows(path: Path, step: int) -> list[Row]:
    """Those up to a step."""
    if not path.is_file():
        return []
    read_trajectory(path)  # which refuses a damaged one
    with path.open(encoding="utf-8", newline="") as stream:
        # as text, which is written back to the same bits
        rows: list[Row] = [dict(row) for row in csv.DictReader(stream)]
    return [row | {"seconds": float(row["seconds"])} for row in rows if int(row["step"]) <= step]


def _compile(training: Training, views: Sequence[View]) -> None:
    """Compile the kernels of a record, which would count as its time, on a few Gaussians."""
    seen = training.config.objective(training.gaussians, views).mask.nonzero()[:8, 0]
    objective = training.config.objective(training.gaussians.select(seen), views)
    least = TrajectorySettings(1, eigen=EigenSettings(max_matvecs=10), density_matvecs=FEWEST_OF_DENSITY)
    measure(objective, torch.Generator(training.gaussians.flat.device).manual_seed(0), least)
