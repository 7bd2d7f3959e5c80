"""Ctrl-C in long work that can save first."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event


@contextmanager
def interruption() -> Iterator[Event]:
    """The first Ctrl-C only sets the event, so that what is under way ends; a second one interrupts at once."""
    event = Event()
    before = signal.getsignal(signal.SIGINT)

    def first(*_: object) -> None:
        event.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, first)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)
