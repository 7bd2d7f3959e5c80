"""Real spherical harmonics to degree 3, in the order and with the signs of the original 3DGS code.

`Y_lm` with the Condon-Shortley phase, bands l = 0..3 one after the other, m from -l to l.  A constant's comment gives its
closed form.  Directions are unit vectors from the camera centre to the Gaussian, in the world frame.
"""

from math import pi, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

Y00 = 1 / sqrt(4 * pi)
Y1 = sqrt(3 / (4 * pi))
Y2A, Y2B, Y2C = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi)), sqrt(15 / (16 * pi))  # |m| = 1 or xy; m = 0; x^2 - y^2
Y3A, Y3B, Y3C = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi))  # |m| = 3, 2, 1
Y3D = sqrt(7 / (16 * pi))  # m = 0


def harmonics(direction: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n k"]:
    """The (degree + 1)^2 basis functions at unit directions."""
    x, y, z = direction.unbind(-1)
    basis = [torch.full_like(x, Y00)]
    if degree >= 1:
        basis += [-Y1 * y, Y1 * z, -Y1 * x]
    if degree >= 2:
        basis += [Y2A * x * y, -Y2A * y * z, Y2B * (2 * z * z - x * x - y * y), -Y2A * x * z, Y2C * (x * x - y * y)]
    if degree >= 3:
        basis += [
            -Y3A * y * (3 * x * x - y * y),
            Y3B * x * y * z,
            -Y3C * y * (4 * z * z - x * x - y * y),
            Y3D * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -Y3C * x * (4 * z * z - x * x - y * y),
            Y3B / 2 * z * (x * x - y * y),
            -Y3A * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)
