"""Orthogonal projectors P onto the complement of the directions in which a scene's loss is exactly flat.

    Hessian             P removes the lengths of the quaternions, and the SH directions that no view sees
    Gauss-Newton        P removes all directions that no view sees
    one attribute       of the Hessian's block of SH, P also removes the directions whose only curvature is with the mean

In other units (`analysis/measures/units.py`) the operator is D P H P D, D = diag(scale), and the projector is the orthogonal
one onto all D P x.

A Gaussian enters a view only through its splat of nine numbers, so over M views Gauss-Newton sees at most
min(9 M, 10 + 3 min(M, k)) of its 11 + 3 k parameters (k SH coefficients a channel): with SH degree 3 and three views a third of
the spectrum is structural zeros.  It sees the row space of the stacked Jacobians of the Gaussian's projections.

The Hessian sees all geometry; the lengths of the quaternions are excluded by choice (`SceneHessian`).  It sees SH coefficients
f through colours alone.  With d_m the direction from view m to the mean mu, Y the harmonics, a_mc the loss's derivative in the
colour, and x any parameter,

    colour_mc      = sum_k f_kc Y_k(d_m) + 1/2
    d2L / df_kc dx = sum_m Y_k(d_m) da_mc/dx + sum_m a_mc dY_k(d_m)/dx

where a_mc = 0 if view m clamps channel c.  So it sees Y(d_m) of every view that draws the Gaussian and does not clamp the
channel and, over the channels together, three slopes sum_m a_mc dY_k(d_m)/dmu_j.  Slopes couple SH to the mean only: the block
of SH is flat along their components orthogonal to the harmonics.

Numerical ranks (`row_space.py`): rows are scaled to unit length; slopes, which can cancel, are compared with the sum of the
norms of their terms.  The Hessian's space of SH coefficients is in `colour_space.py`, Gauss-Newton's of all parameters here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.spectrum.block_anisotropy import WHOLE
from landscape.spectrum.density import ActiveSpace
from splat.curvature.null.colour_space import ColourSpace, seen_colours
from splat.curvature.null.row_space import CHUNK, TOLERANCE, RowSpace, joined, row_space
from splat.curvature.objective import SceneObjective
from splat.projection.formulas import GEOMETRY, ProjectionJacobian


@dataclass(frozen=True, eq=False)
class Projector:
    """An orthogonal projector P that acts on the parameters of each Gaussian separately.

    blocks: rows of the attributes.  radial: None, or unit quaternions, which P removes; it keeps other geometry and opacity.
    seen: range of P in a Gaussian's SH where `radial` is given, else in all its parameters, in the order of the attributes.
    """

    blocks: Mapping[str, slice]
    seen: RowSpace | ColourSpace
    radial: Float[Tensor, "n 4"] | None = None

    @property
    def rank(self) -> int:
        """The dimension of the range of P."""
        geometry = 0 if self.radial is None else 10 * len(self.radial)  # mean 3, log-scales 3, quaternion 3, logit 1
        return geometry + int(self.seen.rank.sum())

    def apply(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """P V."""
        n, K = len(self.seen.rank), V.shape[1]
        if self.radial is None:
            parts = [V[rows].reshape(n, -1, K) for rows in self.blocks.values()]
            kept = self.seen.project(torch.cat(parts, dim=1)).split([part.shape[1] for part in parts], dim=1)
            return torch.cat([part.reshape(-1, K) for part in kept])
        V = self.without_lengths(V)
        colours = V[self.blocks["sh"]]
        colours.copy_(self.seen.project(colours.view(n, -1, K)).view(-1, K))
        return V

    def without_lengths(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """V without its components along `radial`; V itself where there is none.

        H maps this and P V to the same: H is zero along all other directions that P removes.
        """
        return V if self.radial is None else without_lengths(V, self.radial, self.blocks["quats"])

    def scaled(self, scale: Float[Tensor, " p"]) -> "Projector":
        """The orthogonal projector onto all D P x, D = diag(scale) > 0."""
        parts = {name: scale[rows].view(len(self.seen.rank), -1) for name, rows in self.blocks.items()}
        if self.radial is None:
            return Projector(self.blocks, self.seen.scaled(torch.cat([*parts.values()], dim=1)))
        radial = torch.nn.functional.normalize(self.radial / parts["quats"], dim=1)
        return Projector(self.blocks, self.seen.scaled(parts["sh"]), radial)


def without_lengths(V: Float[Tensor, "p k"], quats: Float[Tensor, "n 4"], rows: slice) -> Float[Tensor, "p k"]:
    """V without its components along unit quaternions, of these rows: a quaternion's length changes no image."""
    V, q = V.clone(), quats[:, :, None]
    turns = V[rows].view(len(q), 4, -1)
    turns -= q * (q * turns).sum(dim=1, keepdim=True)
    return V


