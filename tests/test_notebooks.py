"""The notebooks run from their first cell to their last, and tell their story with public names only."""

import ast
import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import matplotlib as mpl
import pytest

from figures.style import RUNS

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path: Path) -> list[str]:
    """The sources of the code cells, in their order."""
    found = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.fixture(scope="module", params=NOTEBOOKS, ids=lambda path: path.stem)
def story(request) -> tuple[str, dict]:
    """What a notebook printed, run from its first cell to its last, and the names that it defined."""
    mpl.use("agg")
    names: dict = {"__name__": "__main__"}
    with redirect_stdout(StringIO()) as printed:
        for number, source in enumerate(cells(request.param), 1):
            exec(compile(source, f"{request.param.name}, code cell {number}", "exec"), names)
    return printed.getvalue(), names


def test_a_notebook_runs_and_every_number_is_one(story):
    printed, _ = story
    assert printed and "nan" not in printed


def test_the_comparison_trains_both_methods_and_gives_every_trace_with_its_error(story):
    printed, names = story
    for attribute in names["start"].attributes:
        (line,) = [line for line in printed.splitlines() if line.startswith(attribute)]
        assert line.count("±") == 2
    plain, stable = (names["trained"][name] for name in ("3DGS", "StableGS"))
    assert stable.method.history and not plain.method.history  # it has probed
    assert not (len(stable.gaussians) == len(plain.gaussians) and stable.gaussians.flat.equal(plain.gaussians.flat))


def test_the_profiles_have_the_colours_and_names_of_the_figures(story):
    _, names = story
    lines = names["axes"].lines
    assert [line.get_color() for line in lines] == [colour for colour in RUNS[:2] for _ in range(2)]
    assert len({line.get_label() for line in lines}) == 4


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_uses_public_names_only_and_keeps_no_outputs(path):
    for node in ast.walk(ast.parse("\n".join(cells(path)))):
        name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
        assert not name.startswith("_"), name
        assert not (isinstance(node, ast.ImportFrom) and any(alias.name.startswith("_") for alias in node.names))
    assert all(not cell.get("outputs") for cell in json.loads(path.read_text(encoding="utf-8"))["cells"])
