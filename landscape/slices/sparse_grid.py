"""Interpolation on an adaptive sparse grid: few points where a function is smooth, many where it is not.

Along one axis the coordinates t form a tree: the middle one is the root, its two children are the ends, then come the middles
of the intervals between neighbours, and so on.  Every node k has a basis function that is 1 at t_k and 0 outside the interval
(l, r) that k divides (Zenger 1991; parabolas: Bungartz 1998):

    phi_k(t) = 1 (the middle),   (t - t_middle) / (t_k - t_middle) (an end),   (t - l) (r - t) / ((t_k - l) (r - t_k))

A node of the plane is a pair (i, j) of nodes; its basis function is the product of theirs, and its parents are (parent of i, j)
and (i, parent of j).  A function is interpolated by

    f ~ sum_k s_k phi_k,      surplus s_k = f(k) - (interpolant of the ancestors of k)(k)

so a surplus is the error of a prediction of f(k) from earlier points.  Parabolas are interpolated exactly.  Where the axes do
not interact, f = g(x) + h(y), every surplus off the two axes is 0: such a function costs two lines of points, not a square.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Hierarchy:
    """The tree over one axis: each node's level (0: the root), parent (-1: none), and basis function on its interval."""

    level: np.ndarray
    parent: np.ndarray
    support: tuple[slice, ...]
    basis: tuple[np.ndarray, ...]

    def ancestry(self, node: int) -> list[int]:
        """The node and all its ancestors."""
        chain = [node]
        while (node := int(self.parent[node])) >= 0:
            chain.append(node)
        return chain


def hierarchy(t: np.ndarray) -> Hierarchy:
    """The tree over increasing coordinates t, of any number and with any spacing.

    >>> hierarchy(np.arange(7.0)).level
    array([1, 2, 3, 0, 2, 3, 1])
    """
    n, middle = len(t), len(t) // 2
    level, parent = np.zeros(n, int), np.full(n, -1)
    support, basis = [slice(0, n)] * n, [np.ones(n)] * n
    intervals = []
    for end in {0, n - 1} - {middle}:
        low, high = sorted((end, middle))
        level[end], parent[end], support[end] = 1, middle, slice(low, high + 1)
        basis[end] = (t[support[end]] - t[middle]) / (t[end] - t[middle])
        intervals.append((low, high, end))
    while intervals:
        low, high, above = intervals.pop()
        if high - low < 2:
            continue
        node = (low + high) // 2
        level[node], parent[node], support[node] = level[above] + 1, above, slice(low, high + 1)
        inside = t[support[node]]
        basis[node] = (inside - t[low]) * (t[high] - inside) / ((t[node] - t[low]) * (t[high] - t[node]))
        intervals += [(low, node, node), (node, high, node)]
    return Hierarchy(level, parent, tuple(support), tuple(basis))


class SparseGrid:
    """The interpolant of a function on the grid x times y, from its values at the nodes inserted so far.

    interpolant [nx, ny]: at every point of the grid.  node [nx, ny]: whether the point is a node.  Methods name a point by its
    index in the flattened grid.

    >>> x = np.linspace(-1, 1, 9)
    >>> grid, f = SparseGrid(x, x), (x[:, None] ** 2 + 3 * x[None, :]).ravel()
    >>> nodes = grid.with_ancestors(grid.coarse())
    >>> grid.insert(nodes, f[nodes])
    >>> int(grid.node.sum()), float(abs(grid.interpolant.ravel() - f).max())
    (21, 0.0)
    """

    def __init__(self, x: np.ndarray, y: np.ndarray):
        self.axes = hierarchy(x), hierarchy(y)
        self.shape = len(x), len(y)
        self.interpolant, self.node = np.zeros(self.shape), np.zeros(self.shape, bool)
        self._surplus = np.zeros(self.shape)

    def coarse(self) -> np.ndarray:
        """The first points: 3 x 3, and 9 along each axis through the middle."""
        x, y = np.meshgrid(*(axis.level for axis in self.axes), indexing="ij")
        return np.flatnonzero((np.maximum(x, y) <= 1) | ((np.minimum(x, y) == 0) & (np.maximum(x, y) <= 3)))

    def with_ancestors(self, points: Iterable[int]) -> np.ndarray:
        """The points and their ancestors, without those that are nodes already; ancestors come first."""
        found: set[tuple[int, int]] = set()
        for point in points:
            i, j = divmod(int(point), self.shape[1])
            found |= {(a, b) for a in self.axes[0].ancestry(i) for b in self.axes[1].ancestry(j) if not self.node[a, b]}
        level_x, level_y = self.axes[0].level, self.axes[1].level
        ordered = sorted(found, key=lambda pair: (level_x[pair[0]] + level_y[pair[1]], pair))
        return np.array([a * self.shape[1] + b for a, b in ordered], dtype=int)

    def insert(self, points: np.ndarray, values: np.ndarray) -> None:
        """Make nodes of points, given after all their ancestors.  A value that is not finite adds nothing."""
        x, y = self.axes
        for point, value in zip(points.tolist(), values.tolist(), strict=True):
            i, j = divmod(point, self.shape[1])
            surplus = value - self.interpolant[i, j]
            self.node[i, j] = True
            self._surplus[i, j] = abs(surplus) if np.isfinite(surplus) else np.inf
            if np.isfinite(surplus):
                self.interpolant[x.support[i], y.support[j]] += surplus * np.outer(x.basis[i], y.basis[j])

    def doubt(self) -> np.ndarray:
        """[points]: the larger |surplus| of a point's two parents; 0 at nodes, infinite if a parent's value is not finite."""
        along_x = np.where(self.axes[0].parent[:, None] >= 0, self._surplus[self.axes[0].parent], 0.0)
        along_y = np.where(self.axes[1].parent[None, :] >= 0, self._surplus[:, self.axes[1].parent], 0.0)
        return np.where(self.node, 0.0, np.maximum(along_x, along_y)).ravel()
