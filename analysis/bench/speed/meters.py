"""Meters of a device: a clock, the memory of a call, and the machine's ceilings.

HostMeter   wall clock; memory of NumPy's arrays, by tracemalloc
GpuMeter    time between two CUDA events around a call's launches, once the device has nothing else to do; memory of torch's
            allocator.  What a call does on the host counts as far as the device waits for it

ceilings    fused multiply-adds a second, those of a product of two matrices; bytes a second, read and written, of a copy that
            fits no cache.  Both by every thread together
"""

import tracemalloc
from collections.abc import Callable
from typing import Protocol

import torch

from analysis.bench.speed.timing import interleaved, wall_clock

COPIED = 1 << 28  # bytes of each of the two arrays of a copy: five times an H200's second-level cache
ROWS = {"cpu": 768, "cuda": 8192}  # of matrices: a product takes milliseconds, as long calls are disturbed
REPETITIONS = 20  # of the calls that measure a ceiling


class Meter(Protocol):
    """device: where calls run; seconds(call): the time that a call takes; allocated(call): the most bytes that it allocates at
    a time, when it is made for the second time: some things are allocated once."""

    device: torch.device

    def seconds(self, call: Callable[[], object]) -> float: ...

    def allocated(self, call: Callable[[], object]) -> int: ...


class HostMeter:
    """Meter of the CPU."""

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


class GpuMeter:
    """Meter of one GPU."""

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
    return HostMeter() if device.type == "cpu" else GpuMeter(device)


def fma_peak(meter: Meter) -> float:
    """float32 fused multiply-adds a second."""
    n = ROWS[meter.device.type]
    A, B, C = (torch.rand(n, n, device=meter.device) for _ in range(3))
    return n**3 / _least_seconds(meter, lambda: torch.mm(A, B, out=C))


def bandwidth(meter: Meter, size: int = COPIED) -> float:
    """Bytes a second that a copy of so many bytes reads and writes."""
    source, target = (torch.zeros(size // 4, device=meter.device) for _ in range(2))
    return 2 * size / _least_seconds(meter, lambda: target.copy_(source))


def _least_seconds(meter: Meter, call: Callable[[], object]) -> float:
    return interleaved({"call": call}, REPETITIONS, clock=meter.seconds)["call"].minimum
