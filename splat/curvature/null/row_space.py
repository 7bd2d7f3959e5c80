"""Row spaces of many small matrices, one for each Gaussian, by their orthonormal bases.

A basis is found by a singular value decomposition of the rows; directions with a singular value below TOLERANCE times the
largest are null.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splat.backend.cpu.threads import over_batch

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-11}  # rounding errors, relative to the largest singular value
CHUNK = 4096  # Gaussians at a time
WIDEST = 32  # most rows and columns of matrices that CUDA decomposes in a batch; larger ones it takes one by one


@dataclass(frozen=True, eq=False)
class RowSpace:
    """An orthonormal basis (rows) for each Gaussian, zero-padded; rank: number of rows that are not padding."""

    basis: Float[Tensor, "n r d"]
    rank: Int[Tensor, " n"]

    @cached_property
    def _incomplete(self) -> tuple[Int[Tensor, " m"], Float[Tensor, "m r d"]]:
        """The Gaussians whose space is not everything, and their bases; with low SH degrees or many views they are few."""
        index = torch.nonzero(self.rank < self.basis.shape[2])[:, 0]
        return index, self.basis if len(index) == len(self.basis) else self.basis[index]

    def project(self, x: Float[Tensor, "n d k"]) -> Float[Tensor, "n d k"]:
        """Orthogonal projection of x onto the space."""
        index, basis = self._incomplete
        if basis is self.basis:
            return basis.mT @ (basis @ x)
        return x.index_copy(0, index, basis.mT @ (basis @ x[index]))

    def scaled(self, scale: Float[Tensor, "n d"]) -> "RowSpace":
        """The space of all D x, D = diag(scale) > 0 and x in this space."""
        return orthonormal(self.basis * scale[:, None], self.rank)

    def to(self, dtype: torch.dtype) -> "RowSpace":
        return RowSpace(self.basis.to(dtype), self.rank)


def orthonormal(rows: Float[Tensor, "n r d"], rank: Int[Tensor, " n"]) -> RowSpace:
    """The space of linearly independent rows, `rank` of them, followed by padding."""
    matrices = rows.mT.double().cpu()  # CUDA would form one Q after the other
    directions = torch.empty_like(matrices.mT, memory_format=torch.contiguous_format)

    def decompose(first: int, last: int) -> None:
        directions[first:last] = torch.linalg.qr(matrices[first:last]).Q.mT

    over_batch(len(rows), decompose, matrices.device)
    kept = torch.arange(rows.shape[1], device=rows.device) < rank[:, None]
    return RowSpace(torch.where(kept[:, :, None], directions.to(rows), 0.0), rank)


def joined(parts: Sequence[RowSpace]) -> RowSpace:
    """The row spaces of all Gaussians, from those of consecutive ones."""
    width = max(part.basis.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.basis, (0, 0, 0, width - part.basis.shape[1])) for part in parts]
    return RowSpace(torch.cat(padded), torch.cat([part.rank for part in parts]))


def row_space(rows: Float[Tensor, "n r d"], tolerance: float) -> RowSpace:
    """The row space of each Gaussian's rows, scaled to unit length."""
    return spanned(rows / rows.norm(dim=2, keepdim=True).clamp_min(torch.finfo(rows.dtype).tiny), None, tolerance)


def spanned(rows: Float[Tensor, "n r d"], sizes: Float[Tensor, " n"] | None, tolerance: float) -> RowSpace:
    """The span of the right singular vectors with values above tolerance times sizes, by default the largest value."""
    values, basis = _singular(rows)
    kept = (values > tolerance * (values[:, :1] if sizes is None else sizes[:, None])) & (values > 0)
    rank = kept.sum(dim=1)
    return RowSpace(torch.where(kept[:, :, None], basis, 0.0)[:, : int(rank.max()) if len(rank) else 0], rank)


def _singular(rows: Float[Tensor, "n r d"]) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m d"]]:
    """Singular values, descending, and right singular vectors; computed on the CPU for wide rows."""
    home, (n, r, d) = rows.device, rows.shape
    if rows.is_cuda and d > WIDEST:
        rows = rows.cpu()
    values, basis = rows.new_empty(n, min(r, d)), rows.new_empty(n, min(r, d), d)

    def decompose(first: int, last: int) -> None:
        for start in range(first, last, CHUNK):
            some = slice(start, min(start + CHUNK, last))
            part = rows[some]
            if rows.is_cuda and r > d:  # R has the same values and right vectors, and fewer rows: faster there
                part = torch.linalg.qr(part, mode="r").R
            _, values[some], basis[some] = torch.linalg.svd(part, full_matrices=False)

    over_batch(n, decompose, rows.device)
    return values.to(home), basis.to(home)
