"""The check that products H v are derivatives of a gradient g, made once, before anything is measured.

A backward pass that torch cannot differentiate leaves a part of H out, or all of it, without a word.  With vectors u, v of
independent normal entries, d(h) = (g(center + h v) - g(center - h v)) / 2h and the dtype's round-off eps:

one gradient    g(center) is the same twice; else the loss draws random numbers, or changes what it depends on
symmetry        u . H v and v . H u differ by less than eps^(1/3) of their size
derivative      |d(h) - H v| <= eps^(1/3) |H v| + 10 eps |g| / h at h = eps^(1/3) rms(center).  The errors of d(h), of the
                orders h^2 and eps / h, are smaller than that by eps^(1/3)

Where d(h) disagrees, H may still be right: a step across n kinks, as relu and an l1 norm have, adds their jumps over 2h.  By
chance these leave d(h) and d(2h) apart by 1 / sqrt(n) of the disagreement; a second derivative that is missing leaves them
the same.  They are compared at a step so small that round-off just allows it, where n is smallest.  Measured by changing each
number by 2 eps, round-off is there a tenth of SETTLED of the disagreement.
"""

from collections.abc import Callable
from math import isfinite

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator
from landscape.probes import draw_probes

SETTLED = 0.03  # share of a disagreement by which d(h) and d(2h) may differ: that of 1,100 kinks
ROUNDS = 3  # of looking for the smallest step that round-off allows
Gradient = Callable[[Tensor], Tensor]
REMEDY = (
    "take .detach(), torch.no_grad(), numpy, @once_differentiable, reentrant checkpoints and weight_norm out of the loss, or "
    "write them with torch operations that have a second derivative"
)


def require_hessian(
    operator: SymmetricOperator, gradient: Gradient, center: Float[Tensor, " n"], here: Float[Tensor, " n"]
) -> bool:
    """Whether differences of the gradient confirm H; False where kinks hide it.  Raises InputError where they refute it.

    gradient(theta) -> (n,): at any theta, without a change of state.  center: the point of H.  here: the gradient there, as the
    operator has it.  Takes 2 products, and 3 gradients where the objective is smooth; elsewhere 16 at most.

    >>> from landscape.operators.operator import DenseOperator
    >>> theta = torch.tensor([1.0, 2.0]).double()
    >>> H = DenseOperator(torch.diag(12 * theta**2))  # of L = sum theta^4, whose gradient is 4 theta^3
    >>> require_hessian(H, lambda x: 4 * x**3, theta, 4 * theta**3)
    True
    """
    if not operator.dim:
        return True
    share = torch.finfo(operator.dtype).eps ** (1 / 3)
    scale = float(center.double().square().mean()) ** 0.5 or 1.0
    draws = draw_probes(operator.dim, 2, torch.Generator().manual_seed(0), operator.dtype).to(center.device)
    u, v = draws.double().T
    Hu, Hv = operator.apply(draws).double().T.clone()
    length, slope = float(Hv.norm()), float(here.double().norm())

    again = float((gradient(center).double() - here.double()).norm())
    if again > share**1.5 * max(slope, scale * length):
        raise InputError(
            f"expected one gradient at one point, got two that differ by {again / max(slope, again):.1%}; take random numbers "
            "and what the loss itself changes out of it (a network: module.eval()), or set the seed in it"
        )
    asymmetry, size = abs(float(u @ Hv - v @ Hu)), length + float(Hu.norm())
    if asymmetry > share * size:
        raise InputError(
            f"expected products H v of a symmetric H, got v . H u and u . H v {2 * asymmetry / size:.1%} of |H v| "
            f"apart; {REMEDY}"
        )
    if (off := _off(gradient, center, here, Hv, v, share, scale)) > 0:
        raise InputError(
            f"expected products H v that are derivatives of the gradient, got ones {off:.1%} off its differences; {REMEDY}"
        )
    return off == 0


def _off(
    gradient: Gradient, center: Tensor, here: Tensor, product: Tensor, v: Tensor, share: float, scale: float
) -> float:
    """0 where H v agrees with differences of the gradient, -1 where kinks hide it, else the relative distance between both.

    All in double precision, of gradients in the center's.
    """
    theta = center.double()

    def at(point: Tensor) -> Tensor:
        return gradient(point.to(center.dtype)).double()

    def over(step: float) -> Tensor:
        """d(step)."""
        return (at(theta + step * v) - at(theta - step * v)) / (2 * step)

    eps, step, rounding, slope = share**3, share * scale, None, float(here.double().norm())
    for _ in range(1 + ROUNDS):
        found = over(step)
        apart, size = float((found - product).norm()), max(float(found.norm()), float(product.norm()))
        if apart <= share * size + 10 * eps * slope / step:
            return 0.0
        if rounding is None:  # the gradient's change when each number of the center is changed by 2 eps of itself
            signs = torch.where(v > 0, 1.0, -1.0).double()
            rounding = float((at(theta * (1 + 2 * eps * signs)) - here).norm())
        elif float((found - over(2 * step)).norm()) <= SETTLED * apart and rounding / step <= SETTLED * apart:
            return apart / size
        # the step at which round-off is a tenth of the change to be resolved; nearer where the gradient is not finite
        step = max(10 * rounding / (SETTLED * apart), eps * scale / SETTLED) if isfinite(apart) else share * step
    return -1.0
