"""Scenes.  When it is imported, pycolmap takes SIGTERM for itself, to print a C++ stack trace: the handler is put back here."""

import signal
from threading import current_thread, main_thread

_handler = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402, F401

if _handler is not None and current_thread() is main_thread():
    signal.signal(signal.SIGTERM, _handler)
