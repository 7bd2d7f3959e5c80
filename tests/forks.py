"""Programs as forks of one process that has everything imported: each begins at once, which saves seconds of a processor.

A `Program` is a process of its own with the folder, environment, session and streams that it is given.  What Python does before
it runs a module is done already: the libraries are imported, and `-P` says nothing.  Tests of that begin Python itself.
"""

import multiprocessing
import os
import resource
import runpy
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from multiprocessing.reduction import DupFd
from signal import SIGKILL, SIGTERM
from subprocess import DEVNULL, PIPE, STDOUT
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
import torch

SERVER: Any = forkserver._forkserver  # pyright: ignore[reportAttributeAccessIssue]


def processes() -> ForkServerContext:
    """Makes processes that have everything imported, and one thread each."""
    context = multiprocessing.get_context("forkserver")
    if SERVER._forkserver_address is None:
        context.set_forkserver_preload(["tests.hostile.readers", "tests.hostile.programs"])
        with patch.dict(os.environ, {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}):
            SERVER.ensure_running()
    return context


class Opened:
    """An open file on its way to a process."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[Any, tuple[Any]]:
        return _arrived, (DupFd(self.number),)


def _arrived(sent: Any) -> int:
    return sent.detach()


class Program:
    """What is used of `subprocess.Popen`, for [python, ..., "-m", module, words ...].  limit: the most bytes of a file."""

    def __init__(
        self,
        args: Sequence[str],
        cwd: Any = None,
        env: dict[str, str] | None = None,
        stdin: Any = DEVNULL,
        stdout: Any = DEVNULL,
        stderr: Any = DEVNULL,
        pass_fds: Sequence[int] = (),
        limit: int | None = None,
        **_others: bool,
    ) -> None:
        nowhere = os.open(os.devnull, os.O_RDWR)
        source, self._told = os.pipe() if stdin == PIPE else (nowhere, -1)
        self._said = [os.memfd_create("said") if each == PIPE else -1 for each in (stdout, stderr)]
        streams = [source]
        for given, own in zip((stdout, stderr), self._said):
            where = {PIPE: own, DEVNULL: nowhere, STDOUT: streams[-1]}
            streams.append(where[given] if isinstance(given, int) else given.fileno())
        begun, begin = os.pipe()
        words, files = [*args[args.index("-m") + 1 :]], [Opened(each) for each in (*streams, begin, *pass_fds)]
        about, make = (str(cwd or os.getcwd()), dict(os.environ if env is None else env), limit), processes()
        self._process = make.Process(target=_run, args=(words, SERVER._forkserver_address, *about, *files))
        self._process.start()
        for each in {source, nowhere, begin}:
            os.close(each)
        os.read(begun, 1)  # it has a session of its own
        os.close(begun)
        self.pid: int = self._process.pid  # pyright: ignore[reportAttributeAccessIssue]

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_error: object) -> None:
        self.wait()

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("a program", timeout or 0)
        return self.returncode

    def communicate(self, told: str = "", timeout: float | None = None) -> tuple[str, str]:
        """What it said, once it has ended; only once."""
        if self._told >= 0:
            os.write(self._told, told.encode())
            os.close(self._told)
        self.wait(timeout)
        self._told, said = -1, []
        for file in self._said:
            if file >= 0:
                os.lseek(file, 0, os.SEEK_SET)
            said.append(os.fdopen(file).read() if file >= 0 else "")
        self._said = [-1, -1]
        return said[0], said[1]

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(SIGTERM)

    def kill(self) -> None:
        self.send_signal(SIGKILL)


def _run(
    words: list[str], address: str, folder: str, environment: dict[str, str], limit: int | None, *files: int
) -> None:
    """In the new process: what Python does with a module.  files: its streams, one to say that it has begun, and others."""
    os.setsid()
    os.close(files[3])
    SERVER._forkserver_address, SERVER.ensure_running = address, lambda: None  # which forks what this one begins, too
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    for own in range(3):
        os.dup2(files[own], own)
    sys.stdin = os.fdopen(0, closefd=False)
    torch.set_num_threads(int(environment.get("OMP_NUM_THREADS", 1)))
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    sys.argv, sys.orig_argv = words, [sys.executable, "-m", *words]
    stand_in(pytest.MonkeyPatch())
    sys.modules.pop(words[0], None)
    runpy.run_module(words[0], run_name="__main__", alter_sys=True)


SWEEPS, DRAWING = "analysis.runs.sweep.sweep", "analysis.console.drawing"


def stand_in(patch: pytest.MonkeyPatch, *modules: str) -> None:
    """Have forks stand in for the programs that these modules, or else all, start."""
    for name in modules or (SWEEPS, DRAWING):
        patch.setattr(f"{name}.subprocess", SimpleNamespace(Popen=Program, PIPE=PIPE, DEVNULL=DEVNULL, STDOUT=STDOUT))
