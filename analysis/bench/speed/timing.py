"""Times that can be compared on a machine that others use too.

Calls to compare are timed in turns, so that what disturbs one disturbs all; each round runs them in the opposite order of
the last.  The minimum is the cost on a quiet machine; the median says what to expect, and how quiet the machine was.
"""

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import TypeVar

Name = TypeVar("Name", bound=Hashable)
PAUSE = 0.002  # seconds before every call: threads that spin after their work (OpenMP's) have gone to sleep


@dataclass(frozen=True)
class Timing:
    """Seconds of every repetition of a call."""

    seconds: tuple[float, ...]

    @property
    def minimum(self) -> float:
        return min(self.seconds)

    @property
    def median(self) -> float:
        return median(self.seconds)

    def __add__(self, other: "Timing") -> "Timing":
        """Time of both calls, one after the other: round by round."""
        return Timing(tuple(a + b for a, b in zip(self.seconds, other.seconds, strict=True)))

    def __truediv__(self, count: float) -> "Timing":
        """Time of one of `count` equal parts."""
        return Timing(tuple(second / count for second in self.seconds))


def wall_clock(call: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    time.sleep(PAUSE)
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def interleaved(
    calls: Mapping[Name, Callable[[], object]],
    repetitions: int,
    on_round: Callable[[], None] = lambda: None,
    clock: Callable[[Callable[[], object]], float] = wall_clock,
) -> dict[Name, Timing]:
    """Time every call `repetitions` times, in turns, after one call each that is not timed (it may compile)."""
    seconds: dict[Name, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    names = list(calls)
    for turn in range(repetitions):
        for name in names if turn % 2 == 0 else reversed(names):
            seconds[name].append(clock(calls[name]))
        on_round()
    return {name: Timing(tuple(times)) for name, times in seconds.items()}


def time_lines(about: Mapping[str, object], times: Mapping[str, Timing]) -> list[dict]:
    """A table's lines, one a stage: what is said of all of them, and the minimum and median of its times, ms."""
    return [
        {**about, "stage": name, "minimum_ms": 1e3 * time.minimum, "median_ms": 1e3 * time.median}
        for name, time in times.items()
    ]
