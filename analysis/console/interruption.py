"""Ctrl-C, or a scheduler's SIGTERM, in long work that can save first."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def interruption() -> Iterator[Event]:
    """The first signal only sets the event, so that what is under way ends; a second one interrupts at once."""
    event = Event()
    # None: a handler that is none of Python's, such as a library's that prints a stack trace
    before = {each: signal.getsignal(each) or signal.SIG_DFL for each in SIGNALS}

    def restore() -> None:
        for each, handler in before.items():
            signal.signal(each, handler)

    def first(*_: object) -> None:
        event.set()
        restore()

    for each in SIGNALS:
        signal.signal(each, first)
    try:
        yield event
    finally:
        restore()
