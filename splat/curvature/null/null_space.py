"""The directions in which a scene's loss is exactly flat, Gaussian by Gaussian, and the projector that leaves them out.

A Gaussian enters a view only through its splat of nine numbers, so over M views Gauss-Newton sees at most
min(9 M, 10 + 3 min(M, k)) of its 11 + 3 k parameters (k SH coefficients a channel): with SH degree 3 and three views a third of
the spectrum is zeros that say nothing.  The row space of all its projections' Jacobians, stacked, is what is left.

The Hessian sees the whole geometry but, by choice (`SceneHessian`), the lengths of the quaternions.  It sees SH coefficients f
through colours alone.  With d_m the direction from view m to the mean mu, Y the harmonics, a_mc the loss's derivative in the
colour, and x any parameter,

    colour_mc      = sum_k f_kc Y_k(d_m) + 1/2
    d2L / df_kc dx = sum_m Y_k(d_m) da_mc/dx + sum_m a_mc dY_k(d_m)/dx

where a_mc = 0 if view m clamps channel c.  So it sees Y(d_m) of every view that draws the Gaussian and does not clamp the
channel and, over the channels together, three slopes sum_m a_mc dY_k(d_m)/dmu_j.  They couple SH to the mean alone: the block
of SH by itself is flat along what they have at right angles to the harmonics.

A basis is found per Gaussian by a small singular value decomposition of its rows, each scaled to unit length; directions
whose singular value is beneath TOLERANCE of the largest are null.  Slopes are compared with what they are sums of.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splat.backend.cpu.threads import over_batch
from splat.model.gaussians import Gaussians
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
    def _partial(self) -> Int[Tensor, " m"]:
        """The Gaussians that have null components: with low SH degrees or many views few have any."""
        return torch.nonzero(self.rank < self.basis.shape[2])[:, 0]

    @cached_property
    def _basis(self) -> Float[Tensor, "m r d"]:
        """Theirs."""
        return self.basis if len(self._partial) == len(self.basis) else self.basis[self._partial]

    def project(self, x: Float[Tensor, "n d k"]) -> Float[Tensor, "n d k"]:
        """x without its null components."""
        basis, index = self._basis, self._partial
        if basis is self.basis:
            return basis.mT @ (basis @ x)
        return x.index_copy(0, index, basis.mT @ (basis @ x[index]))

    def scaled(self, scale: Float[Tensor, "n d"]) -> "RowSpace":
        """The space of all D x, D = diag(scale) > 0 and x in this space."""
        return _orthonormal(self.basis * scale[:, None], self.rank)


def _orthonormal(rows: Float[Tensor, "n r d"], rank: Int[Tensor, " n"]) -> RowSpace:
    """The space of rows that are independent of each other, followed by padding."""
    matrices = rows.mT.double().cpu()  # CUDA forms one Q after the other
    directions = torch.empty_like(matrices.mT, memory_format=torch.contiguous_format)

    def decompose(first: int, last: int) -> None:
        directions[first:last] = torch.linalg.qr(matrices[first:last]).Q.mT

    over_batch(len(rows), decompose, matrices.device)
    held = torch.arange(rows.shape[1], device=rows.device) < rank[:, None]
    return RowSpace(torch.where(held[:, :, None], directions.to(rows), 0.0), rank)


Stacked = Callable[[Tensor], Tensor]


def _alone(rows: Tensor) -> Tensor:
    return rows


def seen_colours(
    views: Iterable[ProjectionJacobian],
    count: int,
    gaussians: Gaussians,
    stacked: Stacked = _alone,
    summed: Stacked = _alone,
    *,
    apart: bool = False,
) -> RowSpace:
    """The directions of a Gaussian's SH coefficients in which the Hessian can be non-zero; count: of these views.

    stacked, summed: complete the rows of these views, and what is summed over them (up to a factor), to those of all views,
    where other processes hold some.  apart: of the block of SH by itself, without the slopes.
    """
    like, (n, bands) = gaussians.flat, gaussians.sh.shape[:2]
    rows = like.new_zeros(n, count, bands + 3)  # harmonics, and which channels are not clamped
    slopes, sizes = like.new_zeros(n, 3, 3 * bands), like.new_zeros(n)
    for m, held in enumerate(views):
        index, harmonic, slope = (torch.as_tensor(part) for part in (held.index, held.harmonic, held.slope))
        bar, visible = (torch.as_tensor(part) for part in (held.colour_bar, held.visible))
        rows[index, m] = torch.cat([harmonic[:, :bands], visible], dim=1)
        bent = torch.einsum("ekj,ec->ejkc", slope[:, :bands], bar).flatten(2)
        slopes[index] += bent
        sizes[index] += bent.flatten(1).norm(dim=1)
    rows, slopes, sizes = stacked(rows), summed(slopes)[:, : 0 if apart else 3], summed(sizes)

    def part(start: int) -> RowSpace:
        some = slice(start, start + CHUNK)
        return _colours_of(rows[some].double(), slopes[some].double(), sizes[some].double(), TOLERANCE[like.dtype])

    return _joined([part(start) for start in range(0, n, CHUNK)], like.dtype)


def _colours_of(
    rows: Float[Tensor, "n m _"], slopes: Float[Tensor, "n s d"], sizes: Float[Tensor, " n"], tolerance: float
) -> RowSpace:
    """Of some Gaussians: the harmonics of each channel, and what the slopes add to them."""
    harmonics, visible = rows[:, :, :-3], rows[:, :, -3:]
    channels = [_row_space(harmonics * visible[:, :, c, None], tolerance) for c in range(3)]
    added = _spanned(_across(channels, slopes), sizes, tolerance)
    for _ in range(2):  # what rounding leaves of the harmonics goes in the second go
        added = _orthonormal(_across(channels, added.basis), added.rank)
    bases = [added.basis]
    for c, space in enumerate(channels):
        wide = slopes.new_zeros(*space.basis.shape[:2], slopes.shape[2])
        wide[:, :, c::3] = space.basis
        bases.append(wide)
    basis = torch.cat(bases, dim=1)
    padding = (basis == 0).all(dim=2).int()
    order, rank = padding.argsort(dim=1, stable=True), basis.shape[1] - padding.sum(dim=1)
    return RowSpace(basis.gather(1, order[:, : int(rank.max()), None].expand(-1, -1, basis.shape[2])), rank)


def _across(channels: Sequence[RowSpace], rows: Float[Tensor, "n r d"]) -> Float[Tensor, "n r d"]:
    """The part of rows at right angles to the channels' spaces."""
    kept = [space.project(rows[:, :, c::3].mT).mT for c, space in enumerate(channels)]
    return rows - torch.stack(kept, dim=3).flatten(2)


