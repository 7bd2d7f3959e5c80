"""The linearized views of an objective, of which as many stay in memory as a budget has room for."""

from collections.abc import Callable, Iterator

from splat.curvature.linearize import LinearizedView

VECTORS = 8  # at a time in a product: a wider block gains nothing more, because it leaves the second-level cache


class KeptViews:
    """Iterates over linearized views: the first `kept` stay in memory, the others are linearized anew every time.

    linearize: makes the view of an index; count: how many views; memory: bytes for views and the workspace of a product with
    VECTORS vectors.  The first view is made here, always kept, and stands for the size of all.  Memory decides how many views
    are kept and nothing else, so that results do not depend on it.
    """

    def __init__(self, linearize: Callable[[int], LinearizedView], count: int, memory: int):
        first = linearize(0)
        more = (memory - first.bytes - first.workspace(VECTORS)) // first.bytes
        self.kept = 1 + min(max(more, 0), count - 1)
        self._linearize, self._count, self._views = linearize, count, {0: first}

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[LinearizedView]:
        for index in range(self._count):
            if index >= self.kept:
                yield self._linearize(index)
                continue
            if index not in self._views:
                self._views[index] = self._linearize(index)
            yield self._views[index]

    def workspace(self, vectors: int) -> int:
        """Bytes that a product with so many vectors takes at a time in the first view."""
        return self._views[0].workspace(min(vectors, VECTORS))
