"""Waiting for other processes: the limit ends what hangs, and asks for no speed of whatever machine, however loaded."""

import time
from collections.abc import Callable
from typing import Any

PATIENCE = 1200.0  # seconds: the kernels take four minutes of a processor to compile, of which others may leave a fifth


def waits_for(ready: Callable[[], object], process: Any = None) -> None:
    """Return as soon as something is so; a process that would have made it so must not have ended before."""
    end = time.monotonic() + PATIENCE
    while not ready():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.002)
