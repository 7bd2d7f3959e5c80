"""Pictures drawn by other processes."""

import ast
import subprocess
from pathlib import Path
from time import monotonic

import pytest

from analysis.console.drawing import ROOT, draw, drawing
from figures.make_all import FIGURES
from tests.recorded import synthetic, written
from tests.waiting import PATIENCE, waits_for

STUCK = f"""
import subprocess, sys
subprocess.run([sys.executable, "-c", "import time; print('asleep', file=open('asleep', 'w')); time.sleep({PATIENCE})"])
"""


@pytest.fixture(autouse=True)
def programs(monkeypatch) -> None:
    monkeypatch.setattr("analysis.console.drawing.subprocess", subprocess)


@pytest.fixture
def figures(tmp_path, monkeypatch):
    """A package `figures` in place of this program's own."""
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "__init__.py").touch()
    monkeypatch.setattr("analysis.console.drawing.ROOT", tmp_path)
    return tmp_path / "figures"


def test_an_interruption_ends_the_drawing_and_its_processes(figures):
    (figures / "stuck.py").write_text(STUCK)
    with drawing("stuck"):
        waits_for((figures.parent / "asleep").exists)
        start = monotonic()
    assert monotonic() - start < PATIENCE / 2


def test_drawing_says_the_same_now_and_later(figures):
    (figures / "warns.py").write_text("import warnings\nwarnings.warn('no fonts')")
    with drawing("warns") as drawn:
        later = drawn(figures)
    assert draw("warns", figures) == later == ["no fonts"]
    (figures / "fails.py").write_text("raise SystemExit('no ink')")
    with drawing("fails") as drawn:
        later = drawn(figures)
    assert draw("fails", figures) == later == ["drawing failed: no ink"]


def test_a_drawing_that_the_system_ends_says_why(figures):
    (figures / "ended.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)")
    assert draw("ended", figures) == ["drawing failed: ended by SIGKILL, as Linux does where memory runs out"]


def test_nothing_beside_a_scene_is_run_or_read_by_what_draws(tmp_path, monkeypatch):
    """Packages and modules, of names that are drawn with, and settings of matplotlib that ask for a program."""
    folder, marks = written(tmp_path / "probe", *synthetic()).folder, tmp_path / "ran"
    theirs = f"import os\nos.makedirs({str(marks)!r}, exist_ok=True)\nopen({str(marks)!r} + '/' + __name__, 'w')\n"
    for name in ("figures", "analysis", "scipy", "PIL"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(theirs)
    for name in ("matplotlib", "random", "numpy", "sitecustomize", "figures/make_all", "traces"):
        (tmp_path / f"{name}.py").write_text(theirs)
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nbackend: module://traces\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "")
    monkeypatch.syspath_prepend("")  # as `python -m` has it
    said = draw("make_all", Path("probe"))
    assert not marks.exists(), sorted(path.name for path in marks.iterdir())
    assert {path.stem for path in folder.glob("*.png")} == {*FIGURES} - {"slice1d", "places"}, said


def test_every_python_is_started_by_one_function():
    """Who names the interpreter runs it without `-P`, and with what the current folder brings."""
    found = [
        path
        for layer in ("landscape", "splat", "analysis", "figures")
        for path in (ROOT / layer).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if (isinstance(node, ast.Attribute) and ast.unparse(node) in ("sys.executable", "os.system", "os.popen"))
        or (isinstance(node, ast.alias) and node.name.split(".")[0] in ("multiprocessing", "runpy", "pty"))
    ]
    assert {*found} == {ROOT / "analysis/console/drawing.py"}
