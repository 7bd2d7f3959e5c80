"""The notebooks run from their first cell to their last, and tell their story with public names only."""

import ast
import json
import re
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from itertools import pairwise
from math import log2
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path: Path) -> list[str]:
    """The sources of the code cells, in their order."""
    found = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def test_there_are_notebooks():
    assert NOTEBOOKS


@cache
def story(name: str) -> tuple[str, dict]:
    """What a notebook printed, run from its first cell to its last, and the names that it defined."""
    mpl.use("agg")
    names: dict = {"__name__": "__main__"}
    with redirect_stdout(StringIO()) as printed:
        for number, source in enumerate(cells(ROOT / "notebooks" / f"{name}.ipynb"), 1):
            exec(compile(source, f"{name}, code cell {number}", "exec"), names)
    return printed.getvalue(), names


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_every_number_is_one(path):
    printed, _ = story(path.stem)
    assert printed and not re.search(r"\bnan\b", printed)


def test_the_curvature_of_the_nerf_is_that_of_its_dense_hessian():
    _, names = story("nerf")
    exact, ends = names["exact"], names["ends"]
    for end, value in ((ends.largest, exact[-1]), (ends.smallest, exact[0])):
        round_off = len(exact) * np.finfo(float).eps * float(exact.abs().max())  # of either, by Weyl's inequality
        assert abs(float(end.values[0]) - float(value)) <= float(end.residuals[0]) + 2 * round_off
    for name, rows in names["H"].blocks.items():
        found, truth = names["traces"][name], float(names["dense"].diagonal()[rows].sum())
        assert abs(found.value - truth) <= 4 * found.standard_error
    assert -10 * float(names["loss"].detach().log10()) > 20  # it has learnt its pixels


def test_the_nerf_through_one_derivative_is_within_the_stated_errors():
    _, names = story("nerf")
    assert names["held"] >= 90
    largest = names["seen_ends"].largest
    assert abs(float(largest.values[0]) - float(names["exact"][-1])) <= float(largest.residuals[0])
    for name, rows in names["bridge"].blocks.items():
        found = names["seen_traces"][name]
        assert found.low <= float(names["J"][rows].sum()) <= found.high


def test_the_comparison_says_what_the_stored_table_says():
    printed, names = story("stablegs_vs_3dgs")
    rows, lines = names["rows"], printed.splitlines()
    both = [rows[rows["method"] == method].groupby("seed")["trace_means"].mean() for method in ("stablegs", "3dgs")]
    ratio = np.exp(np.log(both[0] / both[1]).mean())  # a seed may have been trained on several machines
    (line,) = [line for line in lines if line.startswith("StableGS over 3DGS, trace_means: ")]
    assert float(line.split(": ")[1].split()[0]) == pytest.approx(ratio, rel=0.01)
    assert sum(bool(re.match(r"\d+\. ", line)) for line in lines) == 10
    assert not names["related"].empty


def test_the_quick_start_leaves_what_it_shows():
    """A report, a slice and a map of the run that it trained; a command that fails is no silent cell."""
    printed, names = story("quick_start")
    run = names["WORK"] / "run"
    assert all((run / file).is_file() for file in ("probe/report.html", "slice-gradient-1d/slice1d.png", "map/top.csv"))
    assert "held-out views" in printed and "curvature" in printed


def test_error_bars_cover_in_run_time_against_error():
    """19 of 20 intervals for a trace at least, but for two standard deviations; the sketch wins where products are many."""
    _, names = story("run_time_against_error")
    covered, runs = names["covered"], len(names["SEEDS"]) * len(names["covered"])
    assert sum(covered.values()) >= 0.95 * runs - 2 * (0.95 * 0.05 * runs) ** 0.5
    assert names["errors"]["xtrace", 96] < names["errors"]["hutch++", 96] < names["errors"]["hutchinson", 96]
    assert abs(names["blocks"] / names["truth"] - 1) < 1e-10
    assert all(count >= 18 for count in names["within"])  # of sum |lambda|


def test_what_moves_the_index_does_so_as_the_notebook_says():
    _, names = story("what_the_index_measures")
    dims, ranks, _ = zip(*names["counts"])
    assert dims[-1] > 2 * ranks[-1] and ranks[-1] == ranks[-2]  # three views tell no more of colour
    sizes = [row[1] for row in names["rows"]]
    assert all(round(log2(before / after)) == 1 for before, after in pairwise(sizes))  # nearer to 2 than to 1 or 4
    first, *_, last = names["stretched"]
    assert first[2] < first[1] and last[2] > last[1]
    assert int(names["mass"].argmax()) == names["drawn"]  # the needle has the direction of lambda_min
    assert abs(log2(last[1] / first[1])) < log2(last[2] / first[2])  # lambda_max moved less
    assert names["kinked"] < max(names["rounded"]) / 2  # most of it is in the kinks


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_uses_public_names_only(path):
    for node in ast.walk(ast.parse("\n".join(cells(path)))):
        name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
        assert not name.startswith("_") or name == "__init__", name
        assert not (isinstance(node, ast.ImportFrom) and any(alias.name.startswith("_") for alias in node.names))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_keeps_the_outputs_of_its_cells_as_they_are_and_small(path):
    """Run in order without an error, and say what its cells say today; pictures of at most 100 kB.

    `jupyter nbconvert --to notebook --execute --inplace notebooks/NAME.ipynb` stores them anew.
    """
    found = [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    outputs = [output for cell in found for output in cell["outputs"]]
    assert [cell["execution_count"] for cell in found] == list(range(1, len(found) + 1))
    assert all(output["output_type"] != "error" and output.get("name") != "stderr" for output in outputs)
    pictures = [len(output["data"]["image/png"]) * 3 / 4 for output in outputs if "image/png" in output.get("data", {})]
    assert pictures and max(pictures) <= 100_000 and path.stat().st_size <= 400_000
    stored = "".join(text for output in outputs for text in output.get("text", []))
    code = ast.parse("\n".join(cells(path)))
    calls = [node for node in ast.walk(code) if isinstance(node, ast.Call)]
    printed = [written(call) for call in calls if ast.unparse(call.func) == "print"]
    assert re.fullmatch(f"({'|'.join(printed)})+", stored) and all(re.search(each, stored) for each in printed)
    if not any(isinstance(node, ast.ImportFrom) and node.module == "splat" for node in ast.walk(code)):
        assert words(stored) == words(story(path.stem)[0])  # its numbers are those of a stored table


def written(call: ast.Call) -> str:
    """What a `print` writes, as a regular expression: its own words, which no number decides; a value may be anything."""
    (text,) = call.args
    if not isinstance(text, ast.JoinedStr):
        return "(?s:.*)\n"
    parts = [re.escape(str(part.value)) if isinstance(part, ast.Constant) else ".*" for part in text.values]
    return "".join(parts) + "\n"


def words(text: str) -> list[str]:
    """What is said, but for the numbers, which rounding on another processor may change."""
    return re.findall(r"[A-Za-z]{3,}", text)


def test_surfels_through_one_derivative_are_those_of_double_backward():
    _, names = story("other_renderers")
    assert len(names["of_surfels"]) == 9 and all(names["of_surfels"])
    assert names["of_litesplat"] is None or all(names["of_litesplat"])
