"""What a command says of an error, and its exit code.

    0    done
    1    a self-check failed under --strict, a bound of `bench stress` was exceeded, or a cell of a sweep failed
    2    bad input: one sentence that says what was expected, what came and what to do
    70   a fault of the program: its traceback, and how to report it
    71   memory ran out, or would
    74   the disk is full, or a limit on the size of files is reached
    75   another sweep is at a cell of this one; the same command later finds it done
    130  interrupted by Ctrl-C; 143 by SIGTERM, 129 by a terminal that closed
    141  nobody reads the help any more, as after `| head -1`

Where nobody reads what a command says any more, it works on quietly.  A file or folder that cannot be opened is bad input.
Numbers as in `sysexits.h`, and 128 + the number of the signal.
"""

import shlex
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import NoReturn

from analysis.console.interruption import Interrupted
from analysis.console.plain import OBEYED
from landscape.errors import InputError, TooLittleMemory, lacks_memory, lacks_space

LONGEST = 4000  # characters of a sentence; the list of all settings, the longest of our own, takes a third
BAD_INPUT, BUG, NO_MEMORY, FULL_DISK, INTERRUPTED, NO_READER = 2, 70, 71, 74, 130, 141


def describe(error: BaseException) -> tuple[int, str]:
    """The exit code and the sentence for an error.

    >>> describe(InputError("expected a scene, got a teapot"))
    (2, 'expected a scene, got a teapot')
    >>> describe(PermissionError(13, "Permission denied", "scene/images"))
    (2, 'cannot use scene/images: Permission denied')
    >>> describe(MemoryError())[0], describe(OSError(28, "No space left on device"))[0], describe(KeyboardInterrupt())[0]
    (71, 74, 130)
    >>> describe(ZeroDivisionError())[0]
    70
    """
    text = " ".join(str(error).split()).translate(OBEYED)
    if len(text) > LONGEST:  # a damaged file's own words may be megabytes
        text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 4 :]}"
    if isinstance(error, Interrupted):
        return error.exit_code, str(error)
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, "interrupted"
    if isinstance(error, BrokenPipeError):
        return NO_READER, ""
    if isinstance(error, TooLittleMemory):
        return NO_MEMORY, text
    if lacks_memory(error):
        return NO_MEMORY, f"memory ran out; take fewer Gaussians or smaller images, or end other programs ({text})"
    if isinstance(error, OSError):
        named, name = error.filename is not None and error.strerror is not None, str(error.filename).translate(OBEYED)
        if lacks_space(error):
            return FULL_DISK, f"the disk is full{f' ({name})' if named else ''}; free space and run it again"
        if named:
            return BAD_INPUT, f"cannot use {name}: {error.strerror}"
    if isinstance(error, InputError) or (isinstance(error, OSError) and error.errno is None):  # in the program's words
        return BAD_INPUT, text
    return BUG, "this is a fault of the program; please report it with all of the above and what the command read"


def report(error: BaseException, command: Sequence[str], debug: bool = False) -> int:
    """Say what went wrong on stderr; returns the exit code.  debug: with the traceback, whatever the error is."""
    code, sentence = describe(error)
    if lacking := getattr(error, "__notes__", []):  # options that the command needs: the whole command
        sentence = f"{sentence}; take: {' '.join([shlex.join(command), *lacking])}"
    if debug or code == BUG:
        traceback.print_exception(error)
    if code == BUG:
        print(f"command: {shlex.join(command)}", file=sys.stderr)
    if sentence:
        print(f"landscape: {sentence}", file=sys.stderr)
    return code


def program(main: Callable[[], int | None]) -> NoReturn:
    """The main function of a module that is run as a program: ends the process with its exit code, or that of its error."""
    try:
        code = main() or 0
    except (Exception, KeyboardInterrupt) as error:
        code = report(error, sys.orig_argv)
    sys.exit(code)
