"""A format: a good example of it, how a case breaks that, and what reads it.

A format writes its example into a folder once.  A case breaks one file of it, `use` reads it as the commands do, to the numbers
and pages that follow, and the file is put back.  `use` raises what the reader raises; AssertionError where what was read cannot
be, or differs although a checksum could have told.
"""

import io
import json
from pathlib import Path
from typing import ClassVar

import numpy as np

from tests.hostile import mutations
from tests.hostile.mutations import Random


class Format:
    """name: in the table of outcomes.  broken: the files that cases break, of those in `root`.

    refuses: whether the reader refuses what is broken, rather than do without.
    """

    name: ClassVar[str]
    refuses: ClassVar[bool] = True

    def __init__(self, root: Path) -> None:
        self.root, self.chance = root, Random(0)
        self.write()
        self.files = {name: (self.root / name).read_bytes() for name in self.broken()}
        self.use()

    def write(self) -> None:
        raise NotImplementedError

    def broken(self) -> list[str]:
        raise NotImplementedError

    def use(self) -> None:
        raise NotImplementedError

    def case(self, chance: Random) -> None:
        """Break a file, use the folder, put the file back."""
        name = chance.choice(list(self.files))
        self.chance, self.changed, self.by_bytes = chance, name, False
        try:
            self._put(name, self.mutated(chance, name, self.files[name]))
            self.use()
        finally:
            self._put(name, self.files[name])

    def _put(self, name: str, content: bytes) -> None:
        (self.root / name).unlink()  # some file systems wait for the disk when a file is written over
        (self.root / name).write_bytes(content)

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if Path(name).suffix in (".txt", ".csv", ".toml", ".json") and chance.random() < 0.6:
            return mutations.of_text(chance, content.decode()).encode()
        if name.endswith(".json") and chance.random() < 0.8:
            tree = mutations.of_tree(chance, json.loads(content))
            return json.dumps(tree).encode("utf-8", "surrogatepass")
        if name.endswith(".npy") and chance.random() < 0.5:
            return saved(mutations.of_array(chance, np.load(io.BytesIO(content))))
        self.by_bytes = True
        return mutations.of_bytes(chance, content)


def saved(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()
