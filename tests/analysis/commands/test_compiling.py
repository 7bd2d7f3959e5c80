"""That kernels are compiled is said, once; a probe's are compiled ahead, by a process that ends with the command's."""

import io
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from numba import njit
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from rich.console import Console

from analysis.commands.cli import main
from analysis.commands.compiling import SAID, call_what_a_probe_calls, compiling_is_said
from tests.forks import processes
from tests.waiting import PATIENCE, waits_for

ROOT = Path(__file__).parents[3]
AHEAD = """
import os, time
from numba.core import config
from analysis.commands.compiling import compile_ahead

def children():
    compile_ahead()
    return open(f"/proc/self/task/{os.getpid()}/children").read()

first, all_of_them = children(), os.sched_getaffinity(0)
os.sched_setaffinity(0, {min(all_of_them)})
again = [children()]
os.sched_setaffinity(0, all_of_them)
open(f"{config.CACHE_DIR}/of-a-probe", "w")
print(first, [*again, children()] == 2 * [first], flush=True)
time.sleep(1200)
"""


def test_what_is_compiled_is_said_once_and_what_is_known_is_not():
    first, second = (njit(lambda x, step=step: x + step) for step in (1, 2))
    said = io.StringIO()
    with compiling_is_said(Console(file=said, width=200)):
        assert first(1) == 2
        assert said.getvalue() == f"{SAID}\n"
        assert second(1) == 3 and first(2) == 3
    assert said.getvalue() == f"{SAID}\n"
    again = io.StringIO()
    with compiling_is_said(Console(file=again)):
        assert first(3) == 4
    assert again.getvalue() == ""


def kernels() -> set[tuple[str, str]]:
    """Those that are kept, and were called in this process, with the types of their arguments."""
    defined = [each for module in [*sys.modules.values()] for each in vars(module).values()]
    kept: list[Any] = [each for each in defined if isinstance(each, Dispatcher)]
    return {
        (f"{each.py_func.__module__}.{each.py_func.__name__}", str(sig))
        for each in kept
        if isinstance(each._cache, FunctionCache)
        for sig in each.overloads
    }


def _train_and_probe(scene: Path, run: Path) -> None:
    pytest.MonkeyPatch().setattr("analysis.console.drawing.drawing", lambda module: nullcontext(lambda target: []))
    call_what_a_probe_calls()
    ahead = kernels()
    assert main(["train", str(scene), "--out", str(run), "--iterations", "6"]) == 0
    trained = kernels()
    assert main(["probe", str(run), "--quick"]) == 0
    assert ahead and kernels() - trained == set()


def test_a_probe_after_a_training_finds_all_kernels_compiled_ahead(original, tmp_path):
    process = processes().Process(target=_train_and_probe, args=(original, tmp_path / "run"))
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == 0


@pytest.mark.skipif(sys.platform != "linux", reason="a process that ends with another is Linux's")
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="the command needs the only processor")
def test_what_compiles_ahead_ends_with_the_command_and_is_begun_once_where_a_processor_is_free(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "CUDA_VISIBLE_DEVICES": ""}
    command, pipe = [sys.executable, "-c", AHEAD], subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        number, alone = process.stdout.readline().split()
        stat = Path(f"/proc/{number}/stat")
        states = [stat.read_text().split()[2]]
        process.kill()
        waits_for(lambda: not stat.exists() or stat.read_text().split()[2] in "ZX")
        assert process.stderr.read() == "" and alone == "True" and states[0] in "RSD"
