"""Uncertainty of a view: the variance of its pixels, J B^-1 J^T, given the information B of the training views.

B is the prior and the information of the training views (`splat.curvature.scores.information`): a Laplace approximation whose
precision is block-diagonal over Gaussians, or diagonal.  Vectors u with the covariance B^-1 are pushed forward:

    variance of a pixel = E sum_c (J u)_c^2        over samples of u; its relative standard error is sqrt(2 / samples) at most
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splat.curvature.fields import complement
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS
from splat.curvature.linearize import VECTORS, LinearizedView
from splat.curvature.scores.information import Information
from splat.model.gaussians import Gaussians


def pushed(
    total: Information, gaussians: Gaussians, Z: Float64[Tensor, "n q k"], *, diagonal: bool
) -> Float[Tensor, "p k"]:
    """B^-1/2 Z as changes of the stored parameters of Gaussians with unit quaternions.

    total: B.  Z: of the ten of the geometry and of the SH.  diagonal: B is its diagonal.
    """
    geometry, vectors = total.geometry, Z.shape[2]
    if diagonal:
        geometry = torch.diag_embed(geometry.diagonal(dim1=1, dim2=2))
    root = torch.linalg.cholesky(geometry)
    moved = complement(gaussians.quats.double()) @ torch.linalg.solve_triangular(root.mT, Z[:, :10], upper=True)
    result, rows = Z.new_empty(gaussians.flat.numel(), vectors), gaussians.blocks
    for name, columns in GEOMETRY_COLUMNS.items():
        result[rows[name]] = moved[:, columns].reshape(-1, vectors)
    result[rows["sh"]] = (Z[:, 10:] * total.sh.flatten(1).rsqrt()[:, :, None]).reshape(-1, vectors)
    return result.to(gaussians.flat)


def pixel_variance(
    view: LinearizedView, total: Information, generator: torch.Generator, samples: int = 64, *, diagonal: bool = False
) -> Float64[Tensor, "h w"]:
    """The variance of each pixel, summed over the channels, over that of a channel's noise.  total, diagonal: see `pushed`."""
    gaussians, numbers = view.gaussians, 10 + total.sh[0].numel()
    variance = torch.zeros((), dtype=torch.float64)
    for start in range(0, samples, VECTORS):
        count = min(VECTORS, samples - start)
        Z = torch.randn(len(gaussians), numbers, count, generator=generator, dtype=torch.float64)
        moved = view.jvp(pushed(total, gaussians, Z, diagonal=diagonal))[:, :3]
        variance = variance + moved.double().square().sum(dim=(0, 1))
    return variance / samples
