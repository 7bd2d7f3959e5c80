"""One step of Adam (Kingma and Ba 2015, Algorithm 1) over one flat vector, with a learning rate per parameter.

m <- beta1 m + (1 - beta1) g          first moment
v <- beta2 v + (1 - beta2) g^2        second moment
x <- x - rate m_hat / (sqrt(v_hat) + eps),   m_hat = m / (1 - beta1^t),   v_hat = v / (1 - beta2^t)
"""

from math import sqrt

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.cpu.jit import kernel
from splat.backend.cpu.simd import lanes, lanes_of, load, store
from splat.backend.cpu.simd import sqrt as root_of
from splat.backend.cpu.threads import over_range

BETA1, BETA2 = 0.9, 0.999
EPS = 1e-15  # 3DGS: far below the moments of a loss that is a mean over 10^5 pixels


def bias_corrections(updates: int) -> tuple[float, float]:
    """sqrt(1 - beta2^t) and 1 / (1 - beta1^t) of step t."""
    return sqrt(1 - BETA2**updates), 1 / (1 - BETA1**updates)


def grid_of(dtype: torch.dtype) -> float:
    """A number whose addition and subtraction leaves no subnormal m, to which unseen Gaussians' would decay: 20x slower."""
    return 1024 * torch.finfo(dtype).tiny / torch.finfo(dtype).eps


@kernel
def update(start, stop, parameters, gradient, rates, first, second, numbers):
    """The step of the vectors start..stop.  numbers: 1 - beta1, grid, beta2, 1 - beta2, `bias_corrections`, EPS."""
    slow, grid, kept, new, root, scale, eps = numbers
    for i in range(start * lanes(first), stop * lanes(first), lanes(first)):
        g, m, v = load(gradient, i), load(first, i), load(second, i)
        m = m + slow * (g - m)
        m = (m + grid) - grid
        v = kept * v + new * g * g
        step = m / (root_of(v) / root + eps) * (load(rates, i) * scale)
        store(parameters, i, load(parameters, i) - step)
        store(first, i, m)
        store(second, i, v)


def adam_step(
    parameters: Float[Tensor, " p"],
    gradient: Float[Tensor, " p"],
    rates: Float[Tensor, " p"],
    first: Float[Tensor, " p"],
    second: Float[Tensor, " p"],
    updates: int,
) -> None:
    """Step number `updates`, in place."""
    arrays = [each.detach().numpy() for each in (parameters, gradient.contiguous(), rates.contiguous(), first, second)]
    numbers = (1 - BETA1, grid_of(first.dtype), BETA2, 1 - BETA2, *bias_corrections(updates), EPS)
    size, L = len(first), lanes_of(arrays[0].dtype)
    over_range(size // L, update, *arrays, numbers)
    if rest := size % L:  # the last numbers, in vectors of their own
        ends = np.zeros((len(arrays), L), arrays[0].dtype)
        ends[:, :rest] = [array[-rest:] for array in arrays]
        over_range(1, update, *ends, numbers)
        for array, end in zip(arrays, ends, strict=True):
            array[-rest:] = end[:rest]
