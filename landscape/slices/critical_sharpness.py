"""The factor of an update at which a loss is again what it was before it (arXiv 2601.16979)."""

from collections.abc import Callable
from math import nan

from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.results import Measured

CLOSE, MOST = 0.01, 40  # of the slope that may be left at eta, or of eta itself; losses


def critical_sharpness(
    loss: Callable[[Tensor], float], start: Float[Tensor, " p"], step: Float[Tensor, " p"], slope: float
) -> Measured:
    """2 / eta along an update, start - eta step; of a quadratic loss step^T H step / gradient . step.  slope: gradient . step.

    (loss - loss at the start) / eta is -slope at 0, and a straight line where the loss is quadratic: its zero is found by
    regula falsi with Illinois' halving, or the place where it jumps past 0.  It takes about six losses.  Both
    nan where the loss does not fall along the update.  InputError where it still falls after MOST.

    >>> import torch
    >>> found = critical_sharpness(lambda x: float(3 * x.square().sum()), torch.ones(2), torch.full((2,), 0.1), 1.2)
    >>> round(found.value, 3)  # 0.1^2 (6 + 6) / 1.2
    0.1
    """
    if slope <= 0:
        return Measured(nan, nan)
    base, near, far, eta, side = loss(start), (0.0, -slope), None, 1.0, 0
    for _ in range(MOST):
        rate = (loss(start - eta * step) - base) / eta
        if abs(rate) <= CLOSE * slope:
            return Measured(2 / eta, 2 / eta * abs(rate) / slope)
        if rate < 0:  # an end that stays twice counts half
            near, far = (eta, rate), far and (far[0], far[1] / 2 if side < 0 else far[1])
        else:
            near, far = (near[0], near[1] / 2 if side > 0 else near[1]), (eta, rate)
        side = 1 if rate > 0 else -1
        if far and far[0] - near[0] <= CLOSE * far[0]:  # the loss jumps here: Gaussians change places
            eta = (near[0] + far[0]) / 2
            return Measured(2 / eta, 2 / eta * (far[0] - near[0]) / (2 * near[0]))
        eta = 2 * eta if far is None else near[0] - near[1] * (far[0] - near[0]) / (far[1] - near[1])
    raise InputError(f"expected a loss that rises along the update, got one that falls at {eta:.3g} times it")
