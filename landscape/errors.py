"""Errors whose cause lies outside of the program: bad input, and a machine that lacks memory or disk space.

Raise `InputError` for what whoever gave the arguments, files or settings can mend, with one sentence: what was expected, what
came, what to do.  Anything else that is raised is a fault of the program, for which its traceback is needed.
"""

import errno
from collections.abc import Iterable
from difflib import get_close_matches

FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the last: a limit on the size of files
OUT_OF_MEMORY = (  # words of torch, of Python's threads and of C++
    "allocate memory", "not enough memory", "out of memory", "can't start new thread", "bad_alloc",
)  # fmt: skip


class InputError(ValueError):
    """Input, settings, a file, a scene, a checkpoint or an operator that cannot be used as given."""


class TooLittleMemory(MemoryError):
    """Less memory than is known to be needed: says how much, and what would fit."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of a message about a name that is none of the known ones.

    >>> did_you_mean("warmup", ["warm_up", "gamma"]), did_you_mean("teapot", ["gamma"])
    ('; did you mean warm_up?', '')
    """
    near = get_close_matches(name, list(known), n=1, cutoff=0.7)
    return f"; did you mean {near[0]}?" if near else ""


def lacks_memory(error: BaseException) -> bool:
    """Whether memory, the machine's or a GPU's, ran out.

    >>> lacks_memory(MemoryError()), lacks_memory(RuntimeError("CUDA out of memory")), lacks_memory(ValueError("memory"))
    (True, True, False)
    """
    words = str(error).lower()
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError | ImportError) and any(text in words for text in OUT_OF_MEMORY)
    )


def lacks_space(error: BaseException) -> bool:
    """Whether the disk, or the user's share of it, is full.

    >>> lacks_space(OSError(errno.ENOSPC, "No space left on device")), lacks_space(FileNotFoundError())
    (True, False)
    """
    return isinstance(error, OSError) and error.errno in FULL_DISK
