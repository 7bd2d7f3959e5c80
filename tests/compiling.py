"""Kernels of the CPU are compiled once for all processes of a run: who needs one that another compiles waits for it alone."""

import os
from fcntl import LOCK_EX, LOCK_UN, lockf
from typing import Any
from zlib import crc32

from numba.core import config
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

import splat.backend.cpu.simd  # noqa: F401  where kernels are kept


def compile_each_once() -> None:
    """A byte of one file for each function, locked by whom compiles it.

    A function is locked before those that it calls, so that no two wait for each other; and within a process by the thread that
    has Numba's own lock.
    """
    folder: Any = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
    held, compiled = os.open(f"{folder}/compiling", os.O_RDWR | os.O_CREAT), Dispatcher.compile

    def compile_once(self: Any, sig: Any) -> Any:
        with global_compiler_lock:
            code = self.py_func.__code__
            place = crc32(f"{code.co_filename}:{code.co_firstlineno}".encode())
            lockf(held, LOCK_EX, 1, place)
            try:
                return compiled(self, sig)
            finally:
                lockf(held, LOCK_UN, 1, place)

    Dispatcher.compile = compile_once
