"""The one reader of files that anyone may have written, and the one writer of files that two programs may want to write.

A file from outside is read only where what it promises fits its size on disk: what it would take in memory is known before any
of it is read.  What becomes of it is plain types, arrays or a picture, of the sizes that are there; what these mean is checked
where they are used.
"""

import errno
import fcntl
import glob
import json
import os
import pickletools
import re
import shutil
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from io import BufferedReader, BytesIO, FileIO, StringIO
from itertools import chain
from math import prod
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, TypeVar, cast

import msgspec
import numpy as np
import psutil
from PIL import Image

from landscape.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

T = TypeVar("T")
EXPANSION = 32  # times its size on disk that an archive may hold; what this program writes is not compressed
LFS_MAGIC = b"version https://git-lfs"
SLACK = 2**20  # bytes that any archive may hold
FOLDER = 0x10  # among the attributes of a member
PLAIN = re.compile(  # names in a pickle that make nothing larger than what the file holds
    r"torch (?!\w*Tensor$)\w+|torch\._utils _rebuild_(?!qtensor)\w+|torch\.nn\.parameter Parameter|"
    r"torch\.serialization _get_layout|torch\._tensor _rebuild_from_type_v2|numpy\._?core\.multiarray scalar|"
    r"collections (OrderedDict|Counter)|(builtins|__builtin__) (set|complex)"
)
# columns of a table
DIGESTS = dict.fromkeys(["digest", "scene_digest", "commit", "of_data", "of_question", "of_state"], str)
MOST_TEXT = 2**28  # bytes of a file of text
DEEPEST = 64  # levels of lists and mappings in one; records have at most ten, and Python takes about 300
MOST_PIXELS = 2**26  # of a picture: 67 million, a quarter of a GiB as read
MOST_ROWS = 2**16  # more than JPEG has; Pillow keeps an address for each, which may be more than the pixels
NAME = r"^[\w+-][\w.+ -]{0,99}$"  # of a file in a record, or that becomes a folder: letters, digits, - _ + . and blanks
LONGEST = 200  # bytes of a name to which more may be added
UNWRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR)  # of a folder to write in
TAKEN = "expected {what}, got another at work, which holds {path}; wait until it ends, or choose another --out"


def require_modest(archive: zipfile.ZipFile) -> None:
    """InputError where the members of an archive, which may share their bytes, are far larger than the file.

    Python asks for the memory of as many bytes as a member is said to have in the file before it reads one.
    """
    assert archive.fp is not None
    size, members = archive.fp.seek(0, os.SEEK_END), archive.infolist()
    held, packed = sum(member.file_size for member in members), sum(member.compress_size for member in members)
    if held > EXPANSION * size + SLACK or packed > size:
        raise InputError(f"it promises {max(held, packed):,} bytes in a file of {size:,}")


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
    for member in archive.infolist():
        if member.filename.lower().endswith("data.pkl"):  # torch finds it in capitals too
            _require_plain(archive.read(member))


def _require_plain(content: bytes) -> None:
    """InputError where a pickle that torch is to read has names other than PLAIN.

    torch lets more through, such as `bytearray` and `torch.Tensor`, which take as much memory as a number in the file says.
    So do NumPy's types of any length, and `encode`, which in some codecs doubles its bytes: both must be as `torch.save`
    writes them.
    """
    memo: dict[Any, tuple[str, Any]] = {}
    words: list[tuple[str, Any]] = [("", None)] * 4  # the last operations, and what they name
    for operation, value, _ in chain(pickletools.genops(content), [(pickletools.opcodes[0], None, None)] * 3):
        if "PUT" in operation.name:
            memo[value] = words[-1]
            continue
        words = [*words[1:], memo[value] if "GET" in operation.name else (operation.name, value)]
        (kind, name), first, *more = words
        known = (
            kind != "GLOBAL"
            or PLAIN.fullmatch(name)
            or (name == "numpy dtype" and re.fullmatch("[bfi][1248]", str(first[1])))
            or (name == "_codecs encode" and more == [("BINUNICODE", "latin1"), ("TUPLE2", None)])
        )
        if not known:
            raise InputError(f"more than tensors and numbers: a {name.replace(' ', '.')}; save it again without that")


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


@contextmanager
def _refusing(what: str, path: Path) -> Iterator[None]:
    """Turn every error but of memory and of the file system into an InputError that names the file.

    Readers raise nearly anything of damaged bytes.
    """
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        if is_of_the_system(error):
            raise
        said = " ".join(str(error).split())  # of pandas with a line's end
        raise InputError(f"expected {what} in {path}, got a damaged file ({said})") from None


