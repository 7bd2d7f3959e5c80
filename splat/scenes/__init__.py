"""Scenes, and pycolmap, which is imported here for all.

It brings a zlib whose functions the system's own libz would call too where pycolmap is what loads that, and end the process at
the next PNG: Python's zlib loads it before.  It takes SIGTERM for itself, to print a C++ stack trace: the handler is put back.
And what a signal raises as it loads it takes for a fault of its own, or drops: signals that have a handler wait so long.
"""

import signal
import zlib  # noqa: F401
from threading import current_thread, main_thread

_handlers, _came = {}, []
if current_thread() is main_thread():
    _handlers = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
for _each, _handler in _handlers.items():
    if callable(_handler):
        signal.signal(_each, lambda number, _: _came.append(number))

import pycolmap  # noqa: E402, F401

for _each, _handler in _handlers.items():
    if _handler is not None:
        signal.signal(_each, _handler)
for _each in _came:
    signal.raise_signal(_each)
