"""Is it the Hessian?  Cheap measurements on an operator before anything is concluded from it.

symmetry    of G = Z^T H Z for Gaussian Z (n, m): rms |G - G^T| off the diagonal over rms |H z|.  In expectation
            |H - H^T|_F / |H|_F, because E (u . A v)^2 = |A|_F^2 and E |H z|^2 = |H|_F^2
noise       |H (a z) / a - H z| / |H z| with a = 1/3: what rounding differently does to one matvec
gradient    |H v - (g(theta + h v) - g(theta - h v)) / (2 h)| / |H v|, at the best of several steps h
objective   |v.H v - (L(theta + h v) - 2 L(theta) + L(theta - h v)) / h^2| / |v.H v|, likewise
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan, nan

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator
from landscape.probes import draw_probes
from landscape.results import Number, finite_or_none

SCALE = 1 / 3  # not a power of two, so that the scaled vector rounds differently
ROUND_OFFS = 1e4  # of a sum of up to 1e8 rounded terms, whose errors add up as a random walk


@dataclass(frozen=True)
class OperatorCheck:
    """Measured asymmetry and round-off of an operator, relative to |H z| of a random vector z.

    symmetry, noise: see the top of this module; nan where a product was not finite.  tolerance: what either may be.
    matvecs: products it took.
    """

    symmetry: float
    noise: float
    finite: bool
    tolerance: float
    matvecs: int

    @property
    def passed(self) -> bool:
        return self.finite and self.symmetry <= self.tolerance and self.noise <= self.tolerance

    def record(self) -> dict[str, Number | bool | int]:
        return {
            "symmetry": finite_or_none(self.symmetry),
            "noise": finite_or_none(self.noise),
            "finite": self.finite,
            "tolerance": self.tolerance,
            "passed": self.passed,
            "matvecs": self.matvecs,
        }


@dataclass(frozen=True)
class DerivativeCheck:
    """Relative error of the operator against finite differences.

    steps, errors: those that were tried, and their relative errors; error, step: the least of these errors and its step, both
    nan where no step was tried.  skipped: how many steps were left out because the signature changed along them (a sort or a
    threshold was crossed), so that they prove nothing.
    """

    error: float
    step: float
    steps: tuple[float, ...]
    errors: tuple[float, ...]
    skipped: int

    def record(self) -> dict[str, Number | int | list[Number]]:
        return {
            "error": finite_or_none(self.error),
            "step": finite_or_none(self.step),
            "steps": [finite_or_none(step) for step in self.steps],
            "errors": [finite_or_none(error) for error in self.errors],
            "skipped": self.skipped,
        }


def check_operator(
    operator: SymmetricOperator, generator: torch.Generator, vectors: int = 4, tolerance: float | None = None
) -> OperatorCheck:
    """Symmetry, round-off and finiteness of products, from vectors + 1 matvecs.

    vectors: random ones that are compared pair by pair, at least 2.  tolerance: of asymmetry and round-off, relative to |H z|;
    1e4 units of round-off (eps) of the operator's dtype where None.  A check that fails raises nothing: see `passed`.

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
    signature: Callable[[Tensor], Hashable] | None = None,
    enough: float = 0.0,
) -> DerivativeCheck:
    """H v against the central difference of the gradient along v = direction.

    gradient(theta) -> (n,), of the objective at any theta; center: where H is taken.  steps: multiples of direction, all above
    0.  signature(theta): which smooth piece of the objective theta lies in; steps that leave the centre's are skipped.
    enough: no further step is tried once a relative error is this small; 0 tries all, unless one is exact.
    """
    product = operator.apply(direction.to(operator.dtype)[:, None])[:, 0].double()

    def discrepancy(step: float) -> float:
        ahead, behind = (gradient(_moved(center, direction, sign * step)).double() for sign in (1, -1))
        return float(((ahead - behind) / (2 * step) - product).norm())

    return _best_step(discrepancy, float(product.norm()), center, direction, steps, signature, enough)


def check_objective(
    operator: SymmetricOperator,
    loss: Callable[[Tensor], Tensor | float],
    center: Float[Tensor, " n"],
    direction: Float[Tensor, " n"],
    steps: Sequence[float] = (1e-1, 1e-2, 1e-3, 1e-4),
    signature: Callable[[Tensor], Hashable] | None = None,
) -> DerivativeCheck:
    """v . H v against the second difference of loss(theta) along v = direction; the rest as for `check_gradient`."""
    v = direction.to(operator.dtype)
    curvature = float(torch.dot(v.double(), operator.apply(v[:, None])[:, 0].double()))
    middle = float(loss(center))

    def discrepancy(step: float) -> float:
        ahead, behind = (float(loss(_moved(center, direction, sign * step))) for sign in (1, -1))
        return abs((ahead - 2 * middle + behind) / step**2 - curvature)

    return _best_step(discrepancy, abs(curvature), center, direction, steps, signature)


def _moved(center: Tensor, direction: Tensor, step: float) -> Tensor:
    return (center.double() + step * direction.double()).to(center.dtype)


def _best_step(
    discrepancy: Callable[[float], float],
    size: float,
    center: Tensor,
    direction: Tensor,
    steps: Sequence[float],
    signature: Callable[[Tensor], Hashable] | None,
    enough: float = 0.0,
) -> DerivativeCheck:
    """The smallest relative discrepancy: large steps see the next derivative, small ones round-off."""
    if not steps or min(steps) <= 0:
        raise InputError(f"expected positive steps, got {tuple(steps)}")
    here = signature(center) if signature else None
    kept, errors, skipped = [], [], 0
    for step in steps:
        if errors and min(errors) <= enough:
            break
        if signature and any(signature(_moved(center, direction, sign * step)) != here for sign in (1, -1)):
            skipped += 1
            continue
        difference = discrepancy(step)
        kept.append(step)
        error = difference / size if size else (inf if difference else 0.0)
        errors.append(inf if isnan(error) else error)  # beyond where the objective is finite
    best = min(range(len(kept)), key=errors.__getitem__, default=None)
    error, step = (nan, nan) if best is None else (errors[best], kept[best])
    return DerivativeCheck(error, step, tuple(kept), tuple(errors), skipped)
