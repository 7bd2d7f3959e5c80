"""Row space of the Hessian in the SH coefficients of each Gaussian; `active_spaces.py` has the formulas.

It is spanned by the harmonics Y(d_m) of the views m, for each channel that m does not clamp, and by at most three slopes
sum_m a_mc dY(d_m)/dmu_j, vectors over all channels.  Mostly no channel is clamped, and the three channels share a basis.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splat.backend.cpu.threads import over_range
from splat.curvature.null.colour_space_cpu import project_colours
from splat.curvature.null.row_space import TOLERANCE, RowSpace, joined, orthonormal, row_space, spanned
from splat.model.gaussians import Gaussians
from splat.projection.formulas import ProjectionJacobian
from splat.render.backend import CPU, backend_of

AT_ONCE = 65536  # Gaussians whose rows are taken in float64


@dataclass(frozen=True, eq=False)
class ColourSpace:
    """A space of SH coefficients for each Gaussian, laid out like `Gaussians.sh`: d = bands x 3 channels.

    harmonics: spaces of one channel's coefficients.  row: index of each channel's space in it.  slopes: directions over all
    channels, orthogonal to the harmonics.
    """

    harmonics: RowSpace
    row: Int[Tensor, "n 3"]
    slopes: RowSpace

    @property
    def rank(self) -> Int[Tensor, " n"]:
        return self.harmonics.rank[self.row].sum(dim=1) + self.slopes.rank

    def project(self, x: Float[Tensor, "n d k"]) -> Float[Tensor, "n d k"]:
        """Orthogonal projection of x onto the space."""
        return self._by_kernel(x) if backend_of(x) is CPU else self._by_products(x)

    def _by_kernel(self, x: Float[Tensor, "n d k"]) -> Float[Tensor, "n d k"]:
        (n, d, k), bands = x.shape, self.harmonics.basis.shape[2]
        x, slopes = x.reshape(n, bands, 3 * k), self.slopes.basis.unflatten(2, (bands, 3))
        out = torch.empty_like(x)
        spaces = self.harmonics.basis, self.harmonics.rank, self.row, slopes, self.slopes.rank
        over_range(n, project_colours, *(each.numpy() for each in (*spaces, x, out)))
        return out.view(n, d, k)

    def _by_products(self, x: Float[Tensor, "n d k"]) -> Float[Tensor, "n d k"]:
        kept = [space.project(x[:, c::3]) for c, space in enumerate(self._channels)]
        slopes = self.slopes.basis
        return torch.stack(kept, dim=2).view(x.shape) + slopes.mT @ (slopes @ x)

    def without(self, rows: Float[Tensor, "n r d"]) -> Float[Tensor, "n r d"]:
        """The components of rows orthogonal to the space."""
        return rows - self.project(rows.mT.contiguous()).mT

    def scaled(self, scale: Float[Tensor, "n d"]) -> RowSpace:
        """The space of all D x with x in this space, D = diag(scale) > 0."""
        bases = [self.slopes.basis]
        for c, space in enumerate(self._channels):
            wide = scale.new_zeros(*space.basis.shape[:2], scale.shape[1])
            wide[:, :, c::3] = space.basis
            bases.append(wide)
        basis = torch.cat(bases, dim=1)
        order = (basis == 0).all(dim=2).int().argsort(dim=1, stable=True)  # padding last
        rows = basis.gather(1, order[:, : int(self.rank.max()), None].expand(-1, -1, basis.shape[2]))
        return RowSpace(rows, self.rank).scaled(scale)

    @cached_property
    def _channels(self) -> list[RowSpace]:
        return [RowSpace(self.harmonics.basis[row], self.harmonics.rank[row]) for row in self.row.T]

    def to(self, dtype: torch.dtype) -> "ColourSpace":
        return ColourSpace(self.harmonics.to(dtype), self.row, self.slopes.to(dtype))


def seen_colours(
    views: Iterable[ProjectionJacobian], count: int, gaussians: Gaussians, *, slopes: bool = True
) -> ColourSpace:
    """The directions of each Gaussian's SH coefficients in which the Hessian can be non-zero.

    count: number of views.  slopes: False for the Hessian's block of SH alone, which has none.
    """
    like, (n, bands) = gaussians.flat, gaussians.sh.shape[:2]
    rows = like.new_zeros(n, count, bands + 3)  # harmonics, and which channels are not clamped
    sums, sizes = like.new_zeros(n, 3, 3 * bands), like.new_zeros(n)  # slopes, and the sum of the norms of their terms
    for m, view in enumerate(views):
        index, visible = torch.as_tensor(view.index), torch.as_tensor(view.visible)
        harmonic, slope, bar = (torch.as_tensor(part) for part in (view.harmonic, view.slope, view.colour_bar))
        rows[index, m] = torch.cat([harmonic[:, :bands], visible], dim=1)
        terms = torch.einsum("ekj,ec->ejkc", slope[:, :bands], bar).flatten(2)
        sums.index_add_(0, index, terms)
        sizes.index_add_(0, index, terms.flatten(1).norm(dim=1))
    sums, sizes = sums[:, : 3 if slopes else 0] / count, sizes / count
    chunks, tolerance = zip(*(x.split(AT_ONCE) for x in (rows, sums, sizes)), strict=True), TOLERANCE[like.dtype]
    return _joined([_colours_of(r.double(), s.double(), a.double(), tolerance).to(like.dtype) for r, s, a in chunks])


def _colours_of(
    rows: Float[Tensor, "n m _"], slopes: Float[Tensor, "n s d"], sizes: Float[Tensor, " n"], tolerance: float
) -> ColourSpace:
    """The spaces of some Gaussians.  rows: harmonics, and which channels are not clamped; sizes: see `spanned`.

    Harmonic spaces: one for channel 0 of every Gaussian; others for channels 1 and 2 where not the same views clamp
    them.
    """
    (harmonics, visible), n = rows.split([rows.shape[2] - 3, 3], dim=2), len(rows)
    everyone = torch.arange(n, device=rows.device)
    row, weights, gaussian = everyone[:, None].repeat(1, 3), [visible[:, :, 0]], [everyone]
    for c in (1, 2):
        other = torch.nonzero((visible[:, :, c] != visible[:, :, 0]).any(dim=1))[:, 0]
        row[other, c] = sum(map(len, gaussian)) + torch.arange(len(other), device=rows.device)
        gaussian.append(other)
        weights.append(visible[other, :, c])
    spaces = row_space(harmonics[torch.cat(gaussian)] * torch.cat(weights)[:, :, None], tolerance)
    # where harmonics span all coefficients of each channel, slopes add nothing
    some = torch.nonzero((spaces.rank[row] < harmonics.shape[2]).any(dim=1))[:, 0]
    colours = ColourSpace(spaces, row[some], RowSpace(slopes[some, :0], row.new_zeros(len(some))))
    added = spanned(colours.without(slopes[some]), sizes[some], tolerance)
    for _ in range(2):  # the second time removes what rounding left of the harmonics
        added = orthonormal(colours.without(added.basis), added.rank)
    basis = slopes.new_zeros(n, *added.basis.shape[1:]).index_copy(0, some, added.basis)
    return ColourSpace(spaces, row, RowSpace(basis, row.new_zeros(n).index_copy(0, some, added.rank)))


def _joined(parts: Sequence[ColourSpace]) -> ColourSpace:
    """The space of all Gaussians, from those of consecutive ones."""
    rows, before = [], 0
    for part in parts:
        rows.append(part.row + before)
        before += len(part.harmonics.rank)
    harmonics, slopes = ([getattr(part, name) for part in parts] for name in ("harmonics", "slopes"))
    return ColourSpace(joined(harmonics), torch.cat(rows), joined(slopes))
