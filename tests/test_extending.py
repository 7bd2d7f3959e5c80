"""The examples of docs/extending.md run: a package of somebody else is installed and adds a method and a reader."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from splat import METHODS, SyntheticSettings, synthetic_scene
from splat.model.files.read import is_foreign
from splat.scenes.write import write_transforms_scene

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"^```(?:toml|python)\n(.*?)^```", (ROOT / "docs/extending.md").read_text(), re.M | re.S)
FILES = {first[2:]: block for block in BLOCKS if (first := block.splitlines()[0]).startswith("# ")}
SCRIPTS = [block for block in BLOCKS if not block.startswith("# ")]


@pytest.fixture(scope="module")
def packages(tmp_path_factory) -> Path:
    """The folder of an environment in which the package of the page is installed."""
    source, target = (tmp_path_factory.mktemp(name) for name in ("clipped", "packages"))
    for name, content in FILES.items():
        (source / name).write_text(content)
    words = ["-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--target"]
    subprocess.run([sys.executable, *words, str(target), str(source)], check=True, timeout=120)
    return target


def run(folder: Path, packages: Path, *words: str) -> str:
    paths = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(packages)])}
    done = subprocess.run([sys.executable, *words], cwd=folder, env=paths, capture_output=True, text=True, timeout=240)
    return f"{done.returncode} {done.stdout} {done.stderr}"


def test_the_method_of_an_installed_package_trains(packages, tmp_path):
    write_transforms_scene(synthetic_scene(SyntheticSettings(50, 6, 16, 12)).scene, tmp_path / "scene")
    words = ("train", "scene", "--views", "3", "--iterations", "2", "--out", "run", "--method", "clipped")
    assert "clipped" not in METHODS  # not installed here
    said = run(tmp_path, packages, "-m", "analysis.commands.cli", *words, "--set", "most=0.02")
    assert said.startswith("0 ") and (tmp_path / "run/checkpoint.pt").is_file(), said


def test_the_reader_of_an_installed_package_reads(packages, tmp_path):
    path = tmp_path / "balls.xyzrgb"
    path.write_text("0 0 0 1 0 0\n0.2 0 0 0 1 0\n")
    assert not is_foreign(path)  # not installed here
    reading = (
        "from pathlib import Path; from splat.model.files.read import is_foreign, read_splats; path = Path('balls.xyzrgb'); "
        "print(is_foreign(path), len(read_splats(path).gaussians))"
    )
    said = run(tmp_path, packages, "-c", reading)
    assert said.startswith("0 True 2"), said


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.split("\n")[-2][:40])
def test_the_other_examples_run(script, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(compile(script, "docs/extending.md", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.strip()


def test_an_example_is_of_thirty_lines_at_most():
    assert len(SCRIPTS) == 2 and set(FILES) == {"pyproject.toml", "clipped.py"}
    for block in [*SCRIPTS, *re.split(r"\n\n\n(?=def read)", FILES["clipped.py"])]:
        assert len(block.splitlines()) <= 30
