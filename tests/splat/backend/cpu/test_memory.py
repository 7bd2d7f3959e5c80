import platform
import resource

import numpy as np
import pytest

from splat.backend.cpu.memory import aligned

PAGE, SIZE, ARRAYS, STEPS = resource.getpagesize(), 5_000_000, 8, 5


def use_and_free() -> None:
    arrays = [aligned((SIZE,), np.dtype(np.uint8)) for _ in range(ARRAYS)]
    for array in arrays:
        array[::PAGE] = 1


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other C libraries keep freed memory by rules of their own"
)
def test_what_a_step_frees_the_next_one_has_without_asking_for_pages():
    use_and_free()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(STEPS):
        use_and_free()
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    assert faults < 0.1 * STEPS * ARRAYS * SIZE / PAGE
