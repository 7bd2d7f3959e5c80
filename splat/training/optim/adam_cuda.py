"""One step of Adam on the GPU: the update of `adam.py` in one pass over the parameters."""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false
# (in a kernel names mean tensors)

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from splat.backend.gpu.compile import launch, sized

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


def update(
    parameters: Float[Tensor, " p"],
    gradient: Float[Tensor, " p"],
    rates: Float[Tensor, " p"],
    first: Float[Tensor, " p"],
    second: Float[Tensor, " p"],
    root: float,
    scale: float,
    constants: tuple[float, float, float, float],
) -> None:
    """Update in place.  root: sqrt(1 - beta2^t); scale: 1 / (1 - beta1^t); constants: beta1, beta2, eps and the grid of m."""
    numbers = torch.tensor([root, scale], dtype=torch.float64).to(parameters.device, non_blocking=True)
    launch(
        _step, (triton.cdiv(len(parameters), BLOCK),),
        parameters, gradient.contiguous(), rates, first, second, numbers, len(parameters), *constants, BLOCK,
    )  # fmt: skip
