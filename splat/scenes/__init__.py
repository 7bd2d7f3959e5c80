"""Scenes, and pycolmap, which is imported here for all.

It brings a zlib whose functions the system's own libz would call too where pycolmap is what loads that, and end the process at
the next PNG: Python's zlib loads it before.  And it takes SIGTERM for itself, to print a C++ stack trace: the handler is put
back.
"""

import signal
import zlib  # noqa: F401
from threading import current_thread, main_thread

_handler = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402, F401

if _handler is not None and current_thread() is main_thread():
    signal.signal(signal.SIGTERM, _handler)
