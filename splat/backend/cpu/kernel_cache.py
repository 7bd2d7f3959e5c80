"""Where compiled kernels are kept between runs: a folder named after the code they were compiled from.

Numba looks at the date of the file that holds a kernel.  A kernel here has formulas of other files compiled into it, so a
changed formula would leave a stale kernel behind, and with it wrong numbers.  Instead the folder is named after the width of
the vectors and a digest of the modules that hold kernels and of all that these import from `splat`, directly or not: a change
to anything else (training, scenes) compiles nothing anew.  Folders of earlier code can be deleted at any time.
"""

import os
import re
from hashlib import sha256
from pathlib import Path

from numba.core import config

PACKAGE = Path(__file__).resolve().parents[2]
KERNEL = re.compile(r"^@(kernel|formula|intrinsic|overload)\b", re.MULTILINE)
IMPORT = re.compile(r"^from (splat[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


def kernel_folder(register_bits: int) -> Path:
    """The folder for this code and this width: in NUMBA_CACHE_DIR, else beside the code, else in the user's cache."""
    digest = sha256()
    for source in _sources():
        digest.update(source.relative_to(PACKAGE).as_posix().encode() + b"\0" + source.read_bytes())
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        base = Path(chosen)
    elif os.access(PACKAGE, os.W_OK):
        base = PACKAGE / "__pycache__"
    else:
        base = Path.home() / ".cache" / "splat-landscape"
    return base / f"kernels-{register_bits}-{digest.hexdigest()[:16]}"


def _sources() -> list[Path]:
    """The files that a kernel's code may come from."""
    texts = {path: path.read_text() for path in PACKAGE.rglob("*.py")}
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
    """Tell Numba; to be called before the first kernel is defined."""
    config.CACHE_DIR = str(kernel_folder(register_bits))  # pyright: ignore[reportAttributeAccessIssue]
