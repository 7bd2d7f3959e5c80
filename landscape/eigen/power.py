"""Power iteration and its shifted form: how StableGS takes both ends of the spectrum (the ratio of Eq. (3)).

    v <- (H - shift) v / |(H - shift) v|

converges to the eigenvalue farthest from the shift, each step reducing the other components by the ratio of their
distances to it.  `landscape.eigen.eigen` needs far fewer products; this is the baseline, with residuals beside it.
"""

from dataclasses import dataclass
from math import inf, nan
from time import monotonic

import torch

from landscape.eigen.pairs import EigenEnds, Eigenpairs
from landscape.errors import InputError
from landscape.linalg import norm
from landscape.operators.operator import SymmetricOperator, product
from landscape.probes import draw_probes
from landscape.results import Progress, StopReason


@dataclass(frozen=True)
class PowerSettings:
    """Power iteration stops at a residual |H v - lambda v| of max(rtol |lambda|, atol), or when its budget is spent.

    max_matvecs, max_seconds: for one end; `power_ends` may spend them twice.
    """

    rtol: float = 1e-3
    atol: float = 0.0
    max_matvecs: int = 100
    max_seconds: float = inf

    def __post_init__(self) -> None:
        if not (self.rtol >= 0 and self.atol >= 0 and self.max_seconds >= 0 and self.max_matvecs >= 1):
            raise InputError(
                f"expected rtol, atol, max_seconds >= 0 and max_matvecs >= 1, got {self.rtol}, {self.atol}, "
                f"{self.max_seconds} and {self.max_matvecs}"
            )


def power_iteration(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: PowerSettings = PowerSettings(),
    shift: float = 0.0,
    progress: Progress | None = None,
) -> tuple[Eigenpairs, int]:
    """The eigenpair of H whose eigenvalue is farthest from shift, and the matvecs it took.

    v <- (H - shift) v / |(H - shift) v|, from a Gaussian start.  With shift = 0 this is the eigenvalue of largest
    magnitude, of either sign; with that eigenvalue as the shift it is the other end of the spectrum.  rtol is relative to the
    eigenvalue of H, not of H - shift.
    """
    v = draw_probes(operator.dim, 1, generator, operator.dtype)[:, 0]
    deadline, epsilon = monotonic() + settings.max_seconds, torch.finfo(operator.dtype).eps
    step = 0
    while True:
        v /= norm(v)
        step += 1
        w = product(operator, v[:, None])[:, 0] - shift * v
        moved = float(torch.dot(v.double(), w.double()))
        value, residual = moved + shift, norm(w.double() - moved * v.double())
        if progress:
            progress(step, settings.max_matvecs, f"eigenvalue {value:.4g} +- {residual:.1e}")
        reason = _power_reason(settings, step, value, residual, epsilon * max(abs(moved), abs(shift)), deadline)
        if reason:
            vector_error = torch.tensor([inf], dtype=torch.float64)
            numbers = torch.tensor([[value], [residual]], dtype=torch.float64)
            return Eigenpairs(numbers[0], v[:, None], numbers[1], vector_error, reason), step
        v = w


def _power_reason(
    settings: PowerSettings, step: int, value: float, residual: float, floor: float, deadline: float
) -> StopReason | None:
    if residual <= max(settings.rtol * abs(value), settings.atol):
        return "tolerance"
    if residual <= floor:
        return "noise floor"
    if step == settings.max_matvecs:
        return "matvec budget"
    return "time budget" if monotonic() > deadline else None


def power_ends(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: PowerSettings = PowerSettings(),
    progress: Progress | None = None,
) -> EigenEnds:
    """Both ends of the spectrum as StableGS takes them: power iteration, then power iteration on H - lambda I.

    The first run finds the eigenvalue of largest magnitude, which is lambda_max or, where the negative end is longer,
    lambda_min; the run shifted by it finds the other end.
    """
    first, steps = power_iteration(operator, generator, settings, progress=progress)
    other, more = power_iteration(operator, generator, settings, shift=float(first.values), progress=progress)
    smallest, largest = sorted((first, other), key=lambda pair: float(pair.values))
    return EigenEnds(largest, smallest, "power iteration", steps + more, inf, nan)
