"""Share of a scene's Hessian within the blocks of single Gaussians: how good "block-diagonal" approximations are.

With B the part of H (or of Gauss-Newton) that a method keeps, and R = H - B the rest, which has zeros where B has not:

    share = |B|_F^2 / |H|_F^2 = |B|_F^2 / (|B|_F^2 + |R|_F^2),     |R|_F^2 = E |R z|^2,  z of random signs

|B|_F is exact.  To sample the rest alone makes the error of a share that is near 1 small.  Three B, each within the one before:

    blocks      the 11 x 11 of a Gaussian's geometry and opacity, and the diagonal of its SH
    attributes  of these the 3 x 3 of the mean and of the log-scales, the 4 x 4 of the quaternion, and the diagonal of the rest
    diagonal

Without SSIM's window, which published methods drop, l'' is its pixel-diagonal.  The lengths of the quaternions
are projected out of H and B, as in `SceneHessian`; the other flat directions are 0 in both.
"""

from dataclasses import dataclass
from math import nan, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.probes import draw_probes
from landscape.results import Progress
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS, PerGaussianBlocks
from splat.curvature.hessian import ViewSum
from splat.curvature.null.active_spaces import without_lengths
from splat.curvature.objective import SceneObjective
from splat.render.backend import backend_of


@dataclass(frozen=True)
class BlockShare:
    """The shares of one operator; nan where it is exactly 0.

    norm: |H|_F^2.  error: its relative standard error, and that of the shares.  samples: vectors z.
    """

    gauss_newton: bool
    ssim_window: bool
    blocks: float
    attributes: float
    diagonal: float
    norm: float
    error: float
    samples: int


def block_shares(
    objective: SceneObjective,
    generator: torch.Generator,
    samples: int = 8,
    progress: Progress | None = None,
    *,
    ssim_window: bool = True,
) -> list[BlockShare]:
    """The shares of the Hessian and of Gauss-Newton, and of both without SSIM's window where the loss has SSIM.

    ssim_window: False for the latter alone, which takes a fifth of the time; so it is on a GPU, which lacks the exact
    blocks of a loss with SSIM.  All see the same z.

    >>> from splat import SceneObjective, SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> objective = SceneObjective(made.truth, made.scene.load())
    >>> shares = block_shares(objective, torch.Generator().manual_seed(0))
    >>> [(one.gauss_newton, one.ssim_window, one.blocks > one.diagonal) for one in shares]
    [(False, True, True), (True, True, True), (False, False, True), (True, False, True)]
    """
    if samples < 2:
        raise InputError(f"expected at least 2 samples of the blocks' share, got {samples}")
    active = objective.active
    Z = draw_probes(active.flat.numel(), samples, generator, active.flat.dtype, "rademacher").to(active.flat.device)
    couplings = [True, False] if ssim_window and backend_of(active.flat).exact_blocks else [False]
    if not objective.couples_pixels:
        couplings = [True]  # l'' is its diagonal
    found: list[BlockShare] = []
    for couples in couplings:
        exact = couples and objective.couples_pixels
        both = objective.exact_blocks if exact else [objective.approximate_blocks[0], objective.pixelwise_blocks]
        for gauss_newton, blocks in zip((False, True), both, strict=True):
            operator = ViewSum(objective, gauss_newton=gauss_newton, ssim_window=couples)
            found.append(_share(operator, blocks.across(active.quats), Z))
            if progress:
                progress(len(found), 2 * len(couplings), "shares of operators within blocks")
    return found


def _share(operator: ViewSum, blocks: PerGaussianBlocks, Z: Float[Tensor, "p s"]) -> BlockShare:
    """operator: H; blocks: of P H P."""
    objective = operator.objective
    turns = objective.active.quats, objective.blocks["quats"]
    product = without_lengths(operator.apply(without_lengths(Z, *turns)) / len(objective.views), *turns)
    rest = (product - blocks.apply(Z, objective.active)).double().square().sum(dim=0)
    geometry, sh = blocks.geometry.double().square(), float(blocks.sh.double().square().sum())
    diagonal = float(geometry.diagonal(dim1=1, dim2=2).sum()) + sh
    attributes = sum(float(geometry[:, columns, columns].sum()) for columns in GEOMETRY_COLUMNS.values()) + sh
    whole = float(geometry.sum()) + sh
    norm, samples = whole + float(rest.mean()), len(rest)
    blocks_share, attributes_share, diagonal_share = (
        part / norm if norm else nan for part in (whole, attributes, diagonal)
    )
    error = float(rest.std()) / sqrt(samples) / norm if norm else 0.0
    return BlockShare(
        operator.gauss_newton,
        operator.ssim_window,
        blocks_share,
        attributes_share,
        diagonal_share,
        norm,
        error,
        samples,
    )
