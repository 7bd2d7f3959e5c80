"""Directions of single Gaussians in which the loss curves most: where the search for the ends of the spectrum begins.

Steep eigenvectors of a scene live on one or two Gaussians, and the block of a Gaussian's own rows, but for its colours, is
known exactly (`linearize.OwnBlocks`).  The eigenvectors of these blocks are taken at right angles to the quaternions' lengths,
as in `curvature.SceneHessian`.  From their sum Lanczos needs 18 instead of 39 products for the two largest and the smallest
eigenvalue of fern (8,000 Gaussians, 3 views) to 10%; from more of them than pairs are wanted it needs more again.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splat.curvature import SceneObjective
from splat.linearize import GEOMETRY_COLUMNS, OwnBlocks

CHUNK = 65_536  # Gaussians at a time


def steepest_own(objective: SceneObjective, own: OwnBlocks, largest: int, smallest: int) -> Float[Tensor, "p k"]:
    """Unit vectors: of the largest eigenvalues of the Gaussians' own blocks, descending, and of the smallest, ascending."""
    blocks, quats = own.geometry, objective.active.quats
    chunks = [slice(i, i + CHUNK) for i in range(0, len(blocks), CHUNK)]
    values = torch.cat([torch.linalg.eigvalsh(_crosswise(blocks[i], quats[i])[0]) for i in chunks]).flatten()
    top = values.topk(min(largest, len(values))).indices
    bottom = values.topk(min(smallest, len(values)), largest=False).indices
    chosen, columns = torch.cat([top, bottom]) // blocks.shape[1], torch.cat([top, bottom]) % blocks.shape[1]
    across, P = _crosswise(blocks[chosen], quats[chosen])
    vectors = P @ torch.linalg.eigh(across).eigenvectors
    result = objective.active.flat.new_zeros(objective.active.flat.numel(), len(chosen))
    for k, (gaussian, column) in enumerate(zip(chosen.tolist(), columns.tolist(), strict=True)):
        for name, part in GEOMETRY_COLUMNS.items():
            first = objective.blocks[name].start + gaussian * (part.stop - part.start)
            result[first : first + part.stop - part.start, k] = vectors[k, part, column].to(result)
    return result


def _crosswise(
    blocks: Float[Tensor, "n 11 11"], quats: Float[Tensor, "n 4"]
) -> tuple[Float64[Tensor, "n 11 11"], Float64[Tensor, "n 11 11"]]:
    """P B P and P, which projects the quaternions' lengths out."""
    turns = GEOMETRY_COLUMNS["quats"]
    P = torch.eye(blocks.shape[1], dtype=torch.float64, device=blocks.device).repeat(len(blocks), 1, 1)
    P[:, turns, turns] -= quats[:, :, None].double() * quats[:, None, :].double()
    return P @ blocks.double() @ P, P
