"""True evaluations of an objective at points of a slice's grid: in parallel, and kept in a file from which a killed run
continues.

The file names the slice by a SHA-256 digest of (center, directions, coordinates) and holds the loss at the centre.  That and
the value which is farthest from it are evaluated anew and compared when the file is read: another slice's values, or another
objective's, are refused.
"""

import hashlib
import os
import zipfile
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from math import isfinite
from pathlib import Path
from time import monotonic

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.results import Progress

Evaluation = float | Tensor | tuple[float | Tensor, Hashable]
Loss = Callable[[Tensor], Evaluation]
"""loss(theta) -> the objective, or (the objective, signature), where the signature tells which smooth piece theta lies in."""

SAVE_EVERY = 5.0  # seconds
SAME_LOSS = 100.0  # round-offs by which one objective at one point may differ between runs, summed in another order


def evaluated_at(loss: Loss, theta: Tensor) -> tuple[float, Hashable]:
    """The value and the signature, None where the objective gives none."""
    found = loss(theta)
    value, signature = found if isinstance(found, tuple) else (found, None)
    return float(value), signature


class GridEvaluations:
    """The objective at center + directions @ points[i]: what is known so far, and `require` for more.

    value, known, crossed [points]: the loss (nan where not known), which are known, and which of those have another
    signature than the centre; has_signature: whether the objective gives any; made: how many of the points were evaluated here,
    not read.  loss must be safe to call from several
    threads if workers > 1.  Points are formed in float64, where center is, and rounded once to its dtype.
    """

    def __init__(
        self,
        loss: Loss,
        center: Float[Tensor, " n"],
        directions: Float[Tensor, "n d"],
        points: Float64[Tensor, "p d"],
        workers: int = 1,
        store: Path | None = None,
        progress: Progress | None = None,
    ):
        self._loss, self._center, self._points = loss, center.detach(), points.to(center.device)
        self._origin, self._spans = self._center.double(), directions.detach().double()
        self._workers, self._store, self._progress = workers, store, progress
        self.center_loss, self._here = evaluated_at(loss, self._center)
        if not isfinite(self.center_loss):
            raise InputError(f"expected a finite objective at the centre, got {self.center_loss}")
        self.has_signature = self._here is not None
        count = len(points)
        self.value, self.known, self.crossed = np.full(count, np.nan), np.zeros(count, bool), np.zeros(count, bool)
        self.made = 0
        self._digest = slice_digest(self._center, self._spans, points)
        self._stored = self._read() if store is not None and store.exists() else {}

    def require(self, points: Iterable[int]) -> None:
        """Evaluate those of the points that are not known yet."""
        wanted = [int(point) for point in dict.fromkeys(points) if not self.known[point]]
        missing = [point for point in wanted if point not in self._stored]
        for point in wanted:
            if point in self._stored:
                self._set(point, *self._stored[point])
        saved = monotonic()
        try:
            for point, (value, signature) in zip(missing, self._evaluate(missing), strict=True):
                self._stored[point] = value, signature != self._here
                self.made += 1
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

    def _set(self, point: int, value: float, crossed: bool) -> None:
        self.value[point], self.crossed[point], self.known[point] = value, crossed, True
        if self._progress:
            self._progress(int(self.known.sum()), len(self.known), "slice")

    def _write(self, path: Path) -> None:
        values, crossed = zip(*self._stored.values(), strict=True) if self._stored else ((), ())
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        with temporary.open("wb") as stream:
            np.savez(
                stream,
                digest=np.array(self._digest),
                center_loss=np.array(self.center_loss),
                has_signature=np.array(self.has_signature),
                points=np.array(list(self._stored), dtype=np.int64),
                values=np.array(values, dtype=np.float64),
                crossed=np.array(crossed, dtype=bool),
            )
        temporary.replace(path)

    def _read(self) -> dict[int, tuple[float, bool]]:
        assert self._store is not None
        advice = "name another file or delete this one"
        try:
            with np.load(self._store, allow_pickle=False) as archive:
                digest, center_loss = str(archive["digest"]), float(archive["center_loss"])
                has_signature = bool(archive["has_signature"])
                columns = [archive[name].tolist() for name in ("points", "values", "crossed")]
            stored = {point: (value, crossed) for point, value, crossed in zip(*columns, strict=True)}
        except (ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile) as error:
            raise InputError(
                f"expected a slice's evaluations in {self._store}, got a damaged file ({error}); {advice}"
            ) from None
        if digest != self._digest:
            raise InputError(
                f"expected evaluations of this slice in {self._store}, got another center, other directions or "
                f"coordinates; {advice}"
            )
        self._require_same("at the centre", self.center_loss, center_loss, has_signature == self.has_signature, advice)
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
    """SHA-256 of dtype, shapes and bytes."""
    digest = hashlib.sha256()
    for tensor in (center, directions, points):
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.detach().double().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
