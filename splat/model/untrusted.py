"""Files that anyone may have written, and files that two programs may want to write at a time.

A file from outside is read only where what it promises fits its size on disk: what it would take in memory is known before any
of it is read.
"""

import fcntl
import glob
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from math import prod
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
import psutil

from landscape.errors import InputError

EXPANSION = 32  # times its size on disk that an archive may hold; what this program writes is not compressed
SLACK = 2**20  # bytes that any archive may hold
FOLDER = 0x10  # among the attributes of a member
TAKEN = "expected {what}, got another at work, which holds {path}; wait until it ends, or choose another --out"


def require_modest(archive: zipfile.ZipFile) -> None:
    """InputError where the members of an archive, some of which may share their bytes, are far larger than the file."""
    assert archive.fp is not None
    size, held = archive.fp.seek(0, os.SEEK_END), sum(member.file_size for member in archive.infolist())
    if held > EXPANSION * size + SLACK:
        raise InputError(f"it promises {held:,} bytes in a file of {size:,}")


def require_whole(archive: zipfile.ZipFile) -> None:
    """InputError where an archive that torch is to read is not modest, or a member is not there as it promises.

    torch takes a member that is marked as a folder, or without bytes, as read: its numbers are what free memory held.
    """
    require_modest(archive)
    for member in archive.infolist():
        stored = member.compress_type == zipfile.ZIP_STORED
        if member.external_attr & FOLDER or (stored and member.compress_size != member.file_size):
            raise InputError(f"{member.filename!r} is marked as a folder, or promises other bytes than it has")
    if wrong := archive.testzip():
        raise InputError(f"the checksum of {wrong!r} is wrong")


def require_held(file: BinaryIO, size: int) -> np.dtype:
    """The type of an array that `numpy.save` wrote into so many bytes, without the array.

    ValueError, or whatever NumPy raises, where the header is none, or promises more than there is, for which NumPy would ask
    memory at once.
    """
    version = np.lib.format.read_magic(file)
    start = file.read(2 if version == (1, 0) else 4)
    length = int.from_bytes(start, "little")
    if length > size:
        raise ValueError(f"it promises a header of {length:,} bytes in {size:,}")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(BytesIO(start + file.read(length)))
    if min(shape, default=0) < 0 or prod(shape) * kind.itemsize > size:
        raise ValueError(f"it promises {kind} of shape {shape} in {size:,} bytes")
    return kind


def read_array(file: BinaryIO) -> np.ndarray:
    """Real numbers that `numpy.save` wrote.  InputError where the file has others, none, or fewer than it promises."""
    try:
        kind = require_held(file, os.fstat(file.fileno()).st_size)
        if kind.kind not in "fiu":
            raise InputError(f"an array of {kind}, not of real numbers")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # NumPy has Python read the header, whose errors are of many kinds
        raise InputError(f"no array of numbers ({error})") from error


class Taken(InputError):
    """A file that another process holds."""


def inside(folder: Path, name: str) -> Path:
    """The file of this name in a folder.  InputError where a name of someone else's file leads out of it."""
    path = folder / name
    by_name = Path(os.path.abspath(path)).is_relative_to(
        os.path.abspath(folder)
    )  # links in it may lead where they will
    if not by_name and not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(
            f"expected names of files in {folder}, got {name!r}, which leads out of it; move the file there"
        )
    return path


@contextmanager
def locked(path: Path, what: str) -> Iterator[int]:
    """Hold the file at `path`, made for this and removed in the end; gives its descriptor, with which a child holds it too.

    The system lets go of it when the last process that has it ends, however that comes.  A file system without locks holds
    nothing.  what: which is expected to be alone.  Taken where another process holds it.
    """
    with _unheard_lock(path, what) as file:
        try:
            yield file.fileno()
        finally:
            path.unlink(missing_ok=True)


def _unheard_lock(path: Path, what: str) -> IO[str]:
    """The file of `locked`, held.  While a function of this name runs no signal is raised, which would leave the file."""
    while True:
        file = path.open("a")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise Taken(TAKEN.format(what=what, path=path)) from None
        except OSError:  # such as Lustre, mounted without them
            pass
        if _is_at(file.fileno(), path):
            return file
        file.close()  # the one who held it has just removed it


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Where to write what becomes `path` when the block ends: a reader or a crash sees what was there before or all of it."""
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")  # another program may write there too
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
        _drop_abandoned(path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename is None:
            error.filename = str(path)  # a full disk's error has none
        raise


def _drop_abandoned(path: Path) -> None:
    """Remove what killed processes left of the same file."""
    for partial in path.parent.glob(f".{glob.escape(path.name)}.partial-*"):
        process = partial.name.rpartition("-")[2]
        if process.isdigit() and not psutil.pid_exists(int(process)):
            partial.unlink(missing_ok=True)


def beside(folder: Path) -> Path:
    """Where the lock of a folder lies, which may not exist yet."""
    return folder.absolute().with_name(f".{folder.name}.lock")


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