def is_of_the_system(error: BaseException) -> bool:
    """Whether the file system, rather than what a file holds, is the cause.

    >>> is_of_the_system(FileNotFoundError(2, "gone")), is_of_the_system(OSError("no picture"))
    (True, False)
    """
    # a damaged index of an archive leads to before its start, where no file system goes
    return isinstance(error, OSError) and error.errno not in (None, errno.EINVAL)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays that `numpy.savez` wrote, by name.  InputError where the file has others, or fewer than it promises."""
    with _refusing("arrays", path), zipfile.ZipFile(path) as archive:
        require_modest(archive)
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        return {member.filename.removesuffix(".npy"): _member(archive, member) for member in members}


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        require_held(cast(BinaryIO, file), member.file_size)
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def read_text(path: Path) -> str:
    """InputError where it is longer than MOST_TEXT, or not UTF-8."""
    with _refusing("text in UTF-8", path):
        return _bytes(path).decode("utf-8")


def _bytes(path: Path) -> bytes:
    if (size := path.stat().st_size) > MOST_TEXT:
        raise InputError(f"{size:,} bytes, of at most {MOST_TEXT:,}")
    return path.read_bytes()


def read_json(path: Path, what: str = "JSON") -> Any:
    """Content of strict JSON as plain types.  InputError, which says what was expected, where it is none or too deep."""
    with _refusing(what, path):
        return _shallow(msgspec.json.decode(_bytes(path)))


def _shallow(content: Any) -> Any:
    """The content, which no function that calls itself for each level can fail on."""
    level = [content]
    for _ in range(DEEPEST):
        inside = [each.values() if isinstance(each, dict) else each for each in level if isinstance(each, dict | list)]
        level = [each for members in inside for each in members]
    if level:
        raise InputError(f"more than {DEEPEST} levels")
    return content


def loose_json(content: str | bytes, parse_int: Callable[[str], Any] | None = None) -> Any:
    """As Python reads JSON, NaN too, which other tools write.  InputError where it is none."""
    try:
        return json.loads(content, parse_int=parse_int)
    except (ValueError, RecursionError) as error:
        raise InputError(f"no JSON ({error})") from None


def read_toml(path: Path, what: str = "TOML") -> dict[str, Any]:
    """As `read_json`."""
    with _refusing(what, path):
        return _shallow(tomllib.loads(_bytes(path).decode("utf-8")))


def read_table(path: Path, what: str = "a table", **settings: Any) -> "pd.DataFrame":
    """What `pandas.read_csv` reads with these settings.  InputError, which says what was expected, where it is no CSV.

    Columns of DIGESTS are text: one of digits and an e would be read as a number, mostly as infinity.
    """
    import pandas as pd  # a third of a second

    dtype = settings.pop("dtype", {})
    with _refusing(what, path):
        text = StringIO(_bytes(path).decode("utf-8"))
        return pd.read_csv(text, dtype=dtype if dtype is str else DIGESTS | dtype, **settings)


def unpacked(content: bytes | msgspec.Raw, kind: type[T], decode_hook: Callable[[type, Any], Any] | None = None) -> T:
    """A structure that `msgspec.msgpack` wrote.  InputError where the content is of another kind, or too deep."""
    try:
        return msgspec.msgpack.decode(content, type=kind, dec_hook=decode_hook)
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected {kind.__name__}, got {error}") from None


class ImageFile(BufferedReader):
    """A file that is never asked for more bytes than it has: a chunk of a PNG may announce 2 GiB."""

    def __init__(self, path: Path) -> None:
        super().__init__(FileIO(path))
        self.size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1) -> bytes:
        left = max(self.size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))

    def __repr__(self) -> str:  # in Pillow's messages
        return repr(self.name)


def open_image(file: BinaryIO, formats: tuple[str, ...]) -> Image.Image:
    """A picture, of which the size alone has been read.  InputError where it has more than MOST_PIXELS or MOST_ROWS.

    formats: Pillow recognises a file by its content, whatever its name, and would start Ghostscript for PostScript.
    """
    image = Image.open(file, formats=formats)
    if image.width * image.height > MOST_PIXELS or max(image.size) > MOST_ROWS:
        raise InputError(f"{image.width} x {image.height} px (at most {MOST_PIXELS:,} and {MOST_ROWS:,} a side)")
    return image


def read_picture(path: Path) -> Image.Image:
    """A PNG or JPEG.  InputError where it is none, or too large."""
    with _refusing("a picture", path), ImageFile(path) as content, open_image(content, ("PNG", "JPEG")) as image:
        image.load()
        return image


def require_name(name: str) -> str:
    """The name, which is to be one of a file or a folder.  InputError where it is not fit for that, and might lead out.

    >>> require_name("fern 2.1")
    'fern 2.1'
    """
    if not re.match(NAME, name) or name.endswith("\n"):
        raise InputError(
            f"expected a name of at most 100 letters, digits, - _ + . or blanks, as it names a folder, got {name!r}"
        )
    return name


def require_scene(folder: Path) -> None:
    """FileNotFoundError where there is no folder of a scene."""
    if not folder.is_dir():
        raise FileNotFoundError(
            f"expected a scene folder, {folder} {'is not a folder' if folder.exists() else 'does not exist'}; "
            "name the one that holds the cameras; landscape sfm makes it of photographs"
        )


def require_content(path: Path) -> None:
    """InputError where a file is the pointer that git lfs left in its place; nothing where there is no file."""
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(LFS_MAGIC)) == LFS_MAGIC:
                raise InputError(
                    f"expected the content of {path}, got a pointer of git lfs in its place; run `git lfs pull` in its folder"
                )


class Taken(InputError):
    """A file that another process holds."""


def inside(folder: Path, name: str) -> Path:
    """The file of this name in a folder.  InputError where a name of someone else's file leads out of it."""
    path = folder / name
    # links in it may lead where they will
    by_name = Path(os.path.abspath(path)).is_relative_to(os.path.abspath(folder))
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
    with _lock(path, what) as file:
        try:
            yield file.fileno()
        finally:
            path.unlink(missing_ok=True)


