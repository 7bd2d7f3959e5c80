"""Long work in named stages: a line for each with the time it took and the time remaining, and how far it is."""

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column

from landscape.results import Progress as Report


class Stages:
    """A context manager; `stage(name)` is one too, and gives what the estimators call with their progress.

    Without a console nothing is printed; timing: seconds a stage, in the order run.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.timing: dict[str, float] = {}
        self._progress = Progress(
            SpinnerColumn(finished_text="✓"),
            TextColumn("{task.description}", table_column=Column(no_wrap=True, min_width=15)),
            BarColumn(bar_width=12, table_column=Column(min_width=12)),
            TimeElapsedColumn(table_column=Column(no_wrap=True, min_width=7)),
            TimeRemainingColumn(table_column=Column(no_wrap=True, min_width=7)),
            TextColumn(
                "{task.fields[state]}", style="dim", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)
            ),
            console=console,
            disable=console is None,
            refresh_per_second=4,
            expand=True,
        )

    def __enter__(self) -> "Stages":
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._progress.stop()

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Time the block; call what it gives with the units done, the most there can be, and a few words."""
        task = self._progress.add_task(name, total=None, state="")

        def report(done: int, most: int, state: str) -> None:
            self._progress.update(task, completed=done, total=most, state=f"{done}/{most} {state}")

        start = perf_counter()
        yield report
        self.timing[name] = perf_counter() - start
        done = self._progress.tasks[task].completed or 1  # an estimator that is done early has used less than the most
        self._progress.update(task, completed=done, total=done)
