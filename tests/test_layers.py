"""The plan of the house: at most nine rooms in a folder, and imports that go one way.

Every folder's rooms, its modules and sub-packages, are listed from the ground up: a room imports from rooms before its own in
that list, never from one after, for types alone neither.  `figures` draws what `analysis` recorded, and needs no torch.
"""

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MOST_ROOMS = 9
METHODS = "splat.training.methods.methods"  # its example is in the docstring of the module
ORDER = {
    "": "landscape splat analysis figures notebooks",
    "landscape": "errors linalg probes results operators traces eigen spectrum slices",
    "splat": "model backend projection losses render gpu scenes curvature training",
    "analysis": "records console measures train probe slice runs bench commands",
}


@cache
def modules() -> dict[str, Path]:
    """Every module of the source, by its full name; a package by that of its folder."""
    files = [path for layer in ORDER[""].split() for path in sorted((ROOT / layer).rglob("*.py"))]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


@cache
def imported(path: Path) -> frozenset[str]:
    """The modules that a file imports anywhere, inside functions and for types too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are written in full"
            assert node.module is not None
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


def sources(name: str) -> set[str]:
    """The modules of the source that a module imports; of `from package import module` the module alone."""
    found = imported(modules()[name]) & modules().keys()
    return {each for each in found if not any(other.startswith(each + ".") for other in found)}


def rooms(folder: str) -> set[str]:
    inside = [name.removeprefix(folder + ".") for name in modules() if not folder or name.startswith(folder + ".")]
    return {name.split(".")[0] for name in inside}


def arrows(folder: str) -> set[tuple[str, str]]:
    """(room, other room) wherever a module in the first imports one in the second."""
    depth, found = len(folder.split(".")) if folder else 0, set()
    for name in modules():
        for other in sources(name):
            ours, theirs = name.split("."), other.split(".")
            same = ours[:depth] == theirs[:depth] == (folder.split(".") if folder else [])
            if same and len(ours) > depth and len(theirs) > depth and ours[depth] != theirs[depth]:
                found.add((ours[depth], theirs[depth]))
    return found


def circles(edges: set[tuple[str, str]]) -> set[str]:
    """The rooms that are left when rooms without arrows to others are taken away, one after the other."""
    left = {room for edge in edges for room in edge}
    while ground := {room for room in left if not any(a == room and b in left for a, b in edges)}:
        left -= ground
    return left


def folders() -> list[str]:
    return sorted({name.rpartition(".")[0] for name in modules()} | {"landscape", "splat", "analysis"} - {""})


@pytest.mark.parametrize("folder", [folder for folder in folders() if folder not in ("", "figures")])
def test_a_folder_has_nine_rooms_at_most_and_no_circle(folder):
    assert len(rooms(folder)) <= MOST_ROOMS, sorted(rooms(folder))
    assert not circles(arrows(folder))


@pytest.mark.parametrize("folder", ORDER)
def test_imports_go_one_way(folder):
    order = ORDER[folder].split()
    assert rooms(folder) == set(order)
    back = {
        (a, b) for a, b in arrows(folder) if order.index(b) > order.index(a) and (a, b) != ("analysis", "figures")
    }  # the command has its pictures drawn
    assert not back


def test_circles_are_found():
    assert circles({("a", "b"), ("b", "c"), ("c", "b")}) == {"b", "c"} | {"a"}
    assert not circles({("a", "b"), ("b", "c"), ("a", "c")})


def test_all_triton_is_in_one_wing_which_one_line_names():
    naming = []
    for name, path in modules().items():
        wing = name.startswith("splat.gpu")
        roots = {each.split(".")[0] for each in imported(path)}
        assert wing or "triton" not in roots, name
        assert wing or not any(each.startswith("splat.gpu") for each in sources(name)), name
        lines = path.read_text(encoding="utf-8").splitlines()
        naming += [name for line in lines if not wing and "splat.gpu" in line]
    assert naming == ["splat.backend.device"]


def test_the_gpus_kernels_import_none_of_the_cpus():
    for name in (each for each in modules() if each.startswith("splat.gpu.")):
        others = {each for each in sources(name) if not each.startswith("splat.backend.")}
        assert not {each for each in others if ".cpu" in each or each.endswith("_cpu")}, name


def test_what_is_imported_as_a_module_loads_is_a_dependency():
    """A plain installation has these alone; what an option brings is imported inside functions, or by files for a GPU."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {re.split(r"[^\w-]", each)[0].lower() for each in project["dependencies"]}
    known = {"PIL": "pillow", "mpl_toolkits": "matplotlib", "llvmlite": "numba", "triton": "of a gpu"}
    for name, path in modules().items():
        nodes = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.Import | ast.ImportFrom)]
        loaded = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name for node in nodes}
        outside = {str(each).split(".")[0] for each in loaded} - sys.stdlib_module_names - {*ORDER[""].split()}
        assert {known.get(each, each) for each in outside} <= declared | {"of a gpu"}, name


def test_no_source_imports_tests_and_oracles_import_no_source():
    for path in modules().values():
        assert not any(name.split(".")[0] == "tests" for name in imported(path)), path
    of_oracles = {name.split(".")[0] for name in imported(ROOT / "tests" / "oracles.py")}
    assert not of_oracles & {*ORDER[""].split(), "tests"}


def test_what_figures_read_of_analysis_does_not_draw():
    waiting, seen = {name for name in modules() if name.startswith("figures.")}, set()
    while waiting:
        seen |= waiting
        waiting = {each for name in waiting for each in sources(name) if each.startswith("analysis")} - seen
    of_analysis = [name for name in seen if name.startswith("analysis.")]
    assert of_analysis
    for name in of_analysis:
        assert not any(each.startswith("figures") for each in sources(name)), name


def test_figures_need_no_torch():
    names = [name for name in modules() if name.startswith("figures.")]
    program = f"import sys; [__import__(m) for m in {names!r}]; sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr or "figures imported torch"


@pytest.mark.parametrize(
    ("program", "unwanted"),
    [
        (
            "import landscape; [getattr(landscape, name) for name in landscape.__all__]",
            "pandas matplotlib rich pycolmap",
        ),
        ("import splat", "torch numba pycolmap splat.model"),
        ("from analysis.commands.cli import main; main(['--help'])", "splat.model torch landscape.operators"),
    ],
)
def test_what_starts_fast_does_not_import_what_is_slow(program, unwanted):
    program = f"import sys\ntry:\n    {program}\nexcept SystemExit: pass\n"
    program += f"print('imported', *(name for name in {unwanted.split()} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["imported"], done.stdout[-200:] + done.stderr


def test_the_short_names_of_splat_are_few_and_each_shows_an_example():
    import splat

    names = dir(splat)
    assert 10 <= len(names) <= 20
    for name in names:
        value = getattr(splat, name)
        documented = sys.modules[METHODS] if name == "METHODS" else value
        assert ">>>" in (documented.__doc__ or ""), name
        assert name in (splat.__doc__ or ""), name
