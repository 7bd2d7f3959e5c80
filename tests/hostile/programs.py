"""A command in a process of its own: a fork of this one, which has everything imported, or a program."""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

import splat.render.cpu.raster  # noqa: F401
from analysis.commands import cli
from analysis.console import drawing
from analysis.console.failures import program as run_program

ROOT = Path(__file__).parents[2]
LATE = ("matplotlib.figure", "pandas", "scipy.sparse.csgraph", "torch.fx.experimental.symbolic_shapes")
for _name in (*LATE, *(f"analysis.{each.runs.split(':')[0]}" for each in cli.COMMANDS.values())):
    import_module(_name)


class forked:
    """A fork that runs a function, quietly and without pictures, and ends with what it returns."""

    def __init__(self, run: Callable[[], int], said: Path = Path(os.devnull)) -> None:
        """said: the file for what it prints."""
        ready, begun = os.pipe()
        self.process = os.fork()
        if self.process == 0:
            drawing._group, drawing._said = lambda *_: nullcontext(), lambda *_: []
            quiet = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            code: Any = 70

            def begin() -> int:
                os.write(begun, b".")
                return run()

            try:
                run_program(begin)
            except SystemExit as ended:
                code = ended.code
            finally:
                os._exit(code)
        os.close(begun)
        os.read(ready, 1)
        os.close(ready)

    def send_signal(self, number: int) -> None:
        os.kill(self.process, number)

    def wait(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])

    def poll(self) -> int | None:
        """The exit code of one that has come to its end."""
        process, status = os.waitpid(self.process, os.WNOHANG)
        return os.waitstatus_to_exitcode(status) if process else None


def program(words: list[str], module: str = cli.__name__) -> subprocess.Popen[bytes]:
    """The command as a program of its own; module: whose."""
    command = [sys.executable, "-m", module, *words]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
