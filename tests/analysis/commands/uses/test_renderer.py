"""`landscape probe FILE.py:FACTORY` runs that file alone, and its record has what a renderer's products tell."""

import math
import re
import sys

import pytest

from analysis.commands.cli import main
from analysis.records.records import read_record

FACTORY = """
import torch
from landscape import RendererHessian

def make():
    x = torch.tensor([[0.0, 0.5, 2.0]], dtype=torch.float64, requires_grad=True)
    return RendererHessian(lambda t: torch.exp(t * x), {"means": x}, lambda image, t: image.square().sum() / 2, [1.0])

def wrong():
    return 1

def broken():
    return 1 / 0
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "theirs.py").write_text(FACTORY)
    return tmp_path / "theirs.py"


def test_a_renderer_is_probed_as_a_scene_is(file, capsys):
    path, names = list(sys.path), set(sys.modules)
    assert main(["probe", f"{file}:make", "--quick", "--strict"]) == 0
    assert sys.path == path and "theirs" not in set(sys.modules) - names
    record, said = read_record(file.parent / "make-probe"), capsys.readouterr()
    data, (x, y) = record.data, (math.exp(2 * 0.5), math.exp(2 * 2.0))
    top = data.eigenvalues.max
    assert abs(top.value - 2 * y) <= top.residual < 0.1 * y and top.renders.confirmed
    trace = data.traces["means"]
    assert trace.low < x + y < trace.high  # of Gauss-Newton: e^2x, a pixel each
    assert all(check.passed for check in data.checks.values())
    assert "H v takes 5 renders and 3 backward passes" in " ".join(said.out.split())
    assert re.search(r"scene +make\(\) of theirs.py, 1 views; 3 parameters", said.out) and "Gaussian " not in said.out
    middle = record.arrays["slice"]["loss"].shape[0] // 2
    assert record.arrays["slice"]["loss"][middle, middle] == pytest.approx((1 + x + y) / 2)
    # a position's own block of J^T J is diagonal: its largest number is that of y, sampled with 32 signs
    assert record.arrays["places"]["curvature"].tolist() == pytest.approx([y], rel=0.7)
    page = (file.parent / "make-probe" / "report.html").read_text()
    assert "Loss landscape of make() of theirs.py, 1 view" in page and "0 Gaussians" not in page
    assert all(
        (file.parent / "make-probe" / f"{name}.png").is_file() for name in ("places", "slice2d", "spectrum", "traces")
    )


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("wrong", [], "RendererHessian from wrong.. of .*theirs.py, got int"),
        ("broken", [], "got ZeroDivisionError: division by zero"),
        ("absent", [], "got AttributeError"),
        ("make", ["--per-attribute"], "expected of a renderer no --per-attribute"),
        ("make", ["--split-control"], "expected of a renderer no --split-control"),
    ],
)
def test_a_factory_that_cannot_be_used_is_refused(file, capsys, name, options, words):
    assert main(["probe", f"{file}:{name}", *options]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "Traceback" not in said

    assert re.search(words, said), said


def test_a_file_that_is_not_there_is_refused(tmp_path, capsys):
    assert main(["probe", str(tmp_path / "no.py:make")]) == 2
    assert "expected a file with the function make" in " ".join(capsys.readouterr().err.split())
