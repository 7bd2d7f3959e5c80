"""Times that can be compared on a machine that others use too, and the memory of a call.

Calls to compare are timed in turns, so that what disturbs one disturbs all; each round runs them in the opposite order of
the last.  The minimum is the cost on a quiet machine; the median says what to expect, and how quiet the machine was.
"""

import time
import tracemalloc
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import TypeVar

import torch

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
    return {name: Timing(tuple(times)) for name, times in seconds.items()}


class Meter:
    """Wall clock, and memory of NumPy's arrays: the most that a call allocates when it is made again."""

    device = torch.device("cpu")

    def seconds(self, call: Callable[[], object]) -> float:
        return wall_clock(call)

    def allocated(self, call: Callable[[], object]) -> int:
        call()
        tracemalloc.start()
        call()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak


class GpuMeter(Meter):
    """Time between two CUDA events around a call's launches, once the device is idle; memory of torch's allocator."""

    def __init__(self, device: torch.device):
        self.device = device

    def seconds(self, call: Callable[[], object]) -> float:
        with torch.cuda.device(self.device):
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            start.record()
            call()
            end.record()
            end.synchronize()
            return start.elapsed_time(end) / 1e3

    def allocated(self, call: Callable[[], object]) -> int:
        call()
        torch.cuda.synchronize(self.device)
        torch.cuda.reset_peak_memory_stats(self.device)
        before = torch.cuda.memory_allocated(self.device)
        call()
        return torch.cuda.max_memory_allocated(self.device) - before


def meter_of(device: torch.device) -> Meter:
    return Meter() if device.type == "cpu" else GpuMeter(device)
