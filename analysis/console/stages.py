"""Long work in named stages: a line for each with the time it took, how far it is, and at which rate.

Off a terminal there are no bars: a line when a stage ends, and one now and then while it runs.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from time import perf_counter
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column

from analysis.console.interruption import look
from analysis.console.plain import say
from landscape.results import Progress as Report

Stage = Callable[[str], AbstractContextManager[Report]]
NOW_AND_THEN = 15.0  # seconds between lines off a terminal


def pace(done: int, seconds: float) -> str:
    """The rate of a stage in words, after so many units in so many seconds; empty where that is not known yet.

    >>> pace(20, 10.0), pace(1, 130.0), pace(0, 5.0)
    (', 2 a second', ', 130 s each so far', '')
    """
    if not done or seconds <= 1:
        return ""
    return f", {done / seconds:.2g} a second" if done >= seconds else f", {seconds / done:.3g} s each so far"


class Stages:
    """A context manager; `stage(name)` is one too, and gives what the estimators call with their progress.

    Without a console nothing is printed.  timing: seconds a stage, in the order run.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.timing: dict[str, float] = {}
        bars = console is not None and console.is_terminal
        self._console = None if bars or console is None or console.quiet else console
        self._said = perf_counter()
        self._progress = Progress(
            SpinnerColumn(finished_text="✓"),
            TextColumn("{task.description}", table_column=Column(no_wrap=True, min_width=15)),
            BarColumn(bar_width=12, table_column=Column(min_width=12)),
            TimeElapsedColumn(table_column=Column(no_wrap=True, min_width=7)),
            TextColumn(
                "{task.fields[state]}", style="dim", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)
            ),
            console=console,
            disable=not bars,
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
        """Time the block; call what it gives with the units done, the most there can be, and a few words.

        Interrupted, at its begin and where it is called, once a signal has come.
        """
        look()
        task = self._progress.add_task(name, total=None, state="")
        start = perf_counter()

        def report(done: int, most: int, state: str) -> None:
            look()
            spent = perf_counter() - start
            words = f"{done} of at most {most} done{pace(done, spent)}"
            self._progress.update(task, completed=done, total=most, state=f"{words}; {state}")
            if perf_counter() - self._said > NOW_AND_THEN:
                self._say(f"{name}: {words}")

        yield report
        self.timing[name] = perf_counter() - start
        done = self._progress.tasks[task].completed or 1  # an estimator that is done early has used less than the most
        self._progress.update(task, completed=done, total=done)
        self._say(f"{name}: {self.timing[name]:.1f} s")

    def known(self, name: str, seconds: float) -> None:
        """Show a stage as done whose result an earlier run has kept; seconds: that it took then."""
        self.timing[name] = seconds
        self._progress.update(self._progress.add_task(name, total=1, state="kept from before"), completed=1)
        self._say(f"{name}: kept from before")

    def _say(self, words: str) -> None:
        self._said = perf_counter()
        if self._console is not None:
            say(words, console=self._console)
