"""The arithmetic peak of the machine, measured: fused multiply-adds on registers, on every thread, and nothing else."""

import numpy as np

from analysis.console.timing import interleaved
from splat.backend.cpu.jit import kernel
from splat.backend.cpu.simd import fma, lanes, lanes_of, load, store
from splat.backend.cpu.threads import over_range, thread_count

CHAINS = 10  # independent: at least latency x units of every machine so far
STEPS = 200_000


@kernel
def multiply_add(start, stop, values):
    """STEPS fused multiply-adds on CHAINS vectors of each part of values."""
    L = lanes(values)
    for part in range(start, stop):
        v = part * CHAINS * L
        x0, x1, x2, x3, x4 = (
            load(values, v),
            load(values, v + L),
            load(values, v + 2 * L),
            load(values, v + 3 * L),
            load(values, v + 4 * L),
        )
        x5, x6, x7, x8, x9 = (
            load(values, v + 5 * L),
            load(values, v + 6 * L),
            load(values, v + 7 * L),
            load(values, v + 8 * L),
            load(values, v + 9 * L),
        )
        a, b = x0 * 0.0 + 0.5, x0 * 0.0 + 1.0
        for _ in range(STEPS):
            x0, x1, x2, x3, x4 = fma(x0, a, b), fma(x1, a, b), fma(x2, a, b), fma(x3, a, b), fma(x4, a, b)
            x5, x6, x7, x8, x9 = fma(x5, a, b), fma(x6, a, b), fma(x7, a, b), fma(x8, a, b), fma(x9, a, b)
        store(values, v, x0 + x1 + x2 + x3 + x4 + x5 + x6 + x7 + x8 + x9)


def fma_peak(repetitions: int = 7) -> float:
    """float32 fused multiply-adds (on single numbers) a second, on all threads together."""
    threads = thread_count()
    values = np.random.default_rng(0).random(threads * CHAINS * 64, np.float32)
    seconds = interleaved({"peak": lambda: over_range(threads, multiply_add, values)}, repetitions)["peak"].minimum
    return threads * CHAINS * STEPS * lanes_of(np.float32) / seconds
