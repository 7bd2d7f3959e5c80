"""Signals: a flag that is looked at between steps."""

import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from analysis.console.interruption import SIGNALS, Interrupted, interruption, look
from analysis.console.stages import Stages

ROOT = Path(__file__).parents[3]


def test_the_first_signal_is_heard_where_work_looks_and_a_second_does_what_it_did_before():
    before, done = [signal.getsignal(each) for each in SIGNALS], []
    stages = Stages()

    def work() -> None:
        with interruption() as flag, interruption() as inner, stages.stage("one") as report:
            assert inner is flag and flag.exit_code == 0
            os.kill(os.getpid(), signal.SIGTERM)
            done.append(flag.exit_code)
            assert [signal.getsignal(each) for each in SIGNALS] == before
            report(1, 2, "")

    with pytest.raises(Interrupted) as raised:
        work()
    assert raised.value.exit_code == 143 and str(raised.value) == "interrupted by SIGTERM" and done == [143]
    assert "one" not in stages.timing
    look()  # nobody listens
    with interruption() as again:
        assert not again.is_set()


def test_signals_that_are_ignored_stay_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup leaves it
    try:
        with interruption():
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("kind", SIGNALS)
def test_a_signal_ends_a_program_that_loads_libraries_in_a_line_and_importing_ours_leaves_them_as_they_were(kind):
    """But for SIGTERM, which pycolmap takes, and `loading` gives back."""
    program = (
        "import os, signal\nfrom analysis.console.interruption import SIGNALS, loading\n"
        "handlers = [signal.getsignal(each) for each in SIGNALS]\n"
        "with loading():\n    import splat.scenes\nassert [signal.getsignal(each) for each in SIGNALS] == handlers\n"
        f"with loading():\n    os.kill(os.getpid(), {int(kind)})\nprint('not ended')"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    said = f"landscape: interrupted by {kind.name}\n"
    assert (done.returncode, done.stdout, done.stderr) == (128 + kind, "", said)


def test_a_signal_that_comes_while_the_commands_are_loaded_is_told_in_a_line(monkeypatch, capfd):
    """The program is what pyproject.toml names."""
    name = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]["landscape"]
    module, _, function = name.partition(":")
    program = (
        "import os, sys, importlib.abc\n"
        "class Press(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, *_):\n"
        f"        if name == 'tyro': os.kill(os.getpid(), {int(signal.SIGINT)})\n"
        f"sys.meta_path.insert(0, Press())\nfrom {module} import {function}\n{function}()"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "landscape: interrupted by SIGINT\n")