def _lock(path: Path, what: str) -> IO[str]:
    """The file of `locked`, held."""
    while True:
        try:
            file = path.open("a", encoding="utf-8")
        except OSError as error:
            if error.errno in UNWRITABLE:
                raise InputError(f"cannot write in {path.parent}: {error.strerror}; choose another --out") from None
            raise
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
def replacing(path: Path, *, folder: bool = False) -> Iterator[Path]:
    """Where to write what becomes `path` when the block ends: a reader or a crash sees what was there before or all of it.

    folder: it is one, given empty.  After a kill at any point it is the old one, the new one, or (between two renames) absent,
    with the old one in `.NAME.previous` beside it.
    """
    partial = path.with_name(f".{short(path.name)}.partial-{os.getpid()}")  # another program may write there too
    previous = path.with_name(f".{path.name}.previous")
    try:
        if folder:
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove(partial)
            partial.mkdir()
        yield partial
        for file in partial.rglob("*") if folder else [partial]:
            if file.is_file():
                with file.open("rb") as stream:
                    os.fsync(stream.fileno())
        if folder and path.exists():
            _remove(previous)
            path.rename(previous)
        os.replace(partial, path)
    except BaseException as error:
        _remove(partial)
        if folder and previous.exists() and not path.exists():
            previous.rename(path)
        if isinstance(error, OSError) and error.errno:  # a full disk's has no name, others one that nobody gave
            error.filename = str(error.filename or path).replace(str(partial), str(path))
        raise
    _remove(previous if folder else partial)
    for abandoned in path.parent.glob(f".{glob.escape(short(path.name))}.partial-*"):  # of killed processes
        process = abandoned.name.rpartition("-")[2]
        if process.isdigit() and not psutil.pid_exists(int(process)):
            _remove(abandoned)


def short(name: str) -> str:
    """A name to which more may be added: of one that is too long a digest."""
    content = os.fsencode(name)
    return name if len(content) <= LONGEST else sha256(content).hexdigest()[:32]


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    elif os.path.lexists(path):  # which a name below a file is not
        path.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes) -> None:
    """Write content to path, whole or not at all (`replacing`)."""
    with replacing(path) as partial:
        partial.write_bytes(content)


@dataclass(frozen=True)
class KeptArrays:
    """Arrays in an .npz that a command leaves for the next one."""

    path: Path

    def read(self) -> dict[str, np.ndarray]:
        """By name; none where there is no file."""
        return read_arrays(self.path) if self.path.exists() else {}

    def write(self, **arrays: np.ndarray) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        content = BytesIO()
        np.savez(content, **arrays)  # pyright: ignore[reportArgumentType]
        write_atomically(self.path, content.getvalue())


def beside(folder: Path) -> Path:
    """Where the lock of a folder lies, which may not exist yet."""
    return folder.absolute().with_name(f".{short(folder.name)}.lock")


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
