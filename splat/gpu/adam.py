"""One step of Adam on the GPU: `backend/cpu/adam.py` in one pass over the parameters."""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false
# (in a kernel names mean tensors)

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from splat.backend.cpu.adam import BETA1, BETA2, EPS, bias_corrections, grid_of
from splat.gpu.language.compile import launch, sized

BLOCK = 1024


@sized("n")
def _step(
    parameters, gradient, rates, first, second, numbers, n,
    BETA1: tl.constexpr, BETA2: tl.constexpr, EPS: tl.constexpr, GRID: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = at < n
    g, m, v = tl.load(gradient + at, here, other=0.0), tl.load(first + at, here), tl.load(second + at, here)
    m += (g - m) * (1 - BETA1)
    m = (m + GRID) - GRID
    v = v * BETA2 + g * g * (1 - BETA2)
    root, scale = tl.load(numbers).to(m.dtype), tl.load(numbers + 1).to(m.dtype)
    step = m / (tl.sqrt(v) / root + EPS) * tl.load(rates + at, here) * scale
    tl.store(parameters + at, tl.load(parameters + at, here) - step, here)
    tl.store(first + at, m, here)
    tl.store(second + at, v, here)


def adam_step(
    parameters: Float[Tensor, " p"],
    gradient: Float[Tensor, " p"],
    rates: Float[Tensor, " p"],
    first: Float[Tensor, " p"],
    second: Float[Tensor, " p"],
    updates: int,
) -> None:
    """Step number `updates`, in place."""
    numbers = torch.tensor(bias_corrections(updates), dtype=torch.float64).to(parameters.device, non_blocking=True)
    launch(
        _step, (triton.cdiv(len(parameters), BLOCK),),
        parameters, gradient.contiguous(), rates, first, second, numbers, len(parameters), BETA1, BETA2, EPS,
        grid_of(first.dtype), BLOCK,
    )  # fmt: skip
