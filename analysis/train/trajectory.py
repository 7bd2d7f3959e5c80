"""The landscape during a training: traces, both ends of the spectrum and anisotropy indices, every --probe-every steps.

    RUN/trajectory.csv         a row for each record, rewritten whole after it (below)
    RUN/start/checkpoint.pt    the start of the training, for a probe

The operator is the exact Hessian of the training loss over all training views (`splat.curvature.objective`).  Traces are exact
on a CPU, from the diagonal block of every Gaussian, and sampled on a GPU.  Lanczos starts from eigenvectors of these blocks
(`splat.curvature.block_eigenvectors`), as in a probe; from the last record's eigenvectors it may converge to the neighbour of
an end.  Every record has a generator seeded by the run's seed and the step, so that records change no bit of the training and
do not depend on each other.

A record is made before the first step, every so many steps and after the last, all of one kind: whole, or coarse with
--probe-quick, at a third of the time.

Columns:

    step, gaussians        steps done, and Gaussians after them
    state, note            "whole"; "coarse": traces from a few samples, ends to 10% or COARSE_MATVECS products, no density;
                           "skipped": nothing could be measured, for the reason in the note
    seconds                of the record
    visible_gaussians, parameters    Gaussians in sight, and active parameters
    matvecs                products H v of the record
    trace_A                of each attribute's block, with _error (standard error), _low, _high (95%), _dim and _reason
    lambda_max, lambda_min    with _error (residual) and _reason (why the search ended)
    eigenvalue_ratio, negative_ratio, top_mass, participation_ratio
                           indices (`landscape.spectrum.anisotropy`), with _low and _high; the last two of whole records
    of_data, of_question, of_state, of_formulas    digests of its subject (`splat.training.origin.fingerprint`)
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

from analysis.records.run_files import RECORDS, read_trajectory
from landscape import CountingOperator, EigenSettings, TraceSettings, extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds
from landscape.errors import InputError
from landscape.operators.operator import LiftedOperator
from landscape.probes import spawn
from landscape.spectrum.anisotropy import Anisotropy, anisotropy
from landscape.spectrum.density import ActiveSpace, spectral_density
from landscape.spectrum.monitor import COLUMNS as MEASURED
from landscape.spectrum.rules import SpectralDensity
from landscape.traces.estimate import TraceEstimate
from landscape.traces.trace import total_trace
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import LEAST_SAMPLES, block_traces, exact_traces
from splat.model.untrusted import read_table, write_atomically
from splat.scenes.view import View
from splat.training.origin.subject import Checkpoint, SceneReference
from splat.training.state import Training

START = "start"
Row = dict[str, Any]
COARSE_MATVECS = 24  # products of a coarse record's search for the ends
COLUMNS = (*MEASURED, *(f"of_{part}" for part in ("data", "question", "state", "formulas")))


@dataclass(frozen=True)
class TrajectorySettings:
    """every: steps between records.  quick: coarse ones.  traces: if sampled."""

    every: int
    quick: bool = False
    traces: TraceSettings = field(default_factory=lambda: TraceSettings(rtol=0.05, max_probes=8))
    eigen: EigenSettings = field(default_factory=lambda: EigenSettings(rtol=1e-2, max_matvecs=150))
    density_matvecs: int = 32

    def __post_init__(self) -> None:
        if self.every < 1:
            raise InputError(f"expected probe_every of at least 1 step, got {self.every}")


@dataclass(frozen=True, eq=False)
class Found:
    """One record; density: None in a coarse one."""

    traces: dict[str, TraceEstimate]
    ends: EigenEnds
    density: SpectralDensity | None
    matvecs: int

    @property
    def indices(self) -> Anisotropy:
        return anisotropy(self.ends, self.density)


@dataclass(eq=False)
class Trajectory:
    """The records of one run.  Reads those of an interrupted run, up to the training's step."""

    run: Path
    training: Training
    views: Sequence[View]
    settings: TrajectorySettings
    reference: SceneReference

    def __post_init__(self) -> None:
        self.rows = _read_rows(self.run / RECORDS, self.training.step)

    def before_steps(self) -> None:
        """Record the start."""
        if self.training.step == 0 and not self.rows:
            self._record()

    def after_step(self) -> None:
        """Record every so many steps and after the last."""
        if self.training.step % self.settings.every == 0 or self.training.step == self.training.config.iterations:
            self._record()

    def _record(self) -> None:
        """Add a row and write all."""
        import pandas as pd  # slow to import

        start = perf_counter()
        row: Row = {"step": self.training.step, "gaussians": len(self.training.gaussians), "state": "skipped"}
        try:
            row |= self._measured()
        except InputError as error:  # such as no Gaussian in sight: the training may recover
            row["note"] = str(error)
        row["seconds"] = perf_counter() - start
        row |= self._about()
        self.rows.append(row)
        # dtype object keeps integers in a column with gaps, as they are in rows that were read
        table = pd.DataFrame(self.rows, columns=COLUMNS, dtype=object)
        write_atomically(self.run / RECORDS, table.to_csv(index=False).encode())

    @property
    def skipped(self) -> str:
        """Sentence on the records that hold no measurement, with the last reason; empty without any."""
        notes = [row["note"] for row in self.rows if row["state"] == "skipped"]
        return f"of {len(self.rows)} records of the landscape {len(notes)} are empty: {notes[-1]}" if notes else ""

    def _about(self) -> Row:
        settings = asdict(replace(self.settings, every=1))  # which changes no number
        made = Checkpoint(self.training, self.reference).fingerprint(settings, self.training.config.seed)
        return {f"of_{name}": value for name, value in made.digests.items()}

    def _measured(self) -> Row:
        objective = self.training.config.objective(self.training.gaussians, self.views)
        found = measure(objective, self._generator(), self.settings)
        counts = objective.counts
        return {
            "state": "coarse" if self.settings.quick else "whole",
            "note": "",
            "visible_gaussians": counts.visible_gaussians,
            "parameters": counts.active_parameters,
            "matvecs": found.matvecs,
            **_columns(found),
        }

    def _generator(self) -> torch.Generator:
        sequence = np.random.SeedSequence([self.training.config.seed, self.training.step])
        device = self.training.gaussians.flat.device
        return torch.Generator(device).manual_seed(int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1)))


