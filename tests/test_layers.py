"""landscape <- splat <- analysis <- figures, no arrow back; figures computes nothing and needs no torch."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("landscape", "splat", "analysis", "figures")
ALLOWED = {
    "landscape": {"landscape"},
    "splat": {"landscape", "splat"},
    "analysis": set(LAYERS),  # the command lives here and has its pictures drawn
    "figures": {"analysis", "figures"},  # the recorded results
}


def imported(path: Path) -> set[str]:
    """The modules that a file imports anywhere, inside functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are written in full"
            assert node.module is not None
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def packages(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imported(path)}


def source_of(module: str) -> Path | None:
    """The file of a module of this repository."""
    path = ROOT / (module.replace(".", "/") + ".py")
    return path if path.is_file() else None


@pytest.mark.parametrize("layer", LAYERS)
def test_no_arrow_points_back(layer):
    files = sorted((ROOT / layer).rglob("*.py"))
    assert len(files) > 3
    for path in files:
        assert packages(path) & set(LAYERS) <= ALLOWED[layer], path
        assert "tests" not in packages(path), path


def test_oracles_import_nothing_of_the_source():
    assert not packages(ROOT / "tests" / "oracles.py") & {*LAYERS, "tests"}


def test_what_figures_read_of_analysis_does_not_draw():
    waiting, seen = set((ROOT / "figures").glob("*.py")), set()
    while waiting:
        path = waiting.pop()
        seen.add(path)
        sources = {source_of(name) for name in imported(path) if name.startswith("analysis")}
        waiting |= {source for source in sources if source} - seen
    of_analysis = [path for path in seen if path.parent.name == "analysis"]
    assert of_analysis
    for path in of_analysis:
        assert "figures" not in packages(path), path


def test_figures_need_no_torch():
    modules = [f"figures.{path.stem}" for path in (ROOT / "figures").glob("*.py") if path.stem != "__init__"]
    program = (
        f"import importlib, sys; [importlib.import_module(m) for m in {modules!r}]; sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr or "figures imported torch"
