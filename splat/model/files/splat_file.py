"""Gaussians of a file that another tool wrote, in this project's own parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from landscape.errors import InputError
from splat.model.gaussians import Gaussians

DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}


@dataclass(frozen=True, eq=False)
class SplatFile:
    """Gaussians (float32) and what their file says beside them.

    format: in words.  tool: who trained them, a name of `splat.training.origin.presets`; None where the file does not say.
    step: training steps.  antialiased: whether the renderer scaled opacities by the blur.  lossy: whether they were rounded
    to a few bits.  extra: further numbers of each Gaussian, by name.  settings: of the tool, by its names.  train: names of
    the images that it trained on, width: of the widest of them, px, where the file says them.  notes: sentences on what was
    changed or is unsure.  other_axes: the same Gaussians with y and z turned round, where writers of the format differ in
    that.
    """

    gaussians: Gaussians
    format: str
    tool: str | None = None
    step: int | None = None
    antialiased: bool = False
    lossy: bool = False
    extra: Mapping[str, Float[np.ndarray, " n"]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    train: tuple[str, ...] = ()
    width: int | None = None
    notes: tuple[str, ...] = ()
    other_axes: Gaussians | None = None


def names_of(found: object) -> tuple[str, ...]:
    """Names of images as a file lists them; none where it is no list of words."""
    return tuple(found) if isinstance(found, list) and all(isinstance(name, str) for name in found) else ()


def packed(attributes: Mapping[str, np.ndarray], filter_widths: np.ndarray | None = None) -> Gaussians:
    """Gaussians from the five attributes, `sh` with all bands, and the widths of their 3-D filter.

    InputError where their shapes or the SH degree cannot be.  Numbers that are not finite are found by `require_finite`.
    """
    sh, n = attributes["sh"], len(attributes["means"])
    if n == 0:
        raise InputError("it holds no Gaussian")
    bands = sh.shape[1] if sh.ndim == 3 else 0
    if bands not in DEGREES:
        raise InputError(
            f"it has {bands} harmonics a colour{', degree 4' if bands == 25 else ''}; this program renders 1, 4, 9 or "
            "16 (degree 0 to 3): train or export it with a lower degree"
        )
    tensors = {name: torch.from_numpy(np.array(value, dtype=np.float32)) for name, value in attributes.items()}
    try:
        gaussians = Gaussians.pack(tensors)
    except ValueError as error:
        raise InputError(f"its attributes do not fit together: {error}") from error
    if filter_widths is not None:
        gaussians = gaussians.with_filter(torch.from_numpy(filter_widths))
    gaussians.require_finite()
    return gaussians


def logit(opacity: np.ndarray) -> tuple[np.ndarray, int]:
    """Logits of opacities in [0, 1], and how many of these were 0 or 1 and were moved inside by half of 1/255."""
    inside = np.clip(opacity, 0.5 / 255, 1 - 0.5 / 255)
    inside = np.where((opacity > 0) & (opacity < 1), opacity, inside)
    return np.log(inside / (1 - inside)), int(((opacity <= 0) | (opacity >= 1)).sum())


def finite_logits(logits: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Logits with those of the opacities 0 and 1, which are infinite, moved inside as `logit` does; and a note on them."""
    ends, _ = logit(np.array([0.0, 1.0]))
    count = int(np.isinf(logits).sum())
    note = f"{count} opacities of 0 or 1, whose logits are infinite, were moved inside by half of 1/255"
    return np.where(np.isinf(logits), np.where(logits > 0, ends[1], ends[0]), logits), (note,) if count else ()


def clamped_note(count: int) -> tuple[str, ...]:
    """Note on byte opacities 0 and 255, whose logits would be infinite."""
    return (f"{count} opacities of 0 or 255 were moved to 0.5 or 254.5",) if count else ()
