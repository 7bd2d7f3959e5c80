"""Control variates: an operator that knows the diagonal of a part of itself leaves less to chance.

H = K + R with the diagonal of K known: z^T K z has the known mean tr K and goes with z^T H z as far as K is like H, so

    x - c (y - tr K),   x = z^T H z,   y = z^T K z

has the mean tr H for any c that the probe itself had no part in, and the least variance with c the slope of x on y.
"""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.operators.operator import RestrictedOperator, SymmetricOperator

EPS = torch.finfo(torch.float64).eps
ROUND_OFFS = 10  # of the sum of squares, which is all that is left of the others' spread where they do not vary


@runtime_checkable
class PartlyKnown(SymmetricOperator, Protocol):
    """An operator H = K + R that knows the diagonal of its part K: estimators of traces and of the diagonal make use of it."""

    @property
    def known(self) -> SymmetricOperator:
        """K: same rows, blocks and dtype.  The operator itself, where its whole diagonal is known."""
        ...

    def known_diagonal(self) -> Float[Tensor, " n"]:
        """The exact diagonal of K."""
        ...


class RestrictedPartlyKnown(RestrictedOperator):
    """E^T H E of a partly known H: the diagonal block on one named block of rows, still partly known."""

    inner: PartlyKnown

    def __init__(self, inner: PartlyKnown, block: str) -> None:
        super().__init__(inner, block)
        self.known = self if inner.known is inner else RestrictedOperator(inner.known, block)

    def known_diagonal(self) -> Float[Tensor, " n"]:
        return self.inner.known_diagonal()[self.rows]


def restrict(operator: SymmetricOperator, block: str) -> RestrictedOperator:
    """E^T H E, with what is known of it."""
    if isinstance(operator, PartlyKnown):
        return RestrictedPartlyKnown(operator, block)
    return RestrictedOperator(operator, block)


def slope(samples: Float64[Tensor, " s"], control: Float64[Tensor, " s"]) -> float:
    """The least-squares slope of the samples on the control; 0 where it does not vary."""
    x, (y, unit) = samples - samples.mean(), _in_units(control - control.mean())
    spread = float(y.square().sum())
    return float((x * y).sum()) / spread / unit if spread > 0 else 0.0


def controlled(samples: Float64[Tensor, " s"], control: Float64[Tensor, " s"], mean: float) -> Float64[Tensor, " s"]:
    """samples - c (control - mean), c the least-squares slope through the other samples (0 where they do not vary)."""
    if len(samples) < 3:
        return samples
    x, (y, unit) = samples - samples.mean(), _in_units(control - control.mean())
    left = len(samples) / (len(samples) - 1)  # as the means move, too, when a sample is left out
    cross, spread = (x * y).sum() - left * x * y, y.square().sum() - left * y.square()
    varies = spread > ROUND_OFFS * EPS * y.square().sum()
    slope = torch.where(varies, cross / spread.clamp_min(1e-300), torch.zeros_like(cross))
    return samples - slope * ((control - mean) / unit)


def _in_units(y: Float64[Tensor, " s"]) -> tuple[Float64[Tensor, " s"], float]:
    """y over its largest modulus, and that modulus: squares of y may leave the range of floats."""
    unit = float(y.abs().max()) or 1.0
    return y / unit, unit
