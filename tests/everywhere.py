"""The tests as other processors run them: `make test-everywhere`, hours on two cores; a line for each configuration.

From the default one thing at a time is changed, on the tests that execute kernels; then all tests in the two corners that
differ most.  A width that the processor has not is made of narrower registers.  A plain processor has SSE2 alone, without a
fused multiply-add, in the kernels; in the libraries as little as each can be asked for.  Numba keeps kernels by the processor's
name and features, `splat` by width, so that none is shared.

    python -m tests.everywhere [PATH ...]       these tests in every configuration
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from llvmlite.binding import get_host_cpu_features

ROOT = Path(__file__).resolve().parents[1]
KERNELS = [
    "tests/splat",
    "tests/analysis",
    "tests/notebooks",
    "tests/test_notebooks.py",
    "splat",
    "analysis",
    "notebooks",
]
NEWEST = "x86-64-v4" if get_host_cpu_features().get("avx512f") else "x86-64-v3"
LIBRARIES = {  # of torch, its MKL, and NumPy with its OpenBLAS
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3",
    "OPENBLAS_CORETYPE": "Nehalem",
}
ONE = [
    *({"LANDSCAPE_VECTOR_BITS": bits} for bits in ("128", "256", "512")),
    *({"NUMBA_CPU_NAME": name} for name in ("generic", NEWEST)),
    *({f"{library}_NUM_THREADS": count} for library in ("NUMBA", "OMP") for count in "12"),
    LIBRARIES,
]
LEAST = LIBRARIES | {
    "LANDSCAPE_VECTOR_BITS": "128",
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}
MOST = {"LANDSCAPE_VECTOR_BITS": "512", "NUMBA_CPU_NAME": NEWEST, "NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}


@contextmanager
def busy(loops: int) -> Iterator[None]:
    """Other programs at work."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for other in others:
            other.kill()


def passes(changed: dict[str, str], loaded: bool, paths: list[str]) -> bool:
    """Run the tests in one configuration, and say how it ended."""
    default = {name: value for name, value in os.environ.items() if name not in LEAST}
    start = time.monotonic()
    with busy(4) if loaded else nullcontext():
        command = [sys.executable, "-m", "pytest", *paths]  # in one process: several would share out the threads
        done = subprocess.run(command, cwd=ROOT, env=default | changed, capture_output=True, text=True)
    name = " ".join([*(f"{key}={value}" for key, value in changed.items()), *["loaded"] * loaded])
    said = done.stdout if done.returncode else done.stdout.splitlines()[-1]
    print(f"{name}: exit code {done.returncode} after {time.monotonic() - start:.0f} s: {said}", flush=True)
    return not done.returncode


def main(paths: list[str]) -> int:
    ended = [passes(changed, False, paths or KERNELS) for changed in ONE]
    ended += [passes({}, True, paths or KERNELS), passes(LEAST, True, paths), passes(MOST, False, paths)]
    print(f"{sum(ended)} of {len(ended)} configurations passed")
    return 0 if all(ended) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
