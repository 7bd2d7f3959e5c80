"""A reader of files, a good example of what it reads, and how a case breaks that."""

import fnmatch
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.hostile import mutations
from tests.hostile.mutations import Random

Read = Sequence[torch.Tensor | np.ndarray] | None


@dataclass(frozen=True)
class Reader:
    """write: a good example, into a folder.  broken: patterns of the files that cases break.

    use: reads the folder, to what follows, and raises what the reader raises; AssertionError where what was read cannot be.
    It returns the numbers that a checksum guards, of files of the pattern `guarded`: they must be as written, or refused, where
    bytes were changed.  refuses: whether what is broken is refused, rather than done without.  part: of a JSON file, what a
    case changes.
    """

    write: Callable[[Path], object]
    use: Callable[[Path, Random], Read]
    broken: str
    guarded: str = ""
    refuses: bool = True
    part: tuple[str, ...] = ()


class Example:
    """A reader's files in a folder."""

    def __init__(self, reader: Reader, root: Path) -> None:
        self.reader, self.root = reader, root
        reader.write(root)
        found = sorted({path for each in reader.broken.split() for path in root.glob(each)})
        self.files = {path.relative_to(root).as_posix(): path.read_bytes() for path in found}
        self.good = reader.use(root, Random(0))

    def case(self, chance: Random) -> None:
        """Break a file, use the folder, put the file back."""
        name = chance.choice(list(self.files))
        content, blindly = self._mutated(chance, name)
        try:
            self._put(name, content)
            found = self.reader.use(self.root, chance)
            if blindly and fnmatch.fnmatch(name, self.reader.guarded):
                same = found is not None and self.good is not None and all(map(_equal, found, self.good))
                assert same, "other numbers than were written"
        finally:
            self._put(name, self.files[name])

    def _mutated(self, chance: Random, name: str) -> tuple[bytes, bool]:
        if not self.reader.part:
            return mutations.of_file(chance, name, self.files[name])
        content = inner = json.loads(self.files[name])
        for key in self.reader.part[:-1]:
            inner = inner[key]
        inner[self.reader.part[-1]] = mutations.of_tree(chance, inner[self.reader.part[-1]])
        return mutations.json_of(content), False

    def _put(self, name: str, content: bytes) -> None:
        (self.root / name).unlink()  # some file systems wait for the disk when a file is written over
        (self.root / name).write_bytes(content)


def _equal(a: Any, b: Any) -> bool:
    return np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)
