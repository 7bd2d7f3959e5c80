"""Signals that come where Python drops what is raised."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path

import pytest
from llvmlite.binding import ffi

from analysis.console.failures import program
from analysis.console.interruption import AGAIN, SIGNALS, Interrupted, raising
from tests.waiting import PATIENCE

ROOT = Path(__file__).parents[3]


def waits_after(signalled: Callable[[], object]) -> None:
    signalled()
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        time.sleep(0.01)


class Finalized:
    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0)


def test_a_signal_in_a_finalizer_is_heard_after_it(capsys):
    with pytest.raises(Interrupted) as raised, raising():
        waits_after(Finalized)
    assert raised.value.exit_code == 143 and "ignored" not in capsys.readouterr().err


def test_a_signal_in_what_llvm_calls_lets_it_do_its_work_first():
    done = []

    @ctypes.CFUNCTYPE(None)
    def called() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0)
        done.append(True)

    with pytest.raises(Interrupted) as raised, raising():
        waits_after(ffi._lib_fn_wrapper(ffi._LLVMLock(), called))
    assert done and raised.value.exit_code == 130


def test_a_signal_as_a_lock_is_taken_or_given_back_leaves_it_free():
    class Locked:
        held = False

        def __enter__(self) -> None:
            self.held = True
            os.kill(os.getpid(), signal.SIGTERM)

        def __exit__(self, *_: object) -> None:
            os.kill(os.getpid(), signal.SIGHUP)
            self.held = False

    def waits_in(lock: AbstractContextManager[object]) -> None:
        with lock:
            waits_after(lambda: None)

    for lock, held in ((Locked(), lambda lock: lock.held), (ffi._LLVMLock(), lambda lock: lock._lock._is_owned())):
        if isinstance(lock, ffi._LLVMLock):
            lock.register(lambda: os.kill(os.getpid(), signal.SIGTERM), lambda: os.kill(os.getpid(), signal.SIGHUP))
        with pytest.raises(Interrupted), raising():
            waits_in(lock)
        assert not held(lock)


def test_a_signal_while_a_library_is_loaded_is_heard_once_it_is(tmp_path, monkeypatch):
    lines = "import os, signal, time\nos.kill(os.getpid(), signal.SIGTERM)\ntime.sleep(0.2)\nloaded = True\n"
    (tmp_path / "interrupted.py").write_text(lines)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Interrupted) as raised, raising():
        waits_after(lambda: import_module("interrupted"))
    assert sys.modules.pop("interrupted").loaded and raised.value.exit_code == 143


def test_a_signal_while_the_last_library_is_loaded_is_heard_at_the_end(tmp_path, monkeypatch):
    (tmp_path / "interrupted.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Interrupted) as raised, raising():
        import_module("interrupted")
    del sys.modules["interrupted"]
    time.sleep(4 * AGAIN)  # in which none comes any more
    assert raised.value.exit_code == 143


@pytest.mark.parametrize("began", ["landscape", "-m"])
def test_a_signal_while_a_program_loads_libraries_ends_it_in_a_line(began):
    program = f"import sys; sys.argv[0] = {began!r}\nimport analysis, os, signal, time\n"
    program += f"os.kill(os.getpid(), signal.SIGINT)\ntime.sleep({PATIENCE})"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "landscape: interrupted by SIGINT\n")


def test_a_script_of_figures_answers_a_signal_as_commands_do():
    def interrupted() -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(PATIENCE)
        return 0

    handlers = {each: signal.getsignal(each) for each in SIGNALS}
    try:
        with pytest.raises(SystemExit) as ended:
            program(interrupted)
        assert ended.value.code == 143 and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)


def test_what_a_library_makes_of_a_signal_is_that_signal():
    def loaded() -> None:
        try:
            os.kill(os.getpid(), signal.SIGHUP)
            time.sleep(1)
        except BaseException as error:  # as pycolmap does, whose module's C is interrupted
            raise RuntimeError("cannot import it") from error

    with pytest.raises(Interrupted) as raised, raising():
        loaded()
    assert raised.value.exit_code == 129


def test_an_error_that_no_signal_came_before_stays_what_it_is():
    with pytest.raises(RuntimeError, match="cannot import it"), raising():
        raise RuntimeError("cannot import it")
