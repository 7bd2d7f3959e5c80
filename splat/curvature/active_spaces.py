"""What the exact null space of a scene's Hessian leaves, of all attributes together and of each: for
`landscape.spectrum.families`.

Exactly null (`null_space.py`): the lengths of the quaternions, SH directions that no view sees and,
of Gauss-Newton as a whole, all that no view sees.  In another metric (`metrics.py`) the operator is D P H P D, and what is not
null is the space of all D P x.
"""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from landscape.spectrum.density import ActiveSpace
from landscape.spectrum.families import WHOLE
from splat.curvature.hessian import SceneHessian


def active_spaces(hessian: SceneHessian, scale: Float[Tensor, " p"] | None = None) -> dict[str, ActiveSpace]:
    """What the exact null space leaves of the whole and of each attribute.  hessian: exact, or its Gauss-Newton part.

    scale: D, above 0; 1 by default.  Gauss-Newton's attributes are given the spaces of the Hessian's: they may be flat along
    more.
    """
    if hessian.keep_null:
        return {}
    exact = SceneHessian(hessian.objective) if hessian.gauss_newton else hessian
    whole, each = (h.project if scale is None else h.scaled_projector(scale) for h in (hessian, exact))
    return {WHOLE: ActiveSpace(whole, hessian.rank), **_of_attributes(exact, each)}


def _of_attributes(hessian: SceneHessian, project: Callable[[Tensor], Tensor]) -> dict[str, ActiveSpace]:
    """The Hessian's projector acts on each attribute by itself, and leaves 3 of a quaternion's 4 rows."""
    count = len(hessian.objective.active)
    ranks = {name: rows.stop - rows.start for name, rows in hessian.blocks.items()}
    ranks["quats"] -= count
    ranks["sh"] = hessian.rank - sum(rank for name, rank in ranks.items() if name != "sh")
    return {name: ActiveSpace(_within(hessian, name, project), rank) for name, rank in ranks.items() if rank}


def _within(hessian: SceneHessian, name: str, project: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    rows = hessian.blocks[name]

    def within(V: Tensor) -> Tensor:
        padded = V.new_zeros(hessian.dim, V.shape[1])
        padded[rows] = V
        return project(padded)[rows]

    return within
