"""Limits by memory: how many vectors fit; and, before anything is measured, whether a probe or a slice does."""

import re
from collections.abc import Sequence
from math import ceil

import torch

from landscape import EigenSettings
from landscape.errors import InputError, TooLittleMemory
from splat.backend.memory import SLACK, free_memory, is_told, resident_memory
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import Gaussians
from splat.scenes.view import Frame

GIB = 2**30
PICTURES, COPIES = 12, 4  # planes of a view, its loss's included; copies of the Gaussians


def vectors_within(objective: SceneObjective, memory: float) -> int:
    """Number of vectors of the active parameters that fit into so many GiB, and into half of what is free there."""
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


def require_pictures(frames: Sequence[Frame], gaussians: Gaussians) -> None:
    """TooLittleMemory that says what would fit, where pictures and Gaussians alone take more than is free."""
    each = [PICTURES * 4 * frame.camera.width * frame.camera.height for frame in frames]
    fixed, left = COPIES * gaussians.flat.nbytes, free_memory(torch.device("cpu"))
    if fixed + sum(each) <= left:
        return
    some = (left - fixed) // max(each)
    raise TooLittleMemory(
        f"expected {_size(fixed + sum(each))} of memory beside what is taken, for {len(frames)} pictures and "
        f"{len(gaussians):,} Gaussians, got {_size(left)}; "
        + (
            f"--max-views {some} would fit"
            if some > 0
            else f"allow or free at least {_size(fixed + sum(each) - left)} more"
        )
    )


def expected_peak(objective: SceneObjective) -> int:
    """About the most that a probe takes at a time, in bytes.  TooLittleMemory that says what would fit, where less is
    free."""
    needs, device = objective.needs, objective.active.flat.device
    free, used = free_memory(device), resident_memory() if device.type == "cpu" else 0
    least, camera = needs.view + needs.beside, objective.views[0].camera
    if least > free:
        fit = int(len(objective.active) * free / least)
        enough = (
            f"--memory {ceil((used + least) / (1 - SLACK) / 1e7) / 100:g}GB"
            if is_told()
            else f"{_size(least - free)} more"
        )
        raise TooLittleMemory(
            f"expected at least {_size(used + least)} of memory for {len(objective.active):,} Gaussians in sight of views of "
            f"{camera.width} x {camera.height} px, got {_size(used + free)}, of which {_size(used)} are taken; "
            f"{enough} would fit{f', or about {fit:,} such Gaussians' if fit else ''}"
        )
    return used + min(free, len(objective.views) * needs.view + needs.beside)


def _size(size: float) -> str:
    """Bytes in words, to three digits.

    >>> _size(0), _size(1234), _size(2.5e9)
    ('0 kB', '1.23 kB', '2.5 GB')
    """
    unit, name = next(((each, name) for each, name in ((1e9, "GB"), (1e6, "MB")) if size >= 0.9995 * each), (1e3, "kB"))
    return f"{size / unit:.3g} {name}"
