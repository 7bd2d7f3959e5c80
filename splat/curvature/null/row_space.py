"""Row spaces of many small matrices, one for each Gaussian, by their orthonormal bases.

A basis is found by a singular value decomposition of the rows; directions with a singular value below TOLERANCE times the
largest, or times a given size, are null.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splat.backend.cpu.threads import over_batch

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-11}  # rounding errors, relative to the largest singular value
ROUNDING = 16 * torch.finfo(torch.float64).eps  # what is left of a row of length 1 that depends on those before
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
    basis = torch.empty_like(rows)

    def decompose(first: int, last: int) -> None:
        basis[first:last] = _gram_schmidt(rows[first:last].double())[1].to(rows)

    over_batch(len(rows), decompose, rows.device)
    kept = torch.arange(rows.shape[1], device=rows.device) < rank[:, None]
    return RowSpace(torch.where(kept[:, :, None], basis, 0.0), rank)


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
    """Singular values, descending, and right singular vectors; where rows are fewer than columns, from square matrices."""
    home, (n, r, d) = rows.device, rows.shape
    if rows.is_cuda and min(r, d) > WIDEST:
        rows = rows.cpu()
    values, basis = rows.new_empty(n, min(r, d)), rows.new_empty(n, min(r, d), d)

    def decompose(first: int, last: int) -> None:
        for start in range(first, last, CHUNK):
            some = slice(start, min(start + CHUNK, last))
            part = rows[some]
            if r < d:  # L of rows = L Q has their singular values; its right vectors times Q are theirs
                part, Q = _gram_schmidt(part)
                _, values[some], turned = torch.linalg.svd(part)
                basis[some] = turned @ Q
                continue
            if rows.is_cuda and r > d:  # R has the same values and right vectors, and fewer rows: faster there
                part = torch.linalg.qr(part, mode="r").R
            _, values[some], basis[some] = torch.linalg.svd(part, full_matrices=False)

    over_batch(n, decompose, rows.device)
    return values.to(home), basis.to(home)


def _gram_schmidt(rows: Float[Tensor, "n r d"]) -> tuple[Float[Tensor, "n r r"], Float[Tensor, "n r d"]]:
    """L, lower triangular, and Q of rows = L Q; rows of Q are orthonormal, or 0 where a row depends on those before.

    Many small matrices at once on either device: CUDA would form one Q of a Householder decomposition after the other.
    """
    L, Q = rows.new_zeros(len(rows), rows.shape[1], rows.shape[1]), torch.zeros_like(rows)
    for i in range(rows.shape[1]):
        rest, before = rows[:, i, :, None], Q[:, :i]
        for _ in range(2):  # the second time removes what rounding left of the rows before
            along = before @ rest
            L[:, i, :i] += along[:, :, 0]
            rest = rest - before.mT @ along
        length = rest.norm(dim=1, keepdim=True)
        new = length > ROUNDING * rows[:, i].norm(dim=1)[:, None, None]
        L[:, i, i] = torch.where(new, length, 0.0)[:, 0, 0]
        Q[:, i] = torch.where(new, rest / length, 0.0)[:, :, 0]
    return L, Q
