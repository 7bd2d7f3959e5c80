"""`landscape sweep`: methods x seeds x scenes, a `landscape train` and `landscape probe` for each, several at once.

OUT/SCENE/METHOD/SEED       the run, as `landscape train` writes it; in it probe/, where it was probed
OUT/SCENE/METHOD/SEED.log   what its commands said
OUT/results.csv, OUT/summary.csv    see `analysis/runs/sweep/sweep_results.py`; rewritten after every cell

Every cell runs as the commands that a user would type, in processes of their own: one that crashes, or is killed for its
memory, does not end the sweep, several run at once each on its share of the processors, and any can be repeated by hand.
What is there already is not done again: the next start continues where the last one ended.  Several sweeps may work in one
folder, also on machines that share it: each takes cells that no other has.  The results do not depend on the number of
threads, only the seconds do.
"""

import os
import shlex
import subprocess
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from threading import Event
from time import monotonic
from typing import Any, Literal

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Column

from analysis.console.drawing import own_python
from analysis.console.interruption import interruption
from analysis.console.plain import say
from analysis.probe.command import asked
from analysis.probe.options import ProbeOptions
from analysis.records.provenance import usable_cores
from analysis.records.records import ProbeRecord, read_record
from analysis.records.run_files import CHECKPOINT, METRICS, read_scores
from analysis.runs.options import SweepOptions
from analysis.runs.sweep.sweep_file import Cell, Sweep, arguments, read_sweep
from analysis.runs.sweep.sweep_results import PROBE, summarize, tables, unfinished, write_results
from analysis.train.command import planned, resumed
from analysis.train.progress import TrainingTime
from landscape.errors import InputError
from splat.model.untrusted import Taken, locked
from splat.training.origin.subject import Checkpoint

Stage = Literal["train", "probe"]
CELL_FAILED = 1
CELLS_ELSEWHERE = 75  # sysexits.h's EX_TEMPFAIL: the same command later finds them done
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
POLL = 0.5  # seconds


def run_sweep(options: SweepOptions) -> int:
    """Run what is missing; returns the exit code."""
    if options.jobs < 1:
        raise InputError(f"expected at least 1 job, got {options.jobs}")
    whole = read_sweep(options.file, options.out)
    sweep = only(whole, options.only)
    to_do = {cell.name: missing(cell, sweep) for cell in sweep.cells}
    sweep.out.mkdir(parents=True, exist_ok=True)
    with interruption() as interrupted:
        cells = _Cells(sweep, to_do, options.jobs, interrupted, whole)
        cells.run()
    return _conclude(cells, interrupted.exit_code)


def only(sweep: Sweep, names: Sequence[str]) -> Sweep:
    """The cells whose names begin with one of these, part by part; all where none is named."""
    chosen = {name: [cell for cell in sweep.cells if f"{cell.name}/".startswith(f"{name}/")] for name in names}
    if unknown := [name for name, cells in chosen.items() if not cells]:
        known = list(dict.fromkeys(cell.name.rsplit("/", 1)[0] for cell in sweep.cells))
        raise InputError(f"expected --only {', '.join(known)}, or with /SEED, got {unknown[0]}")
    wanted = {cell.name for cells in chosen.values() for cell in cells}
    return replace(sweep, cells=tuple(cell for cell in sweep.cells if not names or cell.name in wanted))


def missing(cell: Cell, sweep: Sweep) -> list[Stage]:
    """Stages that a cell still needs.  ValueError or FileNotFoundError where it cannot be, or has other settings."""
    try:
        scene, _, config, reference = planned(cell.training, cell.out)
        wanted: list[Stage] = ["train", "probe"] if sweep.probe else ["train"]
        if not cell.out.exists():
            return wanted
        remedy = f"remove {cell.out}, or choose another out"
        checkpoint = resumed(cell.out / CHECKPOINT, config, reference, remedy)
    except (InputError, FileNotFoundError) as error:
        raise type(error)(f"{sweep.file}, {cell.name}: {error}") from None
    if checkpoint.training.step < config.iterations or not _scored(cell, checkpoint):
        return wanted
    thinned = checkpoint.thinned(scene, sweep.probe.foreign.max_views) if sweep.probe else checkpoint
    return ["probe"] if sweep.probe and not _probed(cell, sweep.probe, thinned) else []


