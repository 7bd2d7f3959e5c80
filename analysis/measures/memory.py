"""What fits into memory: how many vectors; and, where it ran out, what a probe or a slice takes and what would fit."""

from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, sqrt

from landscape import EigenSettings
from landscape.errors import lacks_memory
from splat.backend.memory import free_memory
from splat.curvature.linearize import VECTORS, KeptViews
from splat.curvature.objective import SceneObjective

MIB, GIB = 2**20, 2**30
FEWEST = 12  # vectors: four start vectors of a product, what it makes of them and a small basis


def vectors_within(objective: SceneObjective, memory: float) -> int:
    """Number of vectors of the active parameters that fit into so many GiB, and into half of what is free there."""
    flat = objective.active.flat
    return int(min(memory * GIB, free_memory(flat.device) / 2) // flat.nbytes)


def basis_within(eigen: EigenSettings, room: int) -> int:
    """Number of vectors that the search for the ends may keep where there is room for so many; at least what it needs."""
    return min(eigen.basis, max(eigen.wanted + 3 * eigen.block, room))


@contextmanager
def telling_needs(objective: SceneObjective) -> Iterator[None]:
    """Where memory runs out, MemoryError that says what products with the Hessian take, what was free, and what would fit."""
    free = free_memory(objective.active.flat.device)
    try:
        yield
    except Exception as error:
        if not lacks_memory(error):
            raise
        raise MemoryError(_needs(objective, vars(objective).get("linearized"), free)) from error


def _needs(objective: SceneObjective, kept: KeptViews | None, free: int) -> str:
    """kept: None where not even the first view could be linearised."""
    camera, flat = objective.views[0].camera, objective.active.flat
    pictures = f"a view of {camera.width} x {camera.height} px with {len(objective.active):,} Gaussians in sight"
    if kept is None:
        return f"{pictures} takes more than the {free / MIB:,.0f} MiB that were free"
    vectors = FEWEST * flat.nbytes
    pixels = kept.first.bytes + kept.workspace(VECTORS)
    said = (
        f"products of {pictures} take {pixels / MIB:,.0f} MiB, {FEWEST} vectors of {flat.numel():,} parameters "
        f"{vectors / MIB:,.0f} MiB, and {free / MIB:,.0f} MiB were free; "
    )
    if vectors > free / 2:
        return said + f"about {int(len(objective.active) * free / 2 / vectors):,} Gaussians would fit"
    factor = max(2, ceil(sqrt(2 * pixels / free)))
    return (
        said + f"pictures of {camera.width // factor} x {camera.height // factor} px would fit (--downscale {factor})"
    )
