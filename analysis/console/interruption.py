"""Ctrl-C, a scheduler's SIGTERM, a terminal that closes: a flag, at which long work looks between its stages and steps.

Where nobody listens a signal ends the process: what it writes is written whole or not at all.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from threading import Event, current_thread, main_thread
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SAID = "ending after this step; another one ends it at once"


class Interrupted(KeyboardInterrupt):
    """Raised by `look` once the flag is set.  exit_code: 128 + the number of the signal, as shells have it."""

    def __init__(self, number: int) -> None:
        super().__init__(f"interrupted by {signal.Signals(number).name}")
        self.exit_code = 128 + number


class Interruption(Event):
    """The flag.  number: of the signal that set it."""

    number = 0

    @property
    def exit_code(self) -> int:
        """For a command that the signal ended; 0 without one."""
        return 128 + self.number if self.is_set() else 0


_flag: Interruption | None = None  # of the command that listens


@contextmanager
def interruption() -> Iterator[Interruption]:
    """Listen in the block: the first signal sets the flag, also of a block within; a second one does what it did before."""
    global _flag
    if _flag is not None or current_thread() is not main_thread():
        yield _flag or Interruption()
        return

    def first(number: int, _: FrameType | None) -> None:
        flag.number = number
        flag.set()
        _handle(before)
        with suppress(OSError):
            os.write(2, f"landscape: {signal.Signals(number).name}: {SAID}\n".encode())

    flag = _flag = Interruption()
    before = _handle(dict.fromkeys(SIGNALS, first))
    try:
        yield flag
    finally:
        _flag = None
        _handle(before)


def look() -> None:
    """Raise Interrupted where the flag is set."""
    if _flag is not None and _flag.is_set():
        raise Interrupted(_flag.number)


@contextmanager
def loading() -> Iterator[None]:
    """Load libraries in the block: there a signal ends the process at once, in a line, as their C code drops Python's
    exceptions, and pycolmap handles SIGTERM itself."""

    def end(number: int, _: FrameType | None) -> None:
        with suppress(OSError):
            os.write(2, f"landscape: {Interrupted(number)}\n".encode())
        os._exit(Interrupted(number).exit_code)

    before = _handle(dict.fromkeys(SIGNALS, end)) if current_thread() is main_thread() else {}
    try:
        yield
    finally:
        _handle(before)


def command() -> None:
    """The `landscape` program: a signal is told in a line also while its commands are loaded."""
    with loading():
        cli = import_module("analysis.commands.cli")
    cli.command()


def _handle(handlers: dict[signal.Signals, Any]) -> dict[signal.Signals, Any]:
    """Handle signals so, but for those that are ignored, as under nohup; returns how they were handled."""
    before = {each: signal.getsignal(each) for each in handlers}
    for each, handler in handlers.items():
        if before[each] is not signal.SIG_IGN:
            signal.signal(each, signal.SIG_DFL if handler is None else handler)  # None: one that is none of Python's
    return before
