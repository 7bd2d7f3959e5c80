"""Preconditioned conjugate gradients for A x = b, A = H + damping, that notice negative curvature (Steihaug 1983).

    r = b - A x,  z = M r,  d <- z + beta d,  x <- x + (r.z / d.Ad) d,    beta = new r.z / old r.z

x is 0 at first.  The model x.Ax / 2 - b.x falls at every step.  Where d.Ad <= 0 it has no minimum along d: the search ends with
the x reached so far, with M b where that is 0.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from landscape.linalg import column_dots
from landscape.operators.operator import SymmetricOperator, product

Reason = Literal["tolerance", "budget", "negative curvature"]


@dataclass(frozen=True, eq=False)
class Solution:
    """x, and A x; residual: sqrt(r.Mr / b.Mb); products: with H.  reason: why the search ended."""

    x: Float[Tensor, " n"]
    Ax: Float[Tensor, " n"]
    residual: float
    products: int
    reason: Reason


def conjugate_gradients(
    H: SymmetricOperator,
    b: Float[Tensor, " n"],
    precondition: Callable[[Tensor], Tensor],
    damping: float = 0.0,
    rtol: float = 0.1,
    most: int = 20,
) -> Solution:
    """(H + damping) x = b to a residual of rtol, with at most so many products, at least one.

    precondition: r -> M r, M symmetric and positive definite.  b must not be 0.

    >>> import torch
    >>> from landscape import DenseOperator
    >>> A = DenseOperator(torch.tensor([[2.0, 1.0], [1.0, 3.0]], dtype=torch.float64))
    >>> found = conjugate_gradients(A, torch.tensor([3.0, 4.0], dtype=torch.float64), lambda r: r, rtol=1e-12)
    >>> found.x.round(decimals=12).tolist(), found.products
    ([1.0, 1.0], 2)
    """
    x, Ax, r = b.new_zeros(b.shape), b.new_zeros(b.shape), b.clone()
    z = precondition(r)
    d, rho = z, _dot(r, z)
    begun, reason, products = rho, "budget", 0
    while products < most:
        Ad = product(H, d[:, None])[:, 0] + damping * d
        products += 1
        curvature = _dot(d, Ad)
        if curvature <= 0:
            reason = "negative curvature"
            if products == 1:
                x, Ax, r = d, Ad, r - Ad
            break
        step = rho / curvature
        x, Ax, r = x + step * d, Ax + step * Ad, r - step * Ad
        z = precondition(r)
        rho, last = _dot(r, z), rho
        if rho <= rtol * rtol * begun:
            reason = "tolerance"
            break
        d = z + rho / last * d
    return Solution(x, Ax, (max(rho, 0.0) / begun) ** 0.5, products, reason)


def _dot(a: Tensor, b: Tensor) -> float:
    return float(column_dots(a[:, None], b[:, None]))
