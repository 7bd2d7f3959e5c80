"""What the stages of long work found, kept in a folder until the work is done: the same command continues from there.

A stage writes its result when it ends, in a file of its own that begins with a digest of the command and of the content.  What
another command left (other settings, another checkpoint, another version), or is damaged, is measured again.  Results are
dataclasses and `msgspec` structures, whose types are checked on reading.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
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


class Entry(msgspec.Struct):
    """A stage's result, the notes it made, how often it did what is counted, and the seconds it took."""

    value: msgspec.Raw
    notes: list[str]
    count: int
    seconds: float


class Kept:
    """Runs stages, or reads what they found before.

    streams: names of all stages; each draws from a stream of its own, so that its numbers do not depend on which others have
    run.  done: of products, so far.  folder: None to keep nothing.  identity: all that the numbers depend on, as text.

    notes, count: of all stages.
    """

    def __init__(
        self,
        stages: Stages,
        generator: torch.Generator,
        streams: Sequence[str],
        done: Callable[[], int] = lambda: 0,
        folder: Path | None = None,
        identity: str = "",
    ) -> None:
        self.stages, self.folder, self.done = stages, folder, done
        self.identity = identity.encode("utf-8", "surrogateescape")
        self.streams = {name: spawn(generator) for name in streams}
        self.notes: list[str] = []
        self.count = 0

    def run(self, name: str, kind: type[T], work: Task[T]) -> T:
        """What the stage finds, or found before."""
        if (found := self._read(name, kind)) is not None:
            self.stages.known(name, found[1].seconds)
        else:
            found = self._done(name, work)
            if self.folder is not None:
                self.folder.mkdir(parents=True, exist_ok=True)
                content = msgspec.msgpack.encode(found[1])
                write_atomically(_file(self.folder, name), self._digest(content) + content)
        value, entry = found
        self.notes += entry.notes
        self.count += entry.count
        return value

    def _done(self, name: str, work: Task[T]) -> tuple[T, Entry]:
        """What the work finds, as it is and as it is kept."""
        notes, before = [], self.done()
        with self.stages.stage(name) as report:
            value = work(self.streams[name], report, notes)
        content = msgspec.Raw(msgspec.msgpack.encode(value, enc_hook=_plain))
        return value, Entry(content, notes, self.done() - before, self.stages.timing[name])

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
