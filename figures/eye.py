"""Where the surface of a plane is seen from: beyond one of its corners, as low as still shows the valley.

A surface is z = h(x, y) over [-1, 1]^2, with h from 0 to 1, nan where there is none.
"""

import itertools
import math

import numpy as np
from jaxtyping import Bool, Float

ASIDE = 0.65  # of the eye: its way along x for one along y
RISES = (0.75, 1.0, 1.4, 2.0)  # of the eye: heights over ways
CLEAR = 0.97  # share of the depth that is seen from high enough
SAME = 0.01  # of a share or a height, of no account


def eye_over(heights: Float[np.ndarray, "n m"], tall: float) -> tuple[float, float, float]:
    """The place of the eye, at a distance of 2, for a surface that is drawn `tall` high.

    Every point counts by its depth below the highest; the lowest has to be seen.
    """
    known = np.isfinite(heights)
    heights, weight = np.where(known, heights, 0.0), np.where(known, 1.0 - heights, 0.0)
    best, eye = -1.0, (0.0, 0.0, 0.0)
    for rise in RISES:
        for x, y in itertools.product((1, -1), (-1, 1)):
            across = np.array([ASIDE * x, y]) / math.hypot(ASIDE, 1)
            seen = ~hidden_points(heights, across, rise / tall)
            lowest = seen[np.unravel_index(weight.argmax(), seen.shape)]
            share = float((weight * seen).sum() / (weight.sum() or 1.0)) - (not lowest)
            if share > best + SAME:
                place = 2 * np.array([*across, rise]) / math.hypot(1, rise)
                best, eye = share, (float(place[0]), float(place[1]), float(place[2]))
        if best > CLEAR:
            break
    return eye


def hidden_points(
    heights: Float[np.ndarray, "n m"], across: Float[np.ndarray, "2"], rise: float
) -> Bool[np.ndarray, "n m"]:
    """Which points of a surface others hide from an eye far away, which is seen under this rise of a way across."""
    size = np.array(heights.shape) - 1
    places, hidden = np.indices(heights.shape).astype(float), np.zeros(heights.shape, bool)
    step = 2 / size.max()
    for k in range(1, int(3 / step)):
        i, j = (
            np.round(place + k * step * part * n / 2).astype(int)
            for place, part, n in zip(places, across, size, strict=True)
        )
        inside = (i >= 0) & (i <= size[0]) & (j >= 0) & (j <= size[1])
        nearer = heights[np.clip(i, 0, size[0]), np.clip(j, 0, size[1])]
        hidden |= inside & (nearer > heights + k * step * rise + SAME)
    return hidden
