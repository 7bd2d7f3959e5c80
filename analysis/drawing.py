"""Pictures of a record: the figures' own commands, each run in a process of its own.

`figures/` reads what this package wrote and is not imported here, so that the arrow between them points one way; a
renderer that ends its process (VTK does, where OpenGL is missing) cannot take a probe along.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
Draw = Callable[[Path], list[str]]
"""Draws into a folder; returns what it warned of.  Raises RuntimeError with its words if it failed."""


@contextmanager
def drawing(module: str, *options: str) -> Iterator[Draw]:
    """`python -m figures.MODULE OPTIONS` of a folder that is named later: the process loads its libraries meanwhile."""
    command = [sys.executable, "-m", f"figures.{module}", *options]
    process = subprocess.Popen(
        [*command, "-"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=module_environment(),
    )

    def draw(target: Path) -> list[str]:
        said = process.communicate(str(target))[1]
        return _warnings([*command, str(target)], process.returncode, said)

    try:
        yield draw
    finally:  # without a folder there is nothing to draw
        process.kill()
        process.communicate()


def draw(module: str, target: Path, *options: str) -> list[str]:
    """Run `python -m figures.MODULE OPTIONS TARGET`, a folder or a file; as `Draw` does."""
    command = [sys.executable, "-m", f"figures.{module}", *options, str(target)]
    done = subprocess.run(command, capture_output=True, text=True, env=module_environment())
    return _warnings(command, done.returncode, done.stderr)


def _warnings(command: list[str], returncode: int, said: str) -> list[str]:
    lines = [line for line in said.splitlines() if line.strip()]
    if returncode:
        raise RuntimeError(f"drawing failed; draw again with: {' '.join(command)}\n" + "\n".join(lines))
    return [line.split("Warning: ", 1)[1] for line in lines if "Warning: " in line]


def module_environment() -> dict[str, str]:
    """In which `python -m` finds the modules of this repository, and all that this process finds."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
