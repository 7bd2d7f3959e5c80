"""Checks that an operator is the Hessian of an objective, for a few products and evaluations.

symmetry    rms |G - G^T| off the diagonal over rms |H z|, with G = Z^T H Z for Gaussian Z (n, m).  Its expectation is
            |H - H^T|_F / |H|_F, because E (u . A v)^2 = |A|_F^2 and E |H z|^2 = |H|_F^2
noise       |H (a z) / a - H z| / |H z| with a = 1/3: the change of a product when its input is rounded differently
gradient    |H v - (g(theta + h v) - g(theta - h v)) / (2 h)| / |H v| with the gradient g, at the best of several steps h
objective   |v.H v - (L(theta + h v) - 2 L(theta) + L(theta - h v)) / h^2| / |v.H v| with the loss L, likewise

A step h is useful only where the objective is smooth from theta - h v to theta + h v.  `smooth_piece(theta)`, if given, returns
a label of the smooth piece that contains theta (for a scene: the order of the splats and the set of visible ones); steps whose
ends have another label than theta are skipped.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan, nan
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator
from landscape.probes import draw_probes
from landscape.results import plain

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

    def record(self) -> dict[str, Any]:
        return plain(self, "symmetry noise finite tolerance passed matvecs")


@dataclass(frozen=True)
class DerivativeCheck:
    """Relative error of an operator against finite differences.

    steps, errors: the steps that were tried, with their relative errors.  error, step: the smallest of these errors and its
    step; both nan where no step was tried.  skipped: number of steps that end on another smooth piece, and so say nothing.
    """

    error: float
    step: float
    steps: tuple[float, ...]
    errors: tuple[float, ...]
    skipped: int

    def record(self) -> dict[str, Any]:
        return plain(self, "error step steps errors skipped")


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


def check_gradient(
    operator: SymmetricOperator,
    gradient: Callable[[Tensor], Tensor],
    center: Float[Tensor, " n"],
    direction: Float[Tensor, " n"],
    steps: Sequence[float] = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
    smooth_piece: Callable[[Tensor], Hashable] | None = None,
    enough: float = 0.0,
) -> DerivativeCheck:
    """H v against the central difference of the gradient along v = direction.

    gradient(theta) -> (n,): the objective's gradient at any theta.  center: the point of H.  steps: multiples of direction,
    positive.  smooth_piece: see the top of this module.  enough: once a relative error is this small, no further step is
    tried; with 0 all steps are tried, unless one is exact.

    >>> from landscape.operators.operator import DenseOperator
    >>> theta, v = torch.tensor([1.0, 2.0]).double(), torch.tensor([0.6, 0.8]).double()
    >>> H = DenseOperator(torch.diag(12 * theta**2))  # of L = sum theta^4, whose gradient is 4 theta^3
    >>> check_gradient(H, lambda x: 4 * x**3, theta, v).error < 1e-9
    True
    """
    product = operator.apply(direction.to(operator.dtype)[:, None])[:, 0].double()

    def discrepancy(step: float) -> float:
        ahead, behind = (gradient(_moved(center, direction, sign * step)).double() for sign in (1, -1))
        return float(((ahead - behind) / (2 * step) - product).norm())

    return _best_step(discrepancy, float(product.norm()), center, direction, steps, smooth_piece, enough)


def check_objective(
    operator: SymmetricOperator,
    loss: Callable[[Tensor], Tensor | float],
    center: Float[Tensor, " n"],
    direction: Float[Tensor, " n"],
    steps: Sequence[float] = (1e-1, 1e-2, 1e-3, 1e-4),
    smooth_piece: Callable[[Tensor], Hashable] | None = None,
) -> DerivativeCheck:
    """v . H v against the second difference of loss(theta) along v = direction.  Other arguments: see `check_gradient`.

    >>> from landscape.operators.operator import DenseOperator
    >>> theta, v = torch.tensor([1.0, 2.0]).double(), torch.tensor([0.6, 0.8]).double()
    >>> H, twice = (DenseOperator(factor * torch.diag(12 * theta**2)) for factor in (1, 2))  # of L = sum theta^4, and of 2 L
    >>> check_objective(H, lambda x: (x**4).sum(), theta, v).error < 1e-6
    True
    >>> round(check_objective(twice, lambda x: (x**4).sum(), theta, v).error, 3)
    0.5
    """
    v = direction.to(operator.dtype)
    curvature = float(torch.dot(v.double(), operator.apply(v[:, None])[:, 0].double()))
    middle = float(loss(center))

    def discrepancy(step: float) -> float:
        ahead, behind = (float(loss(_moved(center, direction, sign * step))) for sign in (1, -1))
        return abs((ahead - 2 * middle + behind) / step**2 - curvature)

    return _best_step(discrepancy, abs(curvature), center, direction, steps, smooth_piece)


def _moved(center: Tensor, direction: Tensor, step: float) -> Tensor:
    return (center.double() + step * direction.double()).to(center.dtype)


def _best_step(
    discrepancy: Callable[[float], float],
    size: float,
    center: Tensor,
    direction: Tensor,
    steps: Sequence[float],
    smooth_piece: Callable[[Tensor], Hashable] | None,
    enough: float = 0.0,
) -> DerivativeCheck:
    """The step with the smallest relative discrepancy.  Truncation spoils large steps, round-off small ones."""
    if not steps or min(steps) <= 0:
        raise InputError(f"expected positive steps, got {tuple(steps)}")
    here = smooth_piece(center) if smooth_piece else None
    kept, errors, skipped = [], [], 0
    for step in steps:
        if errors and min(errors) <= enough:
            break
        if smooth_piece and any(smooth_piece(_moved(center, direction, sign * step)) != here for sign in (1, -1)):
            skipped += 1
            continue
        difference = discrepancy(step)
        kept.append(step)
        error = difference / size if size else (inf if difference else 0.0)
        errors.append(inf if isnan(error) else error)  # the objective is not finite there
    best = min(range(len(kept)), key=errors.__getitem__, default=None)
    error, step = (nan, nan) if best is None else (errors[best], kept[best])
    return DerivativeCheck(error, step, tuple(kept), tuple(errors), skipped)
