"""Pictures of a record: the figures' own commands, each run in a process of its own.

`figures/` reads what this package wrote and is not imported here, so that the arrow between them points one way.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
Draw = Callable[[Path], list[str]]
"""Draws into a folder; returns what it warned of, or why it failed: the numbers stand without pictures."""


@contextmanager
def drawing(module: str) -> Iterator[Draw]:
    """`python -m figures.MODULE` of a folder that is named later: the process loads its libraries meanwhile."""
    with _group(f"figures.{module}", "-") as process:  # without a folder there is nothing to draw
        yield lambda target: _said(process, str(target.resolve()))


def draw(module: str, target: Path) -> list[str]:
    """Run `python -m figures.MODULE TARGET`, a folder or a file; as `Draw` does."""
    with _group(f"figures.{module}", target.resolve()) as process:
        return _said(process)


@contextmanager
def _group(module: str, *words: str | Path) -> Iterator[subprocess.Popen[str]]:
    """A process that ends with the block, and with it those that it has started: they would keep its output open for ever.

    It runs in the folder of the code: matplotlib reads a `matplotlibrc` of the current folder.
    """
    process = subprocess.Popen(
        **own_python(module, *words),
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def _said(process: subprocess.Popen[str], told: str = "") -> list[str]:
    """Warnings of the process, once it is told this and has ended."""
    lines = [line for line in process.communicate(told)[1].splitlines() if line.strip()]
    if process.returncode < 0:
        name = signal.Signals(-process.returncode).name
        return [f"drawing failed: ended by {name}" + ", as Linux does where memory runs out" * (name == "SIGKILL")]
    if process.returncode:
        return ["drawing failed: " + " ".join(" ".join(lines).split())]
    return [line.split("Warning: ", 1)[1] for line in lines if "Warning: " in line]


def own_python(module: str, *words: object, **environment: str) -> dict[str, Any]:
    """Arguments of `subprocess` for `python -m MODULE WORDS`: every Python that this program starts.

    It imports this program and what is installed, nothing from the current folder, which may be a stranger's scene.
    environment: added to that of this process.
    """
    command = [sys.executable, "-P", "-m", module, *map(str, words)]
    return {"args": command, "env": {**os.environ, "PYTHONPATH": str(ROOT), **environment}}
