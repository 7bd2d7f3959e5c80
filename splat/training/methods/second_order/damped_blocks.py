"""The Gaussians' own blocks of a Hessian as a metric and as a preconditioner.

The unknowns are y = theta / S, S a number for each parameter, so that lambda adds alike to world units, e-folds and logits.
With B the 11 x 11 blocks and the diagonal of SH, D the diagonal of P B P and <|D|> its mean over the Gaussians' same attribute,

    1 / S^2 = |D| + floor <|D|>            |D| averaged over the three axes of a mean, of scales, of a turn
    M       = (|S P B P S| + lambda)^-1    |.| of eigenvalues; P removes the lengths of quaternions, as M does

The floor keeps Gaussians that are hardly seen, whose curvature is all but 0, from leaps.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.cpu.absolute import absolute_values
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS, PerGaussianBlocks
from splat.curvature.null.active_spaces import without_lengths
from splat.model.gaussians import Gaussians

SLACK = 10  # eps of a block's trace: what rounding makes negative


class DampedBlocks:
    """S (`scale`), P (`project`) and M (`inverse`) of blocks at Gaussians with unit quaternions."""

    def __init__(self, gaussians: Gaussians, blocks: PerGaussianBlocks, floor: float):
        self.gaussians, self._rows = gaussians, gaussians.blocks
        self.scale = _scale(gaussians, blocks, floor)
        units = self._geometry(self.scale)
        radial = torch.zeros_like(units)
        radial[:, GEOMETRY_COLUMNS["quats"]] = gaussians.quats
        self._radial = radial
        scaled = units[:, :, None] * blocks.geometry * units[:, None, :]
        self._absolute = absolute(_across(radial, scaled))
        self._sh = (blocks.sh.flatten() * self.scale[self._rows["sh"]].square()).abs()

    def project(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """P V, of theta and y alike: a quaternion's four unknowns have one S."""
        return without_lengths(V, self.gaussians.quats, self._rows["quats"])

    def inverse(self, damping: float, diagonal: bool = False) -> Callable[[Float[Tensor, " p"]], Float[Tensor, " p"]]:
        """P M P, as a function of a vector; diagonal: of the diagonals alone (Jacobi)."""
        found = self._absolute
        if diagonal:
            found = torch.diag_embed(found.diagonal(dim1=1, dim2=2) - self._radial.square())
        damped = found + damping * torch.eye(found.shape[1]).to(found)
        inverted, sh = torch.linalg.inv_ex(damped).inverse, 1 / (self._sh + damping)

        def apply(v: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
            solved = (inverted @ self._geometry(v)[:, :, None])[:, :, 0]
            parts = [solved[:, columns].flatten() for columns in GEOMETRY_COLUMNS.values()]
            return self.project(torch.cat([*parts, sh * v[self._rows["sh"]]])[:, None])[:, 0]

        return apply

    def _geometry(self, flat: Float[Tensor, " p"]) -> Float[Tensor, "n 11"]:
        n = len(self.gaussians)
        return torch.cat([flat[self._rows[name]].view(n, -1) for name in GEOMETRY_COLUMNS], dim=1)


def _scale(gaussians: Gaussians, blocks: PerGaussianBlocks, floor: float) -> Float[Tensor, " p"]:
    """S; 0 where neither a parameter nor its like has any curvature."""
    found = {}
    for name, part in blocks.diagonals_across(gaussians.quats).items():
        size = part.abs()
        if name in ("means", "log_scales", "quats"):
            size = (size.sum(dim=1, keepdim=True) / 3).expand(size.shape)
        size = size + floor * size.mean()
        found[name] = torch.where(size > 0, size.rsqrt(), 0.0).to(gaussians.flat)
    return Gaussians.pack({**found, "opacity_logits": found["opacity_logits"].flatten()}).flat


def _across(radial: Float[Tensor, "n 11"], C: Float[Tensor, "n 11 11"]) -> Float[Tensor, "n 11 11"]:
    """P C P, and 1 along the unit vectors that P removes, to be inverted."""
    r = radial[:, :, None]
    C = C - r * (r * C).sum(dim=1, keepdim=True)
    return C - (C * r.mT).sum(dim=2, keepdim=True) * r.mT + r * r.mT


def absolute(C: Float[Tensor, "n d d"]) -> Float[Tensor, "n d d"]:
    """|C| of symmetric matrices: their eigenvalues' absolute values.

    >>> absolute(torch.tensor([[[2.0, 0.0], [0.0, -3.0]]])).tolist()
    [[[2.0, 0.0], [0.0, 3.0]]]
    """
    trace = C.diagonal(dim1=1, dim2=2).abs().sum(dim=1)[:, None, None]
    slack = SLACK * torch.finfo(C.dtype).eps * trace * torch.eye(C.shape[1]).to(C)
    indefinite = torch.linalg.cholesky_ex(C + slack).info != 0
    rest = C[indefinite]
    if rest.is_cuda:
        values, vectors = torch.linalg.eigh(rest)
        return C.index_put((indefinite,), (vectors * values.abs()[:, None]) @ vectors.mT)
    return C.index_put((indefinite,), absolute_values(rest))
