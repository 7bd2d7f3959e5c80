"""Interpolation of a function over a plane from both axes through its centre, its Hessian there, and scattered points.

    f(x, y) = f(x, 0) + f(0, y) - f(0, 0) + x y (a + r(x, y)),      r(0, 0) = 0

Both axes are known at every coordinate, so that nothing is interpolated there.  a = d2f/dxdy at the centre; with it value,
gradient and Hessian at the centre are those of f, whatever r is.  A smooth f has a smooth r, known wherever f is known off the
axes; between these places r is the cubic spline sum_i c_i |p - p_i|^3 with a linear part (Duchon 1977).  Where a is not known,
r(0, 0) is left free.

The error of the interpolant is judged by its predictions at n points drawn at random from those that it does not know:

    seen      the largest error among them
    bound     of the error at each of m other points.  The k errors beyond the quantile u at 15/16 are taken as exponential.
              Of these, with a sum S of their excesses, a further one exceeds u + z with probability (1 + z / S)^-k, so that all
              m stay below it with confidence 1 - c where z = S ((m / 16 c)^(1/k) - 1); at least what was seen.  A larger share
              would not be the tail of a loss that jumps at a few places
"""

from math import inf

import numpy as np
import scipy

CONFIDENCE = 0.95
TAIL = 1 / 16  # share of the errors that the tail is fitted to
FEWEST_NODES = 4  # of a spline
DIGITS = 9  # of distances: points that are as far but for round-off are taken in the order of their numbers


class PlaneInterpolant:
    """The interpolant on a grid x times y that has 0 in both.  Points are numbered as in the flattened grid.

    mixed: a.  through_axes: False for the spline of f itself, through all known points.  required: both axes; then the centre.

    >>> x = np.linspace(-1, 1, 9)
    >>> grid, f = PlaneInterpolant(x, x, mixed=0.5), (x[:, None] ** 2 + x * x[:, None] * (0.5 + x)).ravel()
    >>> known = np.isin(np.arange(81), grid.required)
    >>> known[grid.farthest(known, 16)] = True
    >>> int(known.sum()), float(abs(grid(np.where(known, f, np.nan)) - f).max()) < 1e-14
    (33, True)
    """

    def __init__(self, x: np.ndarray, y: np.ndarray, mixed: float | None = None, through_axes: bool = True):
        self._x, self._y, self._mixed, self._through_axes = x, y, mixed, through_axes
        self._i, self._j = i, j = [int(np.flatnonzero(axis == 0)[0]) for axis in (x, y)]
        number = np.arange(len(x) * len(y)).reshape(len(x), len(y))
        self.required = np.unique(np.r_[number[:, j], number[i]]) if through_axes else number[[i], j]
        places = np.meshgrid(*(axis / np.abs(axis).max() for axis in (x, y)), indexing="ij")
        self._places = np.stack(places, axis=-1).reshape(-1, 2)

    def farthest(self, known: np.ndarray, count: int) -> np.ndarray:
        """Points that are each as far as can be from the known ones and from those before it; known: [points], not empty.

        From the axes alone: the corners, then the middles of the quarters, ...
        """
        distances, found = scipy.spatial.distance.cdist(self._places, self._places[known]).min(axis=1), []
        for _ in range(min(count, int((~known).sum()))):
            found.append(int(distances.round(DIGITS).argmax()))
            step = np.hypot(*(self._places - self._places[found[-1]]).T)
            distances = np.minimum(distances, step)
        return np.array(found, int)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Interpolation at all points, from values [points], nan where not known.  nan where the axes have no finite value."""
        f = values.reshape(len(self._x), len(self._y))
        if not self._through_axes:
            return self._spline(f, np.isfinite(f)).ravel()
        along = f[:, [self._j]] + f[[self._i]] - f[self._i, self._j]
        products = np.outer(self._x, self._y)
        with np.errstate(divide="ignore", invalid="ignore"):
            r = (f - along) / products - (self._mixed or 0.0)
        known = np.isfinite(r)
        known[self._i, :] = known[:, self._j] = False  # 0 / 0
        if self._mixed is not None:
            r[self._i, self._j], known[self._i, self._j] = 0.0, True
        return (along + products * ((self._mixed or 0.0) + self._spline(r, known))).ravel()

    def _spline(self, r: np.ndarray, known: np.ndarray) -> np.ndarray:
        """r everywhere, from where it is known; 0 where that is nowhere."""
        if known.sum() < FEWEST_NODES:
            return np.zeros_like(r)
        spline = scipy.interpolate.RBFInterpolator(self._places[known.ravel()], r[known], kernel="cubic")
        return spline(self._places).reshape(r.shape)


def error_bound(errors: np.ndarray, others: int, looks: int) -> float:
    """Bound of the error at every one of so many other points, from the errors at random ones; infinite without any.

    >>> round(error_bound(np.linspace(0, 1, 64), others=1000, looks=1), 1)
    1.9
    """
    if not others:
        return 0.0
    if not errors.size or not np.isfinite(errors).all():
        return inf
    threshold = float(np.quantile(errors, 1 - TAIL))
    excess = errors[errors > threshold] - threshold
    if not excess.size:
        return float(errors.max())
    chance = (1 - CONFIDENCE) / 2**looks  # several looks have more chances to be lucky
    rarer = max(TAIL * others / chance, 1.0) ** (1 / excess.size) - 1
    return max(threshold + float(excess.sum()) * rarer, float(errors.max()))
