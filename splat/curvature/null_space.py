"""The directions in which a scene's loss is exactly flat, Gaussian by Gaussian, and the projector that leaves them out.

A Gaussian enters a view only through its splat of nine numbers, so over M views Gauss-Newton sees at most
min(9 M, 10 + 3 min(M, k)) of its 11 + 3 k parameters (k SH coefficients a channel): with SH degree 3 and three views a third of
the spectrum is zeros that say nothing.  The row space of all its projections' Jacobians, stacked, is what is left.  The
Hessian sees more: everything but the SH directions that vanish in all view directions together with their slope in the mean,
and (by choice, see `curvature.py`) the lengths of the quaternions.

A basis is found per Gaussian by a small singular value decomposition of its rows, each scaled to unit length; directions
whose singular value is beneath TOLERANCE of the largest are null.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splat.backend.cpu.threads import over_batch
from splat.projection.formulas import GEOMETRY, ProjectionJacobian

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-11}  # of the largest singular value; what rounding leaves of a zero
CHUNK = 4096  # Gaussians at a time
WIDEST = 32  # rows and columns of matrices that CUDA takes apart together; larger ones it takes one by one


@dataclass(frozen=True, eq=False)
class RowSpace:
    """An orthonormal basis per Gaussian of what is seen, zero-padded; rank: how many of its rows are not padding."""

    basis: Float[Tensor, "n r d"]
    rank: Int[Tensor, " n"]

    @cached_property
    def _partial(self) -> tuple[Int[Tensor, " m"], Float[Tensor, "m r d"]]:
        """The Gaussians that have null components, and their bases: with low SH degrees few have any."""
        index = torch.nonzero(self.rank < self.basis.shape[2])[:, 0]
        return index, self.basis[index]

    def project(self, x: Float[Tensor, "n d k"]) -> Float[Tensor, "n d k"]:
        """x without its null components."""
        index, basis = self._partial
        return x.index_copy(0, index, basis.mT @ (basis @ x[index]))

    def scaled(self, scale: Float[Tensor, "n d"]) -> "RowSpace":
        """The space of all D x, D = diag(scale) > 0 and x in this space."""
        rows = (self.basis.double() * scale[:, None].double()).cpu()  # CUDA forms one Q after the other
        directions = torch.empty_like(rows)

        def decompose(first: int, last: int) -> None:
            directions[first:last] = torch.linalg.qr(rows[first:last].mT).Q.mT

        over_batch(len(rows), decompose, rows.device)
        # the padding is at the end
        held = torch.arange(self.basis.shape[1], device=self.basis.device) < self.rank[:, None]
        return RowSpace(torch.where(held[:, :, None], directions.to(self.basis), 0.0), self.rank)


Stacked = Callable[[Tensor], Tensor]


def _alone(rows: Tensor) -> Tensor:
    return rows


def seen_harmonics(views: Sequence[ProjectionJacobian], n: int, bands: int, stacked: Stacked = _alone) -> RowSpace:
    """The SH directions (k of one channel; the three are alike) in which the Hessian can be non-zero.

    stacked: completes the rows of these views to those of all views, where other processes hold some.
    """
    rows = _like(views).new_zeros(n, 4 * len(views), bands, dtype=torch.float64)
    for m, held in enumerate(views):
        index = torch.as_tensor(held.index)
        rows[index, 4 * m] = torch.as_tensor(held.harmonic[:, :bands]).double()
        rows[index, 4 * m + 1 : 4 * m + 4] = torch.as_tensor(held.slope[:, :bands]).double().mT
    return _row_space(stacked(rows), _like(views).dtype)


def seen_parameters(views: Sequence[ProjectionJacobian], n: int, bands: int, stacked: Stacked = _alone) -> RowSpace:
    """The directions of a Gaussian's parameters (mean, log-scales, quaternion, logit, SH) that Gauss-Newton sees."""
    parts = [
        _row_space(stacked(_jacobian_rows(views, start, min(start + CHUNK, n), bands)), _like(views).dtype)
        for start in range(0, n, CHUNK)
    ]
    width = max(part.basis.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.basis, (0, 0, 0, width - part.basis.shape[1])) for part in parts]
    return RowSpace(torch.cat(padded), torch.cat([part.rank for part in parts]))


def _like(views: Sequence[ProjectionJacobian]) -> Tensor:
    """An empty tensor of the views' precision, on their device."""
    return torch.as_tensor(views[0].jacobian[:0])


def _jacobian_rows(views: Sequence[ProjectionJacobian], start: int, stop: int, bands: int) -> Float[Tensor, "n r d"]:
    """The Jacobians of the splats of Gaussians start..stop in every view, stacked: nine rows a view, zero where unseen."""
    width = GEOMETRY + 1 + 3 * bands
    rows = _like(views).new_zeros(stop - start, 9 * len(views), width, dtype=torch.float64)
    for m, held in enumerate(views):
        index = torch.as_tensor(held.index)
        here = (index >= start) & (index < stop)
        i, at = index[here] - start, 9 * m
        geometry = torch.as_tensor(held.jacobian)[here].double()
        harmonic = torch.as_tensor(held.harmonic)[here, :bands].double()
        slope, visible = (torch.as_tensor(part)[here].double() for part in (held.colour_slope, held.visible))
        rows[i, at : at + 5, :GEOMETRY] = geometry
        rows[i, at + 5, GEOMETRY] = 1.0
        for c in range(3):
            first = GEOMETRY + 1 + c
            rows[i, at + 6 + c, :3] = visible[:, c, None] * slope[:, c]
            rows[i, at + 6 + c, first : first + 3 * bands - c : 3] = visible[:, c, None] * harmonic
    return rows


def _row_space(rows: Float[Tensor, "n r d"], dtype: torch.dtype) -> RowSpace:
    """An orthonormal basis of each Gaussian's rows: the leading right singular vectors."""
    rows = rows / rows.norm(dim=2, keepdim=True).clamp_min(torch.finfo(rows.dtype).tiny)
    values, basis = _singular(rows)
    kept = (values > TOLERANCE[dtype] * values[:, :1]) & (values > 0)
    basis = torch.where(kept[:, :, None], basis, torch.zeros_like(basis))
    rank = kept.sum(dim=1)
    return RowSpace(basis[:, : int(rank.max())].to(dtype), rank)


def _singular(rows: Float[Tensor, "n r d"]) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m d"]]:
    """Singular values, descending, and right singular vectors; of wide rows on the CPU."""
    home, (n, r, d) = rows.device, rows.shape
    if rows.is_cuda and d > WIDEST:
        rows = rows.cpu()
    values, basis = rows.new_empty(n, min(r, d)), rows.new_empty(n, min(r, d), d)

    def decompose(first: int, last: int) -> None:
        for start in range(first, last, CHUNK):
            some = slice(start, min(start + CHUNK, last))
            _, values[some], basis[some] = torch.linalg.svd(_shortened(rows[some]), full_matrices=False)

    over_batch(n, decompose, rows.device)
    return values.to(home), basis.to(home)


def _shortened(rows: Float[Tensor, "n r d"]) -> Float[Tensor, "n _ d"]:
    """On a GPU no more rows than columns, which have the same singular values and right singular vectors."""
    return torch.linalg.qr(rows, mode="r").R if rows.is_cuda and rows.shape[1] > rows.shape[2] else rows
