"""Checks that an operator is a Hessian, for a few products.

symmetry    rms |G - G^T| off the diagonal over rms |H z|, with G = Z^T H Z for Gaussian Z (n, m).  Its expectation is
            |H - H^T|_F / |H|_F, because E (u . A v)^2 = |A|_F^2 and E |H z|^2 = |H|_F^2
noise       |H (a z) / a - H z| / |H z| with a = 1/3: the change of a product when its input is rounded differently
"""

from dataclasses import dataclass
from math import isfinite, nan

import torch

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator
from landscape.probes import draw_probes

SCALE = 1 / 3  # not a power of two, so that the scaled vector rounds differently
ROUND_OFFS = 4e3  # units of round-off in a sum of 1.6e7 rounded terms, whose errors add up like a random walk


@dataclass(frozen=True)
class OperatorCheck:
    """Asymmetry and round-off of an operator, relative to |H z| of a random vector z.

    symmetry, noise: see the top of this module; nan where a product was not finite.  tolerance: the largest value of either
    that passes.  matvecs: products used.
    """

    symmetry: float
    noise: float
    finite: bool
    tolerance: float
    matvecs: int

    @property
    def passed(self) -> bool:
        return self.finite and self.symmetry <= self.tolerance and self.noise <= self.tolerance


def check_operator(
    operator: SymmetricOperator, generator: torch.Generator, vectors: int = 4, tolerance: float | None = None
) -> OperatorCheck:
    """Symmetry, round-off and finiteness of products, from vectors + 1 matvecs.

    vectors: number of random vectors (2 or more), compared pair by pair.  tolerance: the largest asymmetry and round-off that
    pass, relative to |H z|; 4e3 eps of the operator's dtype where None.  A failed check raises nothing: see `passed`.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.eye(5, dtype=torch.float64))
    >>> check_operator(H, torch.Generator().manual_seed(0)).passed
    True
    """
    if vectors < 2:
        raise InputError(f"expected at least 2 vectors to compare, got {vectors}")
    tolerance = ROUND_OFFS * torch.finfo(operator.dtype).eps if tolerance is None else tolerance
    Z = draw_probes(operator.dim, vectors, generator, operator.dtype)
    products = operator.apply(torch.cat([Z, SCALE * Z[:, :1]], dim=1))
    HZ, first = products[:, :vectors], products[:, 0].double()
    length, noise = float(first.norm()), float((products[:, vectors].double() / SCALE - first).norm())
    if not torch.isfinite(HZ).all() or not isfinite(noise):
        return OperatorCheck(nan, nan, False, tolerance, vectors + 1)
    G = Z.double().T @ HZ.double()
    pairs = vectors * (vectors - 1)
    asymmetry = float((G - G.T).norm()) / pairs**0.5
    size = float(HZ.double().norm()) / vectors**0.5
    # H = 0 is symmetric, and its products are exact
    return OperatorCheck(
        asymmetry / size if size else 0.0, noise / length if length else 0.0, True, tolerance, vectors + 1
    )
