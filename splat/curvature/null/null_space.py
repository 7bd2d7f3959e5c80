"""Directions in which a scene's loss is exactly flat, Gaussian by Gaussian, and their complement, which the loss "sees".

A Gaussian enters a view only through its splat of nine numbers, so over M views Gauss-Newton sees at most
min(9 M, 10 + 3 min(M, k)) of its 11 + 3 k parameters (k SH coefficients a channel): with SH degree 3 and three views a third of
the spectrum is structural zeros.  It sees the row space of the stacked Jacobians of the Gaussian's projections.

The Hessian sees all geometry; the lengths of the quaternions are excluded by choice (`SceneHessian`).  It sees SH coefficients
f through colours alone.  With d_m the direction from view m to the mean mu, Y the harmonics, a_mc the loss's derivative in the
colour, and x any parameter,

    colour_mc      = sum_k f_kc Y_k(d_m) + 1/2
    d2L / df_kc dx = sum_m Y_k(d_m) da_mc/dx + sum_m a_mc dY_k(d_m)/dx

where a_mc = 0 if view m clamps channel c.  So it sees Y(d_m) of every view that draws the Gaussian and does not clamp the
channel and, over the channels together, three slopes sum_m a_mc dY_k(d_m)/dmu_j.  Slopes couple SH to the mean only: the block
of SH is flat along their components orthogonal to the harmonics.

Numerical ranks (`row_space.py`): rows are scaled to unit length; slopes, which can cancel, are compared with the sum of the
norms of their terms.  The Hessian's space of SH coefficients is in `colour_space.py`, Gauss-Newton's of all parameters here.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splat.curvature.null.row_space import CHUNK, TOLERANCE, RowSpace, joined, row_space
from splat.projection.formulas import GEOMETRY, ProjectionJacobian


def seen_parameters(views: Sequence[ProjectionJacobian], n: int, bands: int) -> RowSpace:
    """The directions of each of n Gaussians' parameters (mean, log-scales, quaternion, logit, SH) that Gauss-Newton sees."""
    dtype = _like(views).dtype
    parts = [
        row_space(_jacobian_rows(views, start, min(start + CHUNK, n), bands), TOLERANCE[dtype]).to(dtype)
        for start in range(0, n, CHUNK)
    ]
    return joined(parts)


def _like(views: Sequence[ProjectionJacobian]) -> Tensor:
    """An empty tensor with the views' dtype and device."""
    return torch.as_tensor(views[0].jacobian[:0])


def _jacobian_rows(views: Sequence[ProjectionJacobian], start: int, stop: int, bands: int) -> Float[Tensor, "n r d"]:
    """The stacked Jacobians of Gaussians start .. stop: nine rows a view, zero where it does not see them."""
    width = GEOMETRY + 1 + 3 * bands
    rows = _like(views).new_zeros(stop - start, 9 * len(views), width, dtype=torch.float64)
    for m, view in enumerate(views):
        index = torch.as_tensor(view.index)
        here = (index >= start) & (index < stop)
        i, at = index[here] - start, 9 * m
        geometry = torch.as_tensor(view.jacobian)[here].double()
        harmonic = torch.as_tensor(view.harmonic)[here, :bands].double()
        opacity = torch.as_tensor(view.opacity_slope)[here].double()
        slope, visible = (torch.as_tensor(part)[here].double() for part in (view.colour_slope, view.visible))
        rows[i, at : at + 5, :GEOMETRY] = geometry
        rows[i, at + 5, GEOMETRY] = 1.0  # a logit counts as seen however flat the sigmoid is
        if opacity.shape[1]:
            rows[i, at + 5, :GEOMETRY] = opacity
            rows[i, at + 5, GEOMETRY] = torch.as_tensor(view.logit_slope)[here].double()
        for c in range(3):
            first = GEOMETRY + 1 + c
            rows[i, at + 6 + c, :3] = visible[:, c, None] * slope[:, c]
            rows[i, at + 6 + c, first : first + 3 * bands - c : 3] = visible[:, c, None] * harmonic
    return rows
