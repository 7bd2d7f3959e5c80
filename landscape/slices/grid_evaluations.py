"""Evaluations of an objective at points of a slice's grid: in parallel, and kept in a store so that a run can continue.

The store holds a SHA-256 digest of (center, directions, coordinates) and the loss at the centre.  When it is read, the loss at
the centre and the value that differs most from it are evaluated again and compared.  Values of another slice or of another
objective are refused with an InputError.
"""

import hashlib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from math import isfinite
from time import monotonic
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.results import Progress

Evaluation = float | Tensor | tuple[float | Tensor, Hashable]
Loss = Callable[[Tensor], Evaluation]
"""loss(theta) -> the objective, or (the objective, smooth_piece): a label of the smooth piece that contains theta."""


class Store(Protocol):
    """Where evaluations are kept: writes all of the arrays or none, and reads them again, none before any were written.

    Its text names it in messages.  Reading raises InputError where they are damaged.
    """

    def read(self) -> Mapping[str, np.ndarray]: ...

    def write(self, **arrays: np.ndarray) -> None: ...


SAVE_EVERY = 5.0  # seconds
COLUMNS = {"points": "i", "values": "f", "crossed": "b"}  # of the file, with the kinds of their types
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
        self._origin, self._spans = self._center.double(), directions.detach().double()
        self._workers, self._store, self._progress = workers, store, progress
        self.center_loss, self._here = evaluated_at(loss, self._center)
        if not isfinite(self.center_loss):
            raise InputError(f"expected a finite objective at the centre, got {self.center_loss}")
        self.has_pieces = self._here is not None
        self.value = np.full(len(points), np.nan)
        self.known, self.discontinuous = np.zeros((2, len(points)), bool)
        self._digest = slice_digest(self._center, self._spans, points)
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
        theta = (self._origin + self._spans @ self._points[point]).to(self._center.dtype)
        return evaluated_at(self._loss, theta)

    def _set(self, point: int, value: float, discontinuous: bool) -> None:
        self.value[point], self.discontinuous[point], self.known[point] = value, discontinuous, True
        if self._progress:
            self._progress(int(self.known.sum()), len(self.known), "slice")

    def _write(self, store: Store) -> None:
        values, crossed = zip(*self._stored.values(), strict=True) if self._stored else ((), ())
        store.write(
            digest=np.array(self._digest),
            center_loss=np.array(self.center_loss),
            has_signature=np.array(self.has_pieces),
            points=np.array(list(self._stored), dtype=np.int64),
            values=np.array(values, dtype=np.float64),
            crossed=np.array(crossed, dtype=bool),
        )

    def _read(self, store: Store) -> dict[int, tuple[float, bool]]:
        advice = "name another file or delete this one"
        try:
            archive = store.read()
        except InputError as error:
            raise InputError(f"{error}; {advice}") from None
        if not archive:
            return {}
        try:
            if missing := {"digest", "center_loss", "has_signature", *COLUMNS} - archive.keys():
                raise ValueError(f"no {', '.join(sorted(missing))}")
            digest, center_loss = str(archive["digest"]), float(archive["center_loss"])
            has_pieces = bool(archive["has_signature"])
            columns = [archive[name] for name in COLUMNS]
            if any((each.dtype.kind, each.ndim) != (kind, 1) for each, kind in zip(columns, COLUMNS.values())):
                raise ValueError(
                    f"expected one-dimensional {', '.join(COLUMNS)} of kinds {', '.join(COLUMNS.values())}"
                )
            points, values, crossed = (each.tolist() for each in columns)
            stored = dict(zip(points, zip(values, crossed, strict=True), strict=True))
        except (TypeError, ValueError) as error:
            raise InputError(
                f"expected a slice's evaluations in {store}, got a damaged file ({error}); {advice}"
            ) from None
        if digest != self._digest:
            raise InputError(
                f"expected evaluations of this slice in {self._store}, got another center, other directions or "
                f"coordinates; {advice}"
            )
        self._require_same("at the centre", self.center_loss, center_loss, has_pieces == self.has_pieces, advice)
        finite = {point: value for point, (value, _) in stored.items() if isfinite(value)}
        if finite:
            point = max(finite, key=lambda point: abs(finite[point] - center_loss))
            self._require_same(f"at point {point}", self._at(point)[0], finite[point], True, advice)
        return stored

    def _require_same(self, where: str, here: float, stored: float, alike: bool, advice: str) -> None:
        room = SAME_LOSS * torch.finfo(self._center.dtype).eps * max(abs(here), abs(self.center_loss))
        if not (alike and abs(here - stored) <= room):
            raise InputError(
                f"expected evaluations of this objective in {self._store}, which is {here} {where}, got one that is {stored}; "
                f"{advice}"
            )


def slice_digest(center: Tensor, directions: Tensor, points: Tensor) -> str:
    """SHA-256 digest of dtypes, shapes and numbers."""
    digest = hashlib.sha256()
    for tensor in (center, directions, points):
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.detach().double().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
