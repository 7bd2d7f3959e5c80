"""Orthogonal projectors P onto the complement of the directions in which a scene's loss is exactly flat (`null_space.py`).

    Hessian             P removes the lengths of the quaternions, and the SH directions that no view sees
    Gauss-Newton        P removes all directions that no view sees
    one attribute       of the Hessian's block of SH, P also removes the directions whose only curvature is with the mean

In other units (`analysis/measures/units.py`) the operator is D P H P D, D = diag(scale), and the projector is the orthogonal
one onto all D P x.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.spectrum.block_anisotropy import WHOLE
from landscape.spectrum.density import ActiveSpace
from splat.curvature.null.colour_space import ColourSpace, seen_colours
from splat.curvature.null.null_space import seen_parameters
from splat.curvature.null.row_space import RowSpace
from splat.curvature.objective import SceneObjective


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
