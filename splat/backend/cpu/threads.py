"""Run a compiled kernel on every core.

Kernels release the interpreter's lock and are called from a pool of Python threads: a start costs some 30 microseconds, and
no second thread runtime spins beside torch's.  The number of threads is torch's (`torch.set_num_threads`).  No result
depends on it: kernels write to places of their own and sum in a fixed order.
"""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache

import numpy as np
import torch

LIGHT = 8192  # numbers that take some ten nanoseconds each: fewer are not worth the start of a thread
ALIGNED = 16  # matrices: of whatever size, these many begin at a multiple of 64 bytes, in float32 and in float64


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="splat")


_here = threading.local()


@contextmanager
def single_threaded() -> Iterator[None]:
    """Kernels called from this thread use it alone: for work that is spread over threads already; a decorator, too."""
    before, _here.alone = getattr(_here, "alone", False), True
    try:
        yield
    finally:
        _here.alone = before


def thread_count() -> int:
    """Number of threads that a kernel called here runs on."""
    return 1 if getattr(_here, "alone", False) else torch.get_num_threads()


def _run(calls: list[tuple]) -> None:
    """Run (function, arguments...) of every call at once: the first in this thread, and what no other has begun by then."""
    waiting = [(_pool(len(calls)).submit(*call), call) for call in calls[1:]]
    calls[0][0](*calls[0][1:])
    for future, (function, *arguments) in waiting:
        if future.cancel():
            function(*arguments)
        else:
            future.result()


def over_range(size: int, kernel: Callable, *arguments, least: int = 1) -> None:
    """kernel(start, stop, *arguments) over contiguous parts of range(size), as many as threads, none shorter than `least`."""
    parts = min(thread_count(), max(size // least, 1))
    _run([(kernel, size * t // parts, size * (t + 1) // parts, *arguments) for t in range(parts)])


def over_batch(size: int, kernel: Callable[[int, int], None], device: torch.device) -> None:
    """kernel(start, stop) over a batch of small matrices that torch decomposes: on the CPU it has one thread for a batch.

    LAPACK rounds a matrix as its address in the batch is aligned, so every part begins where the alignment does: with any
    number of threads a matrix is as far behind a boundary as it is in the whole batch.
    """
    if device.type != "cpu":
        kernel(0, size)
        return

    def part(start: int, stop: int) -> None:
        kernel(start * ALIGNED, min(stop * ALIGNED, size))

    over_range(-(-size // ALIGNED), part)


def over_tiles(kernel: Callable, *arguments) -> None:
    """kernel(counter, *arguments) on every thread: each takes the next tile from the counter until none is left."""
    counter = np.zeros(1, np.int64)
    _run([(kernel, counter, *arguments)] * thread_count())
