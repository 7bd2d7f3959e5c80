"""`landscape probe FILE.py:FACTORY` runs that file alone, and its record has what a renderer's products tell."""

import json
import re
import sys

import pytest

from analysis.commands.cli import main

FACTORY = """
import torch
from landscape import RendererHessian

def make():
    x = torch.tensor([0.5, 2.0], dtype=torch.float64, requires_grad=True)
    return RendererHessian(lambda t: torch.exp(t * x), {"x": x}, lambda image, t: image.square().sum() / 2, [1.0])

def wrong():
    return 1

def broken():
    return 1 / 0
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "theirs.py").write_text(FACTORY)
    return tmp_path / "theirs.py"


def test_a_renderer_is_probed(file, capsys):
    path, names = list(sys.path), set(sys.modules)
    assert main(["probe", f"{file}:make", "--quick", "--strict"]) == 0
    assert sys.path == path and "theirs" not in set(sys.modules) - names
    data, said = json.loads((file.parent / "make-probe" / "renderer.json").read_text()), capsys.readouterr().out
    top = 2 * 2.718281828459045**4
    assert abs(data["eigenvalues"]["largest"]["value"] - top) <= data["eigenvalues"]["largest"]["error"] < 0.1 * top
    assert data["check"]["passed"] and data["passes"] == {"renders": 5, "backward": 3}
    assert "H v takes 5 renders and 3 backward passes" in said and "largest   1.1e+02 +-" in said
    for point in data["slice"]:
        assert point["loss"] == pytest.approx(point["quadratic"], rel=1e-3)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("wrong", [], "RendererHessian from wrong.. of .*theirs.py, got int"),
        ("broken", [], "got ZeroDivisionError: division by zero"),
        ("absent", [], "got AttributeError"),
        ("make", ["--per-attribute"], "expected of a renderer no --per-attribute"),
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
