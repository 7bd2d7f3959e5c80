"""Two bars without curvature, of the study.

ensemble            |R(Theta_1) - R(Theta_2)|_1 between trainings that differ in their seed
co-adaptation       the variance of a pixel's colour over renders of random halves of the Gaussians, after arXiv 2508.12720:
                    the mean over pixels and colours of (A - B)^2 / 2 for two halves A, B drawn independently
"""

from collections.abc import Sequence

import torch

from landscape.results import Measured
from splat.curvature.scores.poses import Poses, distance
from splat.model.gaussians import Gaussians

KEPT = 0.5  # share of the Gaussians in a random subset


def ensemble(one: Gaussians, others: Sequence[Gaussians], poses: Poses) -> Measured:
    """The mean over the other seeds' Gaussians, with its error over them."""
    images = poses.images(one)
    return Measured.mean(torch.tensor([distance(poses.images(each), images) for each in others], dtype=torch.float64))


def coadaptation(
    gaussians: Gaussians, poses: Poses, generator: torch.Generator, kept: float = KEPT, draws: int = 16
) -> Measured:
    """The variance at these poses, with its error over pairs of subsets."""
    variances = torch.zeros(draws, dtype=torch.float64)
    for i in range(draws):
        masks = torch.rand(2, len(gaussians), generator=generator) < kept
        A, B = (poses.images(gaussians, mask.to(gaussians.flat)) for mask in masks)
        variances[i] = sum(float((a - b).square().mean()) for a, b in zip(A, B, strict=True)) / (2 * len(A))
    return Measured.mean(variances)
