"""Signals that come where Python drops what is raised."""

import ctypes
import os
import signal
import time
from collections.abc import Callable

import pytest

from analysis.console.interruption import Interrupted, raising


def waits_after(signalled: Callable[[], object]) -> None:
    signalled()
    end = time.monotonic() + 10
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
    def _raw_object_cache_notify() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0)
        done.append(True)

    with pytest.raises(Interrupted) as raised, raising():
        waits_after(_raw_object_cache_notify)
    assert done and raised.value.exit_code == 130


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