def projector_of(objective: SceneObjective, *, gauss_newton: bool = False, single: bool = False) -> Projector:
    """P of the Hessian, or of its Gauss-Newton part.  single: of the Hessian's blocks of single attributes."""
    active = objective.active
    if gauss_newton:
        n, bands = active.sh.shape[:2]
        views = [view.jacobian for view in objective.linearized]
        return Projector(objective.blocks, seen_parameters(views, n, bands))
    views = (view.jacobian for view in objective.linearized)
    colours = seen_colours(views, len(objective.views), active, slopes=not single)
    return Projector(objective.blocks, colours, active.quats)


def active_spaces(
    objective: SceneObjective, projector: Projector, scale: Float[Tensor, " p"] | None = None
) -> dict[str, ActiveSpace]:
    """Complements of the exact null space, of the whole and of each attribute's block, for `landscape.block_anisotropy`.

    projector: of the whole operator (`SceneHessian.projector`).  scale: diagonal of D > 0, 1 by default.  The blocks of
    Gauss-Newton are given the spaces of the Hessian's blocks; they may be flat along more directions.
    """
    blocks = projector_of(objective, single=True)
    whole, each = (P if scale is None else P.scaled(scale) for P in (projector, blocks))
    ranks = {**objective.block_dims, "sh": int(blocks.seen.rank.sum())}
    spaces = {name: ActiveSpace(_within(each, name), rank) for name, rank in ranks.items() if rank}
    return {WHOLE: ActiveSpace(whole.apply, projector.rank), **spaces}


def _within(projector: Projector, name: str) -> Callable[[Tensor], Tensor]:
    """A projector's action on one attribute's rows; the projector must not mix attributes."""
    rows, count = projector.blocks[name], max(rows.stop for rows in projector.blocks.values())

    def within(V: Tensor) -> Tensor:
        padded = V.new_zeros(count, V.shape[1])
        padded[rows] = V
        return projector.apply(padded)[rows]

    return within


def seen_parameters(views: Sequence[ProjectionJacobian], n: int, bands: int) -> RowSpace:
    """The directions of each of n Gaussians' parameters (mean, log-scales, quaternion, logit, SH) that Gauss-Newton sees."""
    dtype = _like(views).dtype
    parts = [
        row_space(_jacobian_rows(views, start, min(start + CHUNK, n), bands), TOLERANCE[dtype]).to(dtype)
        for start in range(0, n, CHUNK)
    ]
    return joined(parts)


def _like(views: Sequence[ProjectionJacobian]) -> Tensor:
    """An empty tensor with the views' dtype and device."""
    return torch.as_tensor(views[0].jacobian[:0])


def _jacobian_rows(views: Sequence[ProjectionJacobian], start: int, stop: int, bands: int) -> Float[Tensor, "n r d"]:
    """The stacked Jacobians of Gaussians start .. stop: nine rows a view, zero where it does not see them."""
    width = GEOMETRY + 1 + 3 * bands
    rows = _like(views).new_zeros(stop - start, 9 * len(views), width, dtype=torch.float64)
    for m, view in enumerate(views):
        index = torch.as_tensor(view.index)
        here = (index >= start) & (index < stop)
        i, at = index[here] - start, 9 * m
        geometry = torch.as_tensor(view.jacobian)[here].double()
        harmonic = torch.as_tensor(view.harmonic)[here, :bands].double()
        opacity = torch.as_tensor(view.opacity_slope)[here].double()
        slope, visible = (torch.as_tensor(part)[here].double() for part in (view.colour_slope, view.visible))
        rows[i, at : at + 5, :GEOMETRY] = geometry
        rows[i, at + 5, GEOMETRY] = 1.0  # a logit counts as seen however flat the sigmoid is
        if opacity.shape[1]:
            rows[i, at + 5, :GEOMETRY] = opacity
            rows[i, at + 5, GEOMETRY] = torch.as_tensor(view.logit_slope)[here].double()
        for c in range(3):
            first = GEOMETRY + 1 + c
            rows[i, at + 6 + c, :3] = visible[:, c, None] * slope[:, c]
            rows[i, at + 6 + c, first : first + 3 * bands - c : 3] = visible[:, c, None] * harmonic
    return rows