def seen_parameters(views: Sequence[ProjectionJacobian], n: int, bands: int, stacked: Stacked = _alone) -> RowSpace:
    """The directions of a Gaussian's parameters (mean, log-scales, quaternion, logit, SH) that Gauss-Newton sees."""
    dtype = _like(views).dtype
    parts = [
        _row_space(stacked(_jacobian_rows(views, start, min(start + CHUNK, n), bands)), TOLERANCE[dtype])
        for start in range(0, n, CHUNK)
    ]
    return _joined(parts, dtype)


def _joined(parts: Sequence[RowSpace], dtype: torch.dtype) -> RowSpace:
    """Those of all Gaussians, given those of some at a time."""
    width = max(part.basis.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.basis.to(dtype), (0, 0, 0, width - part.basis.shape[1])) for part in parts]
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
        opacity = torch.as_tensor(held.opacity_slope)[here].double()
        slope, visible = (torch.as_tensor(part)[here].double() for part in (held.colour_slope, held.visible))
        rows[i, at : at + 5, :GEOMETRY] = geometry
        rows[i, at + 5, GEOMETRY] = 1.0  # a logit counts as seen however flat the sigmoid is
        if opacity.shape[1]:
            rows[i, at + 5, :GEOMETRY] = opacity
            rows[i, at + 5, GEOMETRY] = torch.as_tensor(held.logit_slope)[here].double()
        for c in range(3):
            first = GEOMETRY + 1 + c
            rows[i, at + 6 + c, :3] = visible[:, c, None] * slope[:, c]
            rows[i, at + 6 + c, first : first + 3 * bands - c : 3] = visible[:, c, None] * harmonic
    return rows


def _row_space(rows: Float[Tensor, "n r d"], tolerance: float) -> RowSpace:
    """An orthonormal basis of each Gaussian's rows, whatever their lengths."""
    return _spanned(rows / rows.norm(dim=2, keepdim=True).clamp_min(torch.finfo(rows.dtype).tiny), None, tolerance)


def _spanned(rows: Float[Tensor, "n r d"], sizes: Float[Tensor, " n"] | None, tolerance: float) -> RowSpace:
    """The leading right singular vectors: of values above tolerance of sizes, by default of the largest."""
    values, basis = _singular(rows)
    kept = (values > tolerance * (values[:, :1] if sizes is None else sizes[:, None])) & (values > 0)
    rank = kept.sum(dim=1)
    return RowSpace(torch.where(kept[:, :, None], basis, 0.0)[:, : int(rank.max())], rank)


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
