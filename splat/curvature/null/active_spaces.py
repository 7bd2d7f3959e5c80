"""Projectors that leave out the directions in which a scene's loss is exactly flat (`null_space.py`).

    Hessian         left out: the lengths of the quaternions, and SH directions that no view sees
    Gauss-Newton    left out: all directions that no view sees
    one attribute   of the Hessian's block of SH also those left out that couple SH to the mean alone

In other units (`analysis/measures/units.py`) the operator is D P H P D, D = diag(scale), and the projector is the orthogonal
one onto all D P x.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.spectrum.density import ActiveSpace
from landscape.spectrum.families import WHOLE
from splat.curvature.null.colour_space import ColourSpace, seen_colours
from splat.curvature.null.null_space import seen_parameters
from splat.curvature.null.row_space import RowSpace
from splat.curvature.objective import SceneObjective


@dataclass(frozen=True, eq=False)
class Projector:
    """An orthogonal projector P that acts on the parameters of each Gaussian separately.

    blocks: rows of the attributes.  seen: what P keeps, of a Gaussian's SH where `radial` is given, else of all its parameters
    in the order of the attributes.  radial: unit directions that P removes from the quaternions; all other geometry is kept.
    """

    blocks: Mapping[str, slice]
    seen: RowSpace | ColourSpace
    radial: Float[Tensor, "n 4"] | None = None

    @property
    def rank(self) -> int:
        """The dimension of what P keeps."""
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

        H P is H of that alone: along all else that P leaves out, H is zero.
        """
        if self.radial is None:
            return V
        V, radial = V.clone(), self.radial[:, :, None]
        quats = V[self.blocks["quats"]].view(len(radial), 4, -1)
        quats -= radial * (radial * quats).sum(dim=1, keepdim=True)
        return V

    def scaled(self, scale: Float[Tensor, " p"]) -> "Projector":
        """The orthogonal projector onto all D P x, D = diag(scale) > 0."""
        parts = {name: scale[rows].view(len(self.seen.rank), -1) for name, rows in self.blocks.items()}
        if self.radial is None:
            return Projector(self.blocks, self.seen.scaled(torch.cat([*parts.values()], dim=1)))
        radial = torch.nn.functional.normalize(self.radial / parts["quats"], dim=1)
        return Projector(self.blocks, self.seen.scaled(parts["sh"]), radial)


def projector_of(objective: SceneObjective, *, gauss_newton: bool = False, apart: bool = False) -> Projector:
    """P of the Hessian, or of its Gauss-Newton part.  apart: of the Hessian's blocks of single attributes."""
    active = objective.active
    if gauss_newton:
        n, bands = active.sh.shape[:2]
        views = [view.jacobian for view in objective.linearized]
        return Projector(objective.blocks, seen_parameters(views, n, bands, objective.gather_rows))
    views = (view.jacobian for view in objective.linearized)
    complete = objective.gather_rows, objective.mean_over_views
    colours = seen_colours(views, len(objective.views), active, *complete, apart=apart)
    return Projector(objective.blocks, colours, active.quats)


def active_spaces(
    objective: SceneObjective, projector: Projector, scale: Float[Tensor, " p"] | None = None
) -> dict[str, ActiveSpace]:
    """Complements of the exact null space, of the whole operator and of each attribute's block, for `landscape.families`.

    projector: of the whole operator (`SceneHessian.projector`).  scale: D > 0, 1 by default.  The blocks of Gauss-Newton are
    given the spaces of the Hessian's; they may be flat along more.
    """
    apart = projector_of(objective, apart=True)
    whole, each = (P if scale is None else P.scaled(scale) for P in (projector, apart))
    ranks = {name: rows.stop - rows.start for name, rows in objective.blocks.items()}
    ranks["quats"] -= len(objective.active)
    ranks["sh"] = int(apart.seen.rank.sum())
    spaces = {name: ActiveSpace(_within(each, name), rank) for name, rank in ranks.items() if rank}
    return {WHOLE: ActiveSpace(whole.apply, projector.rank), **spaces}


def _within(projector: Projector, name: str) -> Callable[[Tensor], Tensor]:
    """A projector's action on one attribute's rows, none of which it mixes with others."""
    rows, count = projector.blocks[name], max(rows.stop for rows in projector.blocks.values())

    def within(V: Tensor) -> Tensor:
        padded = V.new_zeros(count, V.shape[1])
        padded[rows] = V
        return projector.apply(padded)[rows]

    return within
