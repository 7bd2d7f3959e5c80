"""Depth maps that the user provides, as the depth-supervised methods read them.

    prior       a map that grows with distance: the user's map for "depth", its negative for "disparity" (MiDaS, DPT)
    rendered    the sum of weight times z over the Gaussians of a pixel, world units, not divided by alpha: as published

Monocular depth is known up to a scale and a shift in every view, so both methods compare shapes, not values.
"""

from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from splat.scenes.view import View

DepthKind = Literal["disparity", "depth"]


def require_maps(views: Sequence[View], method: str) -> None:
    """InputError unless every view has a depth map."""
    without = [view.name for view in views if view.depth is None]
    if without:
        raise InputError(
            f"expected a depth map of every training view for the method {method}, got none of {without[0]!r} "
            f"({len(without)} of {len(views)} have none); save it as {PurePosixPath(without[0]).stem}.npy in a folder, and "
            "give that with --depths"
        )


def prior(view: View, kind: DepthKind, like: Tensor) -> Float[Tensor, "h w"]:
    """The view's map in the dtype of another tensor, larger for farther."""
    assert view.depth is not None
    return view.depth.to(like) * (1 if kind == "depth" else -1)
