"""Ctrl-C, a scheduler's SIGTERM, a terminal that closes: what is under way is left in order, the exit code names the signal."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Event, Timer, current_thread, main_thread
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
DEAF = "_unheard"  # how the names of our functions begin in which nothing may be raised
DEAF_FILES = (
    "<frozen importlib._bootstrap>",  # Python's own code that loads modules
    os.path.join("llvmlite", "binding", "ffi.py"),  # LLVM's lock, and what LLVM calls while it compiles
)
LOCKING = ("__enter__", "__exit__", "acquire", "release")  # where a lock is held and nobody knows it yet, or any more
AGAIN = 0.01  # seconds until a signal that came where nothing can be raised is sent again


class Interrupted(KeyboardInterrupt):
    """A signal that interrupted what was under way."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number

    def __str__(self) -> str:
        return f"interrupted by {signal.Signals(self.number).name}"

    @property
    def exit_code(self) -> int:
        """128 + its number, as shells have it."""
        return 128 + self.number


class Interruption(Event):
    """Set by the first signal.  exit_code: for a command that it ended."""

    exit_code = 0


@contextmanager
def raising() -> Iterator[None]:
    """Signals raise `Interrupted` wherever the main thread is, so that what it has begun is cleaned up.

    Where Python drops what is raised, in finalizers and what C calls, while a library is loaded, whose C may end the
    process for it, and as a lock is taken, which another thread would wait for without end, the signal is sent again
    until it is heard, or the block ends.  An error after it stands for it.
    """
    raised, waiting = list[Interrupted](), list[tuple[Timer, int]]()

    def send_again(number: int) -> None:
        timer = Timer(AGAIN, os.kill, (os.getpid(), number))
        waiting.append((timer, number))
        timer.daemon = True
        timer.start()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _is_deaf(frame):
            return send_again(number)
        raised.append(Interrupted(number))
        raise raised[-1]

    def dropped(found: Any) -> None:
        if isinstance(found.exc_value, Interrupted):
            send_again(found.exc_value.number)
        else:
            before(found)

    before, sys.unraisablehook = sys.unraisablehook, dropped
    try:
        with _handled(interrupt):
            try:
                yield
            finally:
                late = [number for timer, number in waiting if timer.is_alive()]
                for timer, _ in waiting:
                    timer.cancel()
            if late:
                raise Interrupted(late[-1])
    except Exception as error:
        if raised:
            raise raised[-1] from error
        raise
    finally:
        sys.unraisablehook = before


def _is_deaf(frame: FrameType | None) -> bool:
    """Whether nothing may be raised in what the frame runs, or what called it."""
    if frame is not None and frame.f_code.co_name in LOCKING:
        return True
    while frame is not None:
        if frame.f_code.co_name.startswith(DEAF) or frame.f_code.co_filename.endswith(DEAF_FILES):
            return True
        frame = frame.f_back
    return False


def end_at_once() -> None:
    """A signal ends the process from now on, in a line: while libraries are loaded there is nothing to leave in order."""

    def end(number: int, _: FrameType | None) -> None:
        with suppress(OSError):
            os.write(2, f"landscape: {Interrupted(number)}\n".encode())
        os._exit(Interrupted(number).exit_code)

    _for_good(end)


def ignore() -> None:
    """Signals change nothing from now on: the work is done."""
    _for_good(signal.SIG_IGN)


def _for_good(handler: "Callable[[int, FrameType | None], None] | signal.Handlers") -> None:
    for each in SIGNALS:
        if signal.getsignal(each) is not signal.SIG_IGN:
            signal.signal(each, handler)


@contextmanager
def interruption() -> Iterator[Interruption]:
    """The first signal only sets the event, so that what is under way ends; a second one does what it did before."""
    event = Interruption()

    def first(number: int, _: FrameType | None) -> None:
        event.exit_code = Interrupted(number).exit_code
        event.set()
        restore()

    with _handled(first) as restore:
        yield event


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[Callable[[], None]]:
    """Handle the signals in the block, but for those that are ignored, as under nohup; gives what ends it earlier."""
    before = {each: signal.getsignal(each) for each in SIGNALS} if current_thread() is main_thread() else {}

    def restore() -> None:
        for each, old in before.items():
            signal.signal(each, signal.SIG_DFL if old is None else old)  # None: a handler that is none of Python's

    for each, old in before.items():
        if old is not signal.SIG_IGN:
            signal.signal(each, handler)
    try:
        yield restore
    finally:
        restore()
