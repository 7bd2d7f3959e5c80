"""Progress of a sweep and its expected end: a line for every cell that ends, and a bar.

The time of a whole training is estimated from the pace of the steps up to each run's last checkpoint: that of the same scene
and method where it is known, else of the same method, else the mean time of those that are known, since a step of one method
may be hundreds of another's.  The time of a probe is estimated from the probes before it, else from the time that it may take.
"""

from collections.abc import Mapping
from datetime import timedelta
from statistics import mean
from time import monotonic
from typing import Literal

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Column

from analysis.console.plain import say
from analysis.runs.sweep.sweep_file import Cell, Sweep
from analysis.train.training_time import TrainingTime

Stage = Literal["train", "probe"]

A_PROBE = 45.0  # seconds, before one has been made


class SweepProgress:
    """A context manager.  to_do: what is missing, by a cell's name; the caller takes away what is done."""

    def __init__(self, sweep: Sweep, to_do: Mapping[str, list[Stage]], jobs: int) -> None:
        self.sweep, self.to_do, self.jobs = sweep, to_do, jobs
        self.active: dict[str, Stage] = {}
        self.probes: list[float] = []
        self._due: tuple[tuple[list[TrainingTime], int], float | None] = (([], 0), None)
        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("sweep", table_column=Column(no_wrap=True)),
            BarColumn(bar_width=20, table_column=Column(min_width=10)),
            TextColumn("{task.fields[state]}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)),
            console=self._console,
            refresh_per_second=2,
            expand=True,
        )
        self._task = self._bar.add_task("", total=sum(cell.steps for cell in sweep.cells), state="")

    def __enter__(self) -> "SweepProgress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def started(self, cell: Cell, stage: Stage) -> None:
        self.active[cell.name] = stage

    def took(self, stage: Stage, seconds: float) -> None:
        if stage == "probe":
            self.probes.append(seconds)

    def ended(self, cell: Cell, statuses: Mapping[str, str]) -> None:
        """Say how it ended, where it began at all, and how much is left."""
        if self.active.pop(cell.name, None) is None:
            return
        count = sum(status == "done" for status in statuses.values())
        line = f"{cell.name}: {statuses[cell.name]}; {count} of {len(statuses)} cells, {self.left()} left"
        say(line, console=self._console)

    def update(self) -> None:
        """Look at the folders and redraw the bar."""
        spent = {cell.name: TrainingTime.read(cell.out) for cell in self.sweep.cells}
        words = [
            f"{name} {spent[name].step}" if stage == "train" else f"{name} probe" for name, stage in self.active.items()
        ]
        state = f"{self.left()} left{': ' * bool(words)}{', '.join(words)}"
        self._bar.update(self._task, completed=sum(each.step for each in spent.values()), state=state)

    def left(self) -> str:
        """The time that is left, counted down between the checkpoints and the ends of stages."""
        now, spent = monotonic(), [TrainingTime.read(cell.out) for cell in self.sweep.cells]
        state = spent, sum(map(len, self.to_do.values()))
        if state != self._due[0]:
            seconds = self.seconds(spent)
            self._due = state, None if seconds is None else now + seconds
        due = self._due[1]
        return "--" if due is None else str(timedelta(seconds=round(max(0.0, due - now))))

    def seconds(self, spent: list[TrainingTime]) -> float | None:
        """About how many seconds are left; None before the first checkpoint."""
        known: dict[tuple[str, ...], list[float]] = {}  # seconds of a whole training, of what is alike
        for cell, each in zip(self.sweep.cells, spent, strict=True):
            if each.step:
                for alike in ((cell.scene, cell.method), (cell.method,), ()):
                    known.setdefault(alike, []).append(each.wall / each.step * cell.steps)
        if not known:
            return None
        total = 0.0
        for cell, each in zip(self.sweep.cells, spent, strict=True):
            alike = next(alike for alike in ((cell.scene, cell.method), (cell.method,), ()) if alike in known)
            total += mean(known[alike]) * (1 - each.step / cell.steps)
            total += self._probe_seconds() * ("probe" in self.to_do[cell.name])
        return total / self.jobs

    def _probe_seconds(self) -> float:
        if self.probes:
            return mean(self.probes)
        options = self.sweep.probe
        if options is None:
            return 0.0
        return (options.seconds or A_PROBE) + options.per_attribute_seconds * options.split_control
