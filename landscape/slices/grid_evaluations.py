"""Evaluations of an objective at points of a slice's grid: in parallel, and kept in a store so that a run can continue.

The store holds a SHA-256 digest of (center, directions, coordinates) and the loss at the centre.  What it holds of another
slice, of an objective with another loss at the centre, or damaged, is evaluated again.
"""

import hashlib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from math import isfinite
from time import monotonic
from typing import NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from landscape.errors import InputError
from landscape.results import Progress

Evaluation = float | Tensor | tuple[float | Tensor, Hashable]
Loss = Callable[[Tensor], Evaluation]
"""loss(theta) -> the objective, or (the objective, smooth_piece): a label of the smooth piece that contains theta."""


class Control(NamedTuple):
    """A cheap function that differs from an objective by little that is smooth: loss(theta[rows])."""

    loss: Loss
    rows: Int[Tensor, " m"]


class Store(Protocol):
    """Where evaluations are kept: writes all of the arrays or none, and reads them again, none before any were written.

    Reading raises InputError where they are damaged.
    """

    def read(self) -> Mapping[str, np.ndarray]: ...

    def write(self, **arrays: np.ndarray) -> None: ...


SAVE_EVERY = 5.0  # seconds
PART = 1 << 15  # parameters that are moved at a time: their numbers stay in a processor's cache
SAME_LOSS = 100.0  # units of round-off by which two evaluations at one point may differ, summed in different orders


def evaluated_at(loss: Loss, theta: Tensor) -> tuple[float, Hashable]:
    """The value and the smooth piece; None for an objective that does not name its pieces."""
    found = loss(theta)
    value, piece = found if isinstance(found, tuple) else (found, None)
    return float(value), piece


class GridEvaluations:
    """The objective at center + directions @ points[i].  `require` makes points known.

    value, known, discontinuous [points]: the loss (nan where not known), whether it is known, and whether the point lies on
    another smooth piece than the centre.  has_pieces: whether the objective names its pieces.  If workers > 1, loss must be
    safe to call from several threads.  Points are computed in float64 on the device of center, and rounded once to its dtype.
    """

    def __init__(
        self,
        loss: Loss,
        center: Float[Tensor, " n"],
        directions: Float[Tensor, "n d"],
        points: Float64[Tensor, "p d"],
        workers: int = 1,
        store: Store | None = None,
        progress: Progress | None = None,
    ):
        self._loss, self._center, self._points = loss, center.detach(), points.to(center.device)
        self._directions = directions.detach().T.contiguous()
        self._workers, self._store, self._progress = workers, store, progress
        self.center_loss, self._here = evaluated_at(loss, self._center)
        if not isfinite(self.center_loss):
            raise InputError(f"expected a finite objective at the centre, got {self.center_loss}")
        self.has_pieces = self._here is not None
        self.value = np.full(len(points), np.nan)
        self.known, self.discontinuous = np.zeros((2, len(points)), bool)
        self._digest = f"{slice_digest(self._center, directions, points)} {self.has_pieces}"
        self._stored = self._read(store) if store is not None else {}

    def require(self, points: Iterable[int]) -> None:
        """Evaluate the points that are not known yet."""
        wanted = [int(point) for point in dict.fromkeys(points) if not self.known[point]]
        missing = [point for point in wanted if point not in self._stored]
        for point in wanted:
            if point in self._stored:
                self._set(point, *self._stored[point])
        saved = monotonic()
        try:
            for point, (value, piece) in zip(missing, self._evaluate(missing), strict=True):
                self._stored[point] = value, piece != self._here
                self._set(point, *self._stored[point])
                if self._store is not None and monotonic() - saved > SAVE_EVERY:
                    self._write(self._store)
                    saved = monotonic()
        finally:
            if self._store is not None and missing:
                self._write(self._store)

    def _evaluate(self, points: list[int]) -> Iterator[tuple[float, Hashable]]:
        if self._workers == 1:
            yield from map(self._at, points)
            return
        pool = ThreadPoolExecutor(self._workers)
        try:
            yield from pool.map(self._at, points)
        finally:
            pool.shutdown(cancel_futures=True)

    def _at(self, point: int) -> tuple[float, Hashable]:
        theta, steps = torch.empty_like(self._center), self._points[point].tolist()
        size = PART if theta.device.type == "cpu" else len(theta)
        each = (array.split(size) for array in (theta, self._center, *self._directions))
        for part, origin, *directions in zip(*each, strict=True):
            exact = origin.to(torch.float64, copy=True)
            for direction, step in zip(directions, steps, strict=True):
                exact.add_(direction, alpha=step)
            part.copy_(exact)
        return evaluated_at(self._loss, theta)

    def _set(self, point: int, value: float, discontinuous: bool) -> None:
        self.value[point], self.discontinuous[point], self.known[point] = value, discontinuous, True
        if self._progress:
            self._progress(int(self.known.sum()), len(self.known), "slice")

    def _write(self, store: Store) -> None:
        rows = [(point, *found) for point, found in self._stored.items()]
        store.write(
            digest=np.array(self._digest),
            center_loss=np.array(self.center_loss),
            evaluations=np.array(rows, dtype=np.float64).reshape(-1, 3),
        )

    def _read(self, store: Store) -> dict[int, tuple[float, bool]]:
        """The evaluations in a store; none where they are damaged, or of another slice or objective."""
        with suppress(KeyError, TypeError, ValueError, OverflowError):
            kept = store.read()
            room = SAME_LOSS * torch.finfo(self._center.dtype).eps * abs(self.center_loss)
            if kept and str(kept["digest"]) == self._digest and abs(kept["center_loss"] - self.center_loss) <= room:
                rows = kept["evaluations"].astype(np.float64).reshape(-1, 3).tolist()
                return {int(point): (value, bool(crossed)) for point, value, crossed in rows}
        return {}


def slice_digest(center: Tensor, directions: Tensor, points: Tensor) -> str:
    """SHA-256 digest of dtypes, shapes and numbers."""
    digest = hashlib.sha256()
    for tensor in (center, directions, points):
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy())  # pyright: ignore[reportArgumentType]
    return digest.hexdigest()