def _scored(cell: Cell, checkpoint: Checkpoint) -> bool:
    """Whether there are scores of the checkpoint."""
    made = read_scores(cell.out).provenance if (cell.out / METRICS).is_file() else None
    return bool(made and made.fingerprint and made.fingerprint.state == checkpoint.state)


def _probed(cell: Cell, options: ProbeOptions, checkpoint: Checkpoint) -> bool:
    """Whether there is a record of the checkpoint with the numbers that the options ask for."""
    if not (cell.out / PROBE / ProbeRecord.FILE).is_file():
        return False
    found = read_record(cell.out / PROBE, ProbeRecord).data.provenance.fingerprint
    return bool(found and found.answers(asked(options, checkpoint)))


class _Cells:
    """The cells under way.

    to_do: stages by a cell's name; whole: also those not asked for; failed: words by cell; elsewhere: cells of other sweeps.
    """

    def __init__(
        self, sweep: Sweep, to_do: dict[str, list[Stage]], jobs: int, interrupted: Event, whole: Sweep
    ) -> None:
        self.sweep, self.to_do, self.jobs, self.interrupted, self.whole = sweep, to_do, jobs, interrupted, whole
        self.failed: dict[str, str] = {}
        self.elsewhere: list[Cell] = []
        self.running: dict[str, subprocess.Popen[Any]] = {}
        self.active: dict[str, Stage] = {}
        self.console, self.start, self.steps = Console(stderr=True), monotonic(), self._steps()
        self.bar = Progress(
            TextColumn("sweep", table_column=Column(no_wrap=True)),
            BarColumn(bar_width=20, table_column=Column(min_width=10)),
            TextColumn("{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)),
            console=self.console,
            refresh_per_second=2,
            expand=True,
        )
        self.task = self.bar.add_task("", total=sum(cell.steps for cell in sweep.cells))

    @property
    def statuses(self) -> dict[str, str]:
        def status(cell: Cell) -> str:
            if cell.name in self.failed:
                return "failed"
            done = not self.to_do[cell.name] if cell.name in self.to_do else (cell.out / METRICS).is_file()
            return "done" if done else "under way" if cell.out.exists() else "to do"

        return {cell.name: status(cell) for cell in self.whole.cells}

    def write(self) -> pd.DataFrame:
        """The tables of all cells, those too that are not asked for."""
        return write_results(self.whole, self.statuses)

    def _steps(self) -> int:
        """Steps of all trainings until their last checkpoints."""
        return sum(TrainingTime.read(cell.out).step for cell in self.sweep.cells)

    def left(self, steps: int) -> str:
        """The time left, at the pace of the steps that this sweep has made; that of probes is not counted."""
        made, rest = steps - self.steps, sum(cell.steps for cell in self.sweep.cells) - steps
        return str(timedelta(seconds=round((monotonic() - self.start) / made * rest))) if made else "--"

    def run(self) -> None:
        """All that is missing, so many cells at once, until it is done or Ctrl-C stopped it."""
        self.write()  # a file that is damaged is refused before hours are spent
        told: set[int] = set()
        cells = [cell for cell in self.sweep.cells if self.to_do[cell.name]]
        with ThreadPoolExecutor(self.jobs) as pool, self.bar:
            pending = {pool.submit(self._cell, cell) for cell in cells}
            try:
                while pending:
                    done, pending = wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
                    steps = self._steps()
                    for future in done:
                        self._ended(future.result(), steps)
                    under_way = ", ".join(f"{name} {stage}" for name, stage in self.active.items())
                    self.bar.update(self.task, completed=steps, description=f"{self.left(steps)} left: {under_way}")
                    if self.interrupted.is_set():
                        self._tell(told)
            except BaseException:
                self.interrupted.set()
                self._tell(set())
                raise

    def _ended(self, cell: Cell, steps: int) -> None:
        """Write the tables, and say how a cell ended that has begun, and how much is left."""
        self.write()
        if self.active.pop(cell.name, None) is not None:
            count = sum(status == "done" for status in self.statuses.values())
            words = f"{self.statuses[cell.name]}; {count} of {len(self.statuses)} cells, {self.left(steps)} left"
            say(f"{cell.name}: {words}", console=self.console)

    def _tell(self, told: set[int]) -> None:
        """Ask every command that has not been told yet to save and end; told twice it would not save.

        By SIGTERM: under nohup the commands inherit that SIGINT is ignored.
        """
        for process in list(self.running.values()):
            if process.pid not in told:
                told.add(process.pid)
                process.terminate()

    def _cell(self, cell: Cell) -> Cell:
        """Do what is missing, unless another sweep is at it; what fails is noted."""
        if not self.interrupted.is_set():
            cell.out.parent.mkdir(parents=True, exist_ok=True)
            try:
                with locked(lock_of(cell), f"no other sweep at {cell.name}") as lock:
                    self.to_do[cell.name] = missing(cell, self.sweep)  # another may have been here since the start
                    self._stages(cell, lock)
            except Taken:
                self.elsewhere.append(cell)
        return cell

    def _stages(self, cell: Cell, lock: int) -> None:
        while self.to_do[cell.name] and not self.interrupted.is_set():
            stage = self.active[cell.name] = self.to_do[cell.name][0]
            code = self._command(cell, stage, lock)
            if code == 0:
                self.to_do[cell.name].pop(0)
            elif not self.interrupted.is_set():
                self.failed[cell.name] = f"{cell.name}: {stage} ended with exit code {code}; see {log_of(cell)}"
                break

    def _command(self, cell: Cell, stage: Stage, lock: int) -> int:
        """Run `landscape train` or `landscape probe`; returns its exit code, negative where a signal killed it.

        It inherits the lock: a sweep that is killed alone leaves it at work.
        """
        words = (
            arguments("train", replace(cell.training, resume=cell.out.exists()))
            if stage == "train"
            else probe_arguments(cell, self.sweep)
        )
        with log_of(cell).open("ab", buffering=0) as log:
            log.write(f"$ {shlex.join(['landscape', *words])}\n".encode())
            process = subprocess.Popen(
                **own_python("analysis.commands.cli", *words, **_threads(self.jobs)),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=(lock,),
                start_new_session=True,  # the terminal's Ctrl-C comes here alone, and is passed on once
            )
            self.running[cell.name] = process
            code = process.wait()
            del self.running[cell.name]
        return code


def probe_arguments(cell: Cell, sweep: Sweep) -> list[str]:
    assert sweep.probe is not None
    return arguments("probe", replace(sweep.probe, checkpoint=cell.out / CHECKPOINT, out=cell.out / PROBE))


def log_of(cell: Cell) -> Path:
    return cell.out.with_name(f"{cell.out.name}.log")


def lock_of(cell: Cell) -> Path:
    return cell.out.with_name(f".{cell.out.name}.cell")


def _threads(jobs: int) -> dict[str, str]:
    """Environment of one of so many commands: its share of the processors, or of the threads that this process was given."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    share = max(1, (int(given) if given.isdigit() else usable_cores()) // jobs)
    return dict.fromkeys(THREADS, str(share)) if jobs > 1 else {}


def _conclude(cells: _Cells, stopped: int) -> int:
    """The tables, and what did not go well; returns the exit code."""
    sweep, console = cells.sweep, Console()
    cells.to_do |= {cell.name: missing(cell, sweep) for cell in cells.elsewhere}
    elsewhere = [cell.name for cell in cells.elsewhere if cells.to_do[cell.name]]
    rows = cells.write()
    for table in tables(summarize(rows)):
        console.print(table)
    say(*unfinished(rows), style="yellow", console=console)
    say(*cells.failed.values(), style="red", console=console)
    say(*(f"{name}: another sweep is at it" for name in elsewhere), style="yellow", console=console)
    done = sum(not cells.to_do[cell.name] for cell in sweep.cells)
    say(f"{done} of {len(sweep.cells)} cells done; tables: {sweep.out}", console=console)
    if done < len(sweep.cells):
        say("the same command continues", console=console)
    return stopped or (CELL_FAILED if cells.failed else CELLS_ELSEWHERE if elsewhere else 0)
