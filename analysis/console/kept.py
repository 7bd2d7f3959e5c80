"""What the stages of long work found, kept in a folder until the work is done: the same command continues from there.

A stage writes its result when it ends, in a file of its own that begins with a digest of the command and of the content.  What
another command left (other settings, another checkpoint, another version), or is damaged, is measured again.  Results are
dataclasses and `msgspec` structures, whose types are checked on reading.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from hashlib import sha256
from math import inf
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from analysis.console.stages import Stages
from landscape.errors import InputError
from landscape.probes import spawn
from landscape.results import Progress
from splat.model.untrusted import unpacked, write_atomically

T = TypeVar("T")
DIGEST = sha256().digest_size
Task = Callable[[torch.Generator, Progress, list[str]], T]
"""A stage's work: is given random numbers, whom to tell how far it is, and where to note what it leaves out."""


class TimeUp(Exception):
    """The time that the command was given has ended."""


class Entry(msgspec.Struct):
    """A stage's result, the notes it made, how often it did what is counted, and the seconds it took."""

    value: msgspec.Raw
    notes: list[str]
    counts: list[int]
    seconds: float


class Kept:
    """Runs stages, or reads what they found before.

    streams: names of all stages; each draws from a stream of its own, so that its numbers do not depend on which others have
    run.  count: of products and such, so far.  folder: None to keep nothing.  identity: all that the numbers depend on, as
    text.  deadline: by `monotonic`; a stage under way is then given up, one to come is not begun.

    notes, counts: of all stages; unreached: stages that time did not reach.
    """

    def __init__(
        self,
        stages: Stages,
        generator: torch.Generator,
        streams: Sequence[str],
        count: Callable[[], list[int]] = lambda: [],
        folder: Path | None = None,
        identity: str = "",
        deadline: float = inf,
    ) -> None:
        self.stages, self.folder, self.count, self.deadline = stages, folder, count, deadline
        self.identity = identity.encode("utf-8", "surrogateescape")
        self.streams = {name: spawn(generator) for name in streams}
        self.notes: list[str] = []
        self.counts: list[int] = []
        self.unreached: list[str] = []

    @property
    def left(self) -> float:
        """Seconds until the deadline."""
        return max(self.deadline - monotonic(), 0.0)

    def run(self, name: str, kind: type[T], work: Task[T], ends_in_time: bool = False) -> T | None:
        """What the stage finds, or found before; None where time did not reach it.

        ends_in_time: the work heeds the time left by itself; it is always done, and what it has at the deadline is returned but
        not kept.
        """
        if (found := self._read(name, kind)) is not None:
            self.stages.known(name, found[1].seconds)
        else:
            try:
                found = self._done(name, work, ends_in_time)
            except TimeUp:
                self.unreached.append(name)
                return None
            if self.folder is not None and not (ends_in_time and self.left == 0):
                self.folder.mkdir(parents=True, exist_ok=True)
                content = msgspec.msgpack.encode(found[1])
                write_atomically(_file(self.folder, name), self._digest(content) + content)
        value, entry = found
        self.notes += entry.notes
        self.counts = [sum(both) for both in zip(self.counts or [0] * len(entry.counts), entry.counts, strict=True)]
        return value

    def _done(self, name: str, work: Task[T], ends_in_time: bool) -> tuple[T, Entry]:
        """What the work finds, as it is and as it is kept.  TimeUp at the deadline."""
        notes, before = [], self.count()

        def timed(done: int, most: int, state: str) -> None:
            report(done, most, state)
            self._require_time()

        if not ends_in_time:
            self._require_time()
        with self.stages.stage(name) as report:
            value = work(self.streams[name], report if ends_in_time else timed, notes)
        counts = [after - first for after, first in zip(self.count(), before, strict=True)]
        content = msgspec.Raw(msgspec.msgpack.encode(value, enc_hook=_plain))
        return value, Entry(content, notes, counts, self.stages.timing[name])

    def _require_time(self) -> None:
        if self.left == 0:
            raise TimeUp

    def _read(self, name: str, kind: type[T]) -> tuple[T, Entry] | None:
        """What a stage found; None where nothing that can be read and is this command's is kept."""
        if self.folder is not None and (file := _file(self.folder, name)).is_file():
            with suppress(OSError, InputError):
                content = (kept := file.read_bytes())[DIGEST:]
                if kept[:DIGEST] == self._digest(content):
                    entry = unpacked(content, Entry)
                    return unpacked(entry.value, kind, _tensor), entry
        return None

    def _digest(self, content: bytes) -> bytes:
        return sha256(self.identity + b"\0" + content).digest()


def kept_stages(folder: Path) -> list[str]:
    """The stages that are kept in a folder."""
    return sorted(file.stem.replace("-", " ") for file in folder.glob("*.msgpack"))


def _file(folder: Path, name: str) -> Path:
    return folder / f"{name.replace(' ', '-')}.msgpack"


def _plain(value: Any) -> Any:
    if isinstance(value, Tensor):
        array = value.detach().cpu().numpy()
        return {"device": value.device.type, "dtype": array.dtype.str, "shape": array.shape, "bytes": array.tobytes()}
    raise NotImplementedError(f"expected a tensor, got {type(value).__name__}")


def _tensor(kind: type, content: Any) -> Tensor:
    try:
        array = np.frombuffer(content["bytes"], dtype=np.dtype(content["dtype"])).reshape(content["shape"])
        return torch.from_numpy(array.copy()).to(content["device"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"expected a tensor, got {error}") from None