def measure(objective: SceneObjective, generator: torch.Generator, settings: TrajectorySettings) -> Found:
    """One record."""
    streams = [spawn(generator) for _ in range(3)]
    hessian, whole = SceneHessian(objective), not settings.quick
    operator = CountingOperator(hessian)
    exact = whole and objective.active.flat.device.type == "cpu"
    if exact:
        traces = block_traces(objective)
    else:
        traces = exact_traces(objective, streams[0], settings.traces, samples=None if whole else LEAST_SAMPLES)
    eigen = settings.eigen
    if not whole:
        eigen = replace(eigen, rtol=max(eigen.rtol, 0.1), max_matvecs=min(eigen.max_matvecs, COARSE_MATVECS))
    leads = BlockEigenvectors(objective, *objective.known_blocks(exact=exact)).warm_start()
    lifted = LiftedOperator(operator, hessian.project, spawn(streams[1]))  # as in a probe
    ends = extreme_eigenpairs(lifted, streams[1], eigen, leads)
    density = None
    if whole:
        active, trace = ActiveSpace(hessian.project, hessian.rank), total_trace(traces)
        most = settings.density_matvecs
        density = spectral_density(operator, streams[2], most, active=active, ends=ends, trace=trace)
    return Found(traces, ends, density, operator.matvecs)


def _columns(found: Found) -> Row:
    row: Row = {}
    for name, trace in found.traces.items():
        row |= trace.columns(f"trace_{name}")
    row |= found.ends.largest.columns("lambda_max") | found.ends.smallest.columns("lambda_min")
    for name, bracket in found.indices.record().items():
        assert isinstance(bracket, dict)
        row |= {name: bracket["value"], f"{name}_low": bracket["low"], f"{name}_high": bracket["high"]}
    return row


def _read_rows(path: Path, step: int) -> list[Row]:
    """Rows up to a step, as text, so that they are written again unchanged."""
    if not path.is_file():
        return []
    table, text = read_trajectory(path), read_table(path, dtype=str, na_filter=False)
    rows: list[Row] = [dict(zip(text, row, strict=True)) for row in text.itertuples(index=False)]
    return [row for row, at in zip(rows, table["step"], strict=True) if at <= step]
