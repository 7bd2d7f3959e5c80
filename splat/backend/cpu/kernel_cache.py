"""Cache of compiled kernels between runs: a folder named after the code they were compiled from.

Numba looks at the date of the file that holds a kernel.  A kernel here has formulas of other files compiled into it, so a
changed formula would leave a stale kernel behind, and with it wrong numbers.  Instead the folder is named after the width of
the vectors and a digest of the modules that hold kernels and of all that these import from `splat`, directly or not: a change
to anything else (training, scenes) compiles nothing anew.  Folders of earlier code can be deleted at any time.
"""

import os
import re
from contextlib import ExitStack, suppress
from fcntl import LOCK_EX, flock
from hashlib import sha256
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from uuid import uuid4

from numba.core import caching, config
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from landscape.errors import InputError

PACKAGE = Path(__file__).resolve().parents[2]
KERNEL = re.compile(r"^@(kernel|formula|intrinsic|overload)\b", re.MULTILINE)
IMPORT = re.compile(r"^from (splat[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


def kernel_folder(register_bits: int) -> Path:
    """The folder for this code and this width: in the first place of `_places` where it can be written."""
    digest = sha256()
    for source in _sources():
        digest.update(source.relative_to(PACKAGE).as_posix().encode() + b"\0" + source.read_bytes())
    for base in _places():
        folder = base / f"kernels-{register_bits}-{digest.hexdigest()[:16]}"
        if _is_ours(folder):
            return folder
    raise InputError(
        f"expected a folder for compiled kernels that can be written and is nobody else's, found none among "
        f"{', '.join(map(str, _places()))}; name one with NUMBA_CACHE_DIR"
    )


def _places() -> list[Path]:
    """NUMBA_CACHE_DIR alone, where it is set; else beside the code, the user's cache, and one for temporary files."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(chosen)]
    home = Path(os.path.expanduser("~"))  # remains as it is where there is none
    caches = [home / ".cache" / "splat-landscape"] if home.is_dir() else []
    with suppress(OSError):  # no folder for temporary files can be written
        caches.append(Path(gettempdir()) / f"splat-landscape-{os.getuid()}")
    return [PACKAGE / "__pycache__", *caches]


def _is_ours(folder: Path) -> bool:
    """Whether a folder can be written, made if it must be, by this user alone: what lies in it is run."""
    try:
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        found = [folder.stat(), folder.parent.stat()]
    except OSError:
        return False
    return os.access(folder, os.W_OK) and all(map(_is_this_users, found))


def _is_this_users(found: os.stat_result) -> bool:
    """Whether nobody else may write there: not all, nor a group but the user's own."""
    shared = found.st_mode & 0o002 or (found.st_mode & 0o020 and found.st_gid != os.getgid())
    return found.st_uid in (os.getuid(), 0) and not shared


def _sources() -> list[Path]:
    """The files that a kernel's code may come from."""
    texts = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    pending = [path for path, text in texts.items() if KERNEL.search(text)]
    found = set(pending)
    while pending:
        for package, names in IMPORT.findall(texts[pending.pop()]):
            parts = package.split(".")[1:]
            folder = PACKAGE.joinpath(*parts)
            candidates = [folder.with_suffix(".py"), *(folder / f"{name}.py" for name in re.findall(r"\w+", names))]
            new = [path for path in candidates if path in texts and path not in found]
            found.update(new)
            pending.extend(new)
    return sorted(found)


def keep_kernels(register_bits: int) -> None:
    """Make Numba use the cache; to be called before the first kernel is defined."""
    config.CACHE_DIR = str(kernel_folder(register_bits))  # pyright: ignore[reportAttributeAccessIssue]
    caching.IndexDataCacheFile = _CacheFile  # pyright: ignore[reportAttributeAccessIssue]
    Dispatcher.compile = _compile


def _compile(self: Any, sig: Any, at_once: Any = Dispatcher.compile) -> Any:
    """Numba's; a kernel that another process compiles is waited for.  Callers are locked first: no two wait for each other."""
    with global_compiler_lock, ExitStack() as locked:  # one thread of each process
        if cache := getattr(self._cache, "_cache_file", None):  # a formula has none
            with suppress(OSError):  # no room for the lock, or a file system without any
                lock = os.open(f"{cache._index_path}.lock", os.O_RDWR | os.O_CREAT)
                locked.callback(os.close, lock)
                flock(lock, LOCK_EX)
        return at_once(self, sig)


class _CacheFile(caching.IndexDataCacheFile):
    """Numba's cache file, but for four things.

    A damaged file, such as one that a full disk cut, counts as missing: its kernel is compiled anew.  Files have names of their
    own, as two processes that compile at a time would give one name to two kernels.  Dates of sources do not count: the folder
    is named after their content.  The error of a full disk says which file it is.
    """

    def __init__(self, cache_path: str, filename_base: str, source_stamp: object) -> None:
        super().__init__(cache_path, filename_base, None)

    def save(self, key: Any, data: Any) -> None:
        try:
            super().save(key, data)
        except OSError as error:
            error.filename = error.filename or self._index_path
            raise

    def _data_name(self, number: int) -> str:
        return f"{super()._data_name(number).removesuffix('.nbc')}.{uuid4().hex[:8]}.nbc"

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:  # unpickling raises nearly anything
            return {}

    def _load_data(self, name: str) -> Any:
        try:
            return super()._load_data(name)
        except Exception as error:
            raise FileNotFoundError(name) from error  # which Numba expects of a file
