"""One step of Adam (Kingma and Ba 2015, Algorithm 1) over one flat vector, with a learning rate per parameter.

m <- beta1 m + (1 - beta1) g          first moment
v <- beta2 v + (1 - beta2) g^2        second moment
x <- x - rate m_hat / (sqrt(v_hat) + eps),   m_hat = m / (1 - beta1^t),   v_hat = v / (1 - beta2^t)
"""

from math import sqrt

import torch
from jaxtyping import Float
from torch import Tensor

BETA1, BETA2 = 0.9, 0.999
EPS = 1e-15  # 3DGS: far below the moments of a loss that is a mean over 10^5 pixels


def bias_corrections(updates: int) -> tuple[float, float]:
    """sqrt(1 - beta2^t) and 1 / (1 - beta1^t) of step t."""
    return sqrt(1 - BETA2**updates), 1 / (1 - BETA1**updates)


def grid_of(dtype: torch.dtype) -> float:
    """A number whose addition and subtraction leaves no subnormal m, to which unseen Gaussians' would decay: 20x slower."""
    return 1024 * torch.finfo(dtype).tiny / torch.finfo(dtype).eps


def adam_step(
    parameters: Float[Tensor, " p"],
    gradient: Float[Tensor, " p"],
    rates: Float[Tensor, " p"],
    m: Float[Tensor, " p"],
    v: Float[Tensor, " p"],
    updates: int,
) -> None:
    """Step number `updates`, in place."""
    (root, scale), grid = bias_corrections(updates), grid_of(m.dtype)
    m.lerp_(gradient, 1 - BETA1)
    m.add_(grid).sub_(grid)
    v.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
    denominator = v.sqrt().div_(root).add_(EPS)
    step = torch.div(m, denominator, out=denominator).mul_(rates)
    parameters.sub_(step, alpha=scale)
