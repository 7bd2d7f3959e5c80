"""The arithmetic peak of a GPU: `peak.py` in Triton.  A thread has eight chains of fused multiply-adds, in registers."""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (in a kernel names mean tensors)

from collections.abc import Callable

import torch
import triton.language as tl

from splat.backend.gpu.compile import jit, launch

BLOCK, WARPS = 1024, 4  # numbers a program: eight a thread
UNROLLED = 32  # steps between two looks at the loop's counter
PROGRAMS = 64  # for each multiprocessor: four times what it has room for at a time
STEPS = 1 << 14


@jit
def multiply_add(values, a, b, steps, BLOCK: tl.constexpr, UNROLLED: tl.constexpr):
    """x <- a x + b, `steps` times."""
    at = values + tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x = tl.load(at)
    for _turn in range(0, steps // UNROLLED):
        for _step in tl.static_range(UNROLLED):  # a name of its own: older versions of Triton take it for the outer one
            x = tl.fma(x, a, b)
    tl.store(at, x)


def multiply_adds(device: torch.device, programs: int, steps: int) -> tuple[Callable[[], object], int]:
    """A call, and how many float32 fused multiply-adds it makes."""
    values = torch.rand(programs * BLOCK, device=device)

    def call() -> None:
        launch(multiply_add, (programs,), values, 0.5, 1.0, steps, BLOCK=BLOCK, UNROLLED=UNROLLED, num_warps=WARPS)

    return call, programs * BLOCK * (steps // UNROLLED) * UNROLLED
