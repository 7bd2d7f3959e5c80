"""The tests as other processors run them: `make test-everywhere`, hours on two cores; a line for each configuration.

From the default one thing at a time is changed, on the tests that execute kernels; then all tests in the two corners that
differ most.  A width that the processor has not is made of narrower registers.  A plain processor has SSE2 alone, without a
fused multiply-add.  Numba keeps kernels by the processor's name and features, `splat` by width, so that none is shared.

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
KERNELS = ["tests/splat", "tests/analysis", "tests/test_notebooks.py", "splat", "analysis"]  # other layers import none
PLAIN = "generic"
NEWEST = "x86-64-v4" if get_host_cpu_features().get("avx512f") else "x86-64-v3"
CHANGES = {
    "LANDSCAPE_VECTOR_BITS": ("128", "256", "512"),
    "NUMBA_CPU_NAME": (PLAIN, NEWEST),
    "NUMBA_NUM_THREADS": ("1", "2"),
    "OMP_NUM_THREADS": ("1", "2"),
}
LEAST: dict[str, str] = dict(zip(CHANGES, ("128", PLAIN, "1", "1")))
MOST: dict[str, str] = dict(zip(CHANGES, ("512", NEWEST, "2", "2")))


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
    default = {name: value for name, value in os.environ.items() if name not in CHANGES}
    start = time.monotonic()
    with busy(4) if loaded else nullcontext():
        command = [sys.executable, "-m", "pytest", *paths]  # in one process: several would share out the threads
        done = subprocess.run(command, cwd=ROOT, env=default | changed, capture_output=True, text=True)
    name = " ".join([*(f"{key}={value}" for key, value in changed.items()), *["loaded"] * loaded])
    said = done.stdout if done.returncode else done.stdout.splitlines()[-1]
    print(f"{name}: exit code {done.returncode} after {time.monotonic() - start:.0f} s: {said}", flush=True)
    return not done.returncode


def main(paths: list[str]) -> int:
    single = [({key: value}, False) for key, values in CHANGES.items() for value in values]
    ended = [passes(changed, loaded, paths or KERNELS) for changed, loaded in [*single, ({}, True)]]
    ended += [passes(LEAST, True, paths), passes(MOST, False, paths)]
    print(f"{sum(ended)} of {len(ended)} configurations passed")
    return 0 if all(ended) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
