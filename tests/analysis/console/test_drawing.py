"""Pictures drawn by other processes."""

from pathlib import Path
from time import monotonic

import pytest

from analysis.console.drawing import draw, drawing

STUCK = """
import subprocess, sys
subprocess.run([sys.executable, "-c", "import time; print('asleep', file=open('asleep', 'w')); time.sleep(20)"])
"""


@pytest.fixture
def figures(tmp_path, monkeypatch):
    """A package `figures` where `python -m` looks first."""
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "__init__.py").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path / "figures"


def test_an_interruption_ends_the_drawing_and_its_processes(figures):
    (figures / "stuck.py").write_text(STUCK)
    deadline = monotonic() + 15
    with drawing("stuck"):
        while not (figures.parent / "asleep").exists():
            assert monotonic() < deadline
        start = monotonic()
    assert monotonic() - start < 10


def test_drawing_says_the_same_now_and_later(figures):
    (figures / "warns.py").write_text("import warnings\nwarnings.warn('no fonts')")
    with drawing("warns") as drawn:
        later = drawn(figures)
    assert draw("warns", figures) == later == ["no fonts"]
    (figures / "fails.py").write_text("raise SystemExit('no ink')")
    with drawing("fails") as drawn:
        later = drawn(figures)
    assert draw("fails", figures) == later == ["drawing failed: no ink"]


@pytest.mark.skipif(not Path("/proc/self/oom_score_adj").exists(), reason="Linux alone has an order of ends")
def test_where_memory_runs_out_drawing_ends_before_measuring(figures):
    (figures / "order.py").write_text("input()\nraise SystemExit(open('/proc/self/oom_score_adj').read())")
    with drawing("order") as drawn:
        assert int(drawn(figures)[0].split()[-1]) > int(Path("/proc/self/oom_score_adj").read_text())


def test_a_drawing_that_the_system_ends_says_why(figures):
    (figures / "ended.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)")
    assert draw("ended", figures) == ["drawing failed: ended by SIGKILL, as Linux does where memory runs out"]
