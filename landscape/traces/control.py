"""Control variates: variance reduction by a quantity with a known mean.

Samples x and a control y from the same probes, with the known mean m of y, give

    x - c (y - m)

It has the mean of x for any c that does not depend on the probe, and the smallest variance where c is the slope of x on y.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

EPS = torch.finfo(torch.float64).eps
ROUND_OFFS = 10  # of the sum of squares: a smaller spread of the other controls means that they are equal


def controlled(samples: Float64[Tensor, " s"], control: Float64[Tensor, " s"], mean: float) -> Float64[Tensor, " s"]:
    """samples - c (control - mean), where c is fitted for each sample to all others by least squares (0 if their controls are
    equal; fewer than 3 samples are returned as they are).

    >>> x = torch.tensor([1.0, 2.0, 4.0, 8.0]).double()
    >>> controlled(3 * x + 5, x, mean=2.0).round(decimals=9)  # 3 x + 5 has the mean 11, and x explains all of it
    tensor([11., 11., 11., 11.], dtype=torch.float64)
    """
    if len(samples) < 3:
        return samples
    x, y = samples - samples.mean(), control - control.mean()
    unit = float(y.abs().max()) or 1.0
    y = y / unit  # squares of y may leave the range of floats
    left = len(samples) / (len(samples) - 1)  # the means move, too, when a sample is left out
    cross, spread = (x * y).sum() - left * x * y, y.square().sum() - left * y.square()
    varies = spread > ROUND_OFFS * EPS * y.square().sum()
    slope = torch.where(varies, cross / spread.clamp_min(1e-300), torch.zeros_like(cross))
    return samples - slope * ((control - mean) / unit)
