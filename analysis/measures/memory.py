"""Limits by memory: how many vectors fit; and, before anything is measured, whether a probe or a slice does."""

import re
from math import ceil

from landscape import EigenSettings
from landscape.errors import InputError, TooLittleMemory
from splat.backend.memory import SLACK, free_memory, is_told, resident_memory
from splat.curvature.linearize import LinearizedView
from splat.curvature.objective import SceneObjective
from splat.render.forward import rasterize_view

GEOMETRY_BLOCK = 11 * 11  # numbers of a Gaussian's block without SH
KEPT_BLOCKS = 3  # sets of blocks: exact ones, approximate ones, and these of the Gauss-Newton part
COPIES = 5  # of a vector in a product: the argument, its projection, the sum over views, a view's product, the result
BASIS, BATCH = 8, 4  # vectors of the smallest basis of an eigensolver, and in its products
GIB = 2**30


def vectors_within(objective: SceneObjective, memory: float) -> int:
    """Number of vectors of the active parameters that fit into so many GiB, and into half of the free memory."""
    flat = objective.active.flat
    return int(min(memory * GIB, free_memory(flat.device) / 2) // flat.nbytes)


def basis_within(eigen: EigenSettings, room: int) -> int:
    """Number of vectors that the search for the ends may keep where there is room for so many; at least what it needs."""
    return min(eigen.basis, max(eigen.wanted + 3 * eigen.block, room))


def size_of(text: str | None) -> int | None:
    """Bytes from a size in words; None of None.  InputError where it is none.

    >>> size_of("8GB"), size_of("1.5 GiB"), size_of("500mb")
    (8000000000, 1610612736, 500000000)
    """
    if text is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kmgt])(i?)b", text.strip(), re.I)
    if not match:
        raise InputError(f"expected a size of memory such as 8GB or 500MB, got {text!r}")
    unit = 1024 if match[3] else 1000
    return int(float(match[1]) * unit ** (1 + "kmgt".index(match[2].lower())))


def needs_of(objective: SceneObjective) -> tuple[int, int]:
    """Estimated bytes of the largest linearised view, and beside the views: of the Gaussians' blocks, a small basis, and a
    product or the pass that computes the blocks.  Renders every view."""
    active, settings = objective.active, objective.settings
    cameras, background = (view.camera for view in objective.views), objective.background
    rasters = (rasterize_view(active, camera, background, settings, finite=True) for camera in cameras)
    view, workspace, sums = max(LinearizedView.size_of(raster, active, settings) for raster in rasters)
    blocks = len(active) * active.flat.element_size() * (GEOMETRY_BLOCK + 3 * (active.sh_degree + 1) ** 2)
    product, making_blocks = workspace + COPIES * active.flat.nbytes, max(sums + blocks, 3 * blocks)
    return view, KEPT_BLOCKS * blocks + BASIS * active.flat.nbytes + max(BATCH * product, making_blocks)


def expected_peak(objective: SceneObjective) -> int:
    """About the most that a probe takes at a time, bytes; sets how much of it the linearised views may have.

    TooLittleMemory that says what would fit, where less is free.
    """
    (view, beside), device = needs_of(objective), objective.active.flat.device
    free, used = free_memory(device), resident_memory() if device.type == "cpu" else 0
    least, camera = view + beside, objective.views[0].camera
    if least > free:
        fit = int(len(objective.active) * free / least)
        told = f"--memory {ceil((used + least) / (1 - SLACK) / 1e7) / 100:g}GB"
        enough = told if is_told() else f"{_size(least - free)} more"
        raise TooLittleMemory(
            f"expected at least {_size(used + least)} of memory for {len(objective.active):,} Gaussians in sight of views of "
            f"{camera.width} x {camera.height} px, got {_size(used + free)}, {_size(used)} of them taken; "
            f"{enough} would fit{f', or about {fit:,} such Gaussians' if fit else ''}"
        )
    objective.memory = min(free // 2, max(free - beside, view))
    return used + min(free, len(objective.views) * view + beside)


def _size(size: float) -> str:
    """Bytes in words, to three digits.

    >>> _size(0), _size(1234), _size(2.5e9)
    ('0 kB', '1.23 kB', '2.5 GB')
    """
    unit, name = next(((each, name) for each, name in ((1e9, "GB"), (1e6, "MB")) if size >= 0.9995 * each), (1e3, "kB"))
    return f"{size / unit:.3g} {name}"
