"""Power iteration and its shifted form, by which StableGS computes both ends of the spectrum (the ratio of Eq. (3)).

    v <- (H - shift) v / |(H - shift) v|

converges to an eigenvector of the eigenvalue farthest from the shift.  Each step reduces every other component by the ratio of
the two distances to the shift.  This is a baseline: `landscape.eigen.eigen` needs far fewer products.

**Without products.**  A Lanczos run H Q = Q T + r e_m^T from v holds m iterates (H - shift)^j v, j < m, and what H makes of
them: they are Q (T - shift)^j e_1, so that Rayleigh quotients and residuals are those of T with |r| in one row more.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, nan

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.eigen.lanczos import LanczosFactorization
from landscape.eigen.pairs import EigenEnds, Eigenpairs
from landscape.errors import InputError
from landscape.linalg import norm
from landscape.operators.operator import DenseOperator, SymmetricOperator, product
from landscape.probes import draw_probes
from landscape.results import Progress, StopReason


@dataclass(frozen=True)
class PowerSettings:
    """Power iteration stops at a residual |H v - lambda v| of max(rtol |lambda|, atol), or when its budget is spent.

    max_matvecs: for one end; `power_ends` can spend it twice.
    """

    rtol: float = 1e-3
    atol: float = 0.0
    max_matvecs: int = 100

    def __post_init__(self) -> None:
        if not (self.rtol >= 0 and self.atol >= 0 and self.max_matvecs >= 1):
            raise InputError(
                f"expected rtol, atol >= 0 and max_matvecs >= 1, got {self.rtol}, {self.atol} and {self.max_matvecs}"
            )


def power_iteration(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: PowerSettings = PowerSettings(),
    shift: float = 0.0,
    progress: Progress | None = None,
    start: Float[Tensor, " n"] | None = None,
) -> tuple[Eigenpairs, int]:
    """The eigenpair of H whose eigenvalue is farthest from shift, and the matvecs used, from a Gaussian start or this one.

    With shift = 0 it is the eigenvalue of largest magnitude, of either sign; with that eigenvalue as shift it is the other end
    of the spectrum.  rtol is relative to the eigenvalue of H, not of H - shift.
    """
    v = draw_probes(operator.dim, 1, generator, operator.dtype)[:, 0] if start is None else start
    epsilon, step = torch.finfo(operator.dtype).eps, 0
    while True:
        v = v / norm(v)
        step += 1
        w = product(operator, v[:, None])[:, 0] - shift * v
        moved = float(torch.dot(v.double(), w.double()))
        value, residual = moved + shift, norm(w.double() - moved * v.double())
        if progress:
            progress(step, settings.max_matvecs, f"eigenvalue {value:.4g} +- {residual:.1e}")
        reason = _power_reason(settings, step, value, residual, epsilon * max(abs(moved), abs(shift)))
        if reason:
            vector_error = torch.tensor([inf], dtype=torch.float64)
            numbers = torch.tensor([[value], [residual]], dtype=torch.float64)
            return Eigenpairs(numbers[0], v[:, None], numbers[1], vector_error, reason), step
        v = w


def _power_reason(settings: PowerSettings, step: int, value: float, residual: float, floor: float) -> StopReason | None:
    if residual <= max(settings.rtol * abs(value), settings.atol):
        return "tolerance"
    if residual <= floor:
        return "noise floor"
    return "matvec budget" if step == settings.max_matvecs else None


def power_ends(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: PowerSettings = PowerSettings(),
    progress: Progress | None = None,
) -> EigenEnds:
    """Both ends of the spectrum as StableGS computes them: power iteration on H, then on H - lambda I.

    The first run finds the eigenvalue lambda of largest magnitude: lambda_max, or lambda_min if the negative end is longer.
    """
    first, steps = power_iteration(operator, generator, settings, progress=progress)
    other, more = power_iteration(operator, generator, settings, shift=float(first.values), progress=progress)
    return _in_order(first, other, steps + more)


def power_of_runs(runs: Sequence[LanczosFactorization], settings: PowerSettings = PowerSettings()) -> EigenEnds:
    """`power_ends` as it would go from the starts of Lanczos runs, of H's from the first's, of H - lambda I's from the last's.

    It makes no product, and so many steps as a run has at most; in exact arithmetic all numbers are the same.

    >>> from landscape.eigen.lanczos import lanczos
    >>> H = DenseOperator(torch.diag(torch.linspace(-1, 3, 50, dtype=torch.float64)))
    >>> ends = power_of_runs(lanczos(H, torch.ones(50, 1, dtype=torch.float64), steps=20))
    >>> print(f"{float(ends.largest.values):.2f} {ends.largest.reason}, {ends.matvecs} products")
    2.96 matvec budget, 0 products
    """
    first = _of_run(runs[0], 0.0, settings)
    return _in_order(first, _of_run(runs[-1], float(first.values), settings), 0)


def _of_run(run: LanczosFactorization, shift: float, settings: PowerSettings) -> Eigenpairs:
    length, steps = norm(run.r), len(run.T)
    T = torch.zeros(steps + 1, steps + 1, dtype=torch.float64)
    T[:steps, :steps] = run.T
    T[steps, steps - 1] = T[steps - 1, steps] = length
    most = min(steps, settings.max_matvecs) if length else settings.max_matvecs
    start = torch.eye(steps + 1, dtype=torch.float64)[0]
    pair, _ = power_iteration(
        DenseOperator(T), torch.Generator(), replace(settings, max_matvecs=most), shift, start=start
    )
    return replace(pair, vectors=run.Q @ pair.vectors[:steps].to(run.Q))


def _in_order(first: Eigenpairs, other: Eigenpairs, matvecs: int) -> EigenEnds:
    smallest, largest = sorted((first, other), key=lambda pair: float(pair.values))
    return EigenEnds(largest, smallest, "power iteration", matvecs, inf, nan)
