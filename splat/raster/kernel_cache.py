"""Where compiled kernels are kept between runs: a folder named after the code they were compiled from.

Numba looks at the date of the file that holds a kernel.  A kernel here has formulas of other files compiled into it, so a
changed formula would leave a stale kernel behind, and with it wrong numbers.  The digest of all of `splat` and the width of
the vectors name the folder instead; folders of earlier code can be deleted at any time.
"""

import os
from hashlib import sha256
from pathlib import Path

from numba.core import config

PACKAGE = Path(__file__).resolve().parents[1]


def kernel_folder(register_bits: int) -> Path:
    """The folder for this code and this width: in NUMBA_CACHE_DIR, else beside the code, else in the user's cache."""
    digest = sha256()
    for source in sorted(PACKAGE.rglob("*.py")):
        digest.update(source.relative_to(PACKAGE).as_posix().encode() + b"\0" + source.read_bytes())
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        base = Path(chosen)
    elif os.access(PACKAGE, os.W_OK):
        base = PACKAGE / "__pycache__"
    else:
        base = Path.home() / ".cache" / "splat-landscape"
    return base / f"kernels-{register_bits}-{digest.hexdigest()[:16]}"


def keep_kernels(register_bits: int) -> None:
    """Tell Numba; to be called before the first kernel is defined."""
    config.CACHE_DIR = str(kernel_folder(register_bits))  # pyright: ignore[reportAttributeAccessIssue]
