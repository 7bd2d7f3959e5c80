"""A control variate: a quantity with a known mean that varies with the samples takes their common chance away.

With samples x, a control y from the same probes and its known mean m,

    x - c (y - m)

has the mean of x for any c that the probe itself had no part in, and the least variance with c the slope of x on y.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

EPS = torch.finfo(torch.float64).eps
ROUND_OFFS = 10  # of the sum of squares, which is all that is left of the others' spread where they do not vary


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
