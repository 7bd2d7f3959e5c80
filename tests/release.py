"""A release, tried as its users get it: `make test-release`, minutes.

A wheel is built and installed into a new environment, which otherwise has the packages of this one; there, in an empty folder,
the demonstration, every block of code of the README and the pages (but `make` and the activation of an environment), and the
examples of all docstrings run.  The scene is the demonstration's, at few steps.  Of a clone there are the notebooks alone, and
at the end the compilation of every kernel for GPUs.
"""

import re
import shlex
import subprocess
import sys
import venv
from pathlib import Path
from tempfile import mkdtemp

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build"
PACKAGES, DATA = ("landscape", "splat", "analysis", "figures"), ("*.jinja", "*.pyi", "*.csv", "py.typed")
SHORT = {  # what ends them soon, by the first of these words in them
    "gn-cg": ["--iterations", "2"],
    "train": ["--iterations", "20"],
    "--curve": ["--sample", "3"],
    "probe": ["--quick"],
    "slice": ["--points", "11"],
    "view": ["--html", "view.html"],
    "notebooks.renderer": ["--part", "products", "--each", "1"],
}
BLOCK = re.compile(r"^```(?:python|toml)\n(.*?)^```|^    ((?:landscape|pip install|python -m) [^\n]*)$", re.M | re.S)
OFFLINE = ["--quiet", "--no-deps", "--no-index"]


def main() -> None:
    """CalledProcessError at the first thing that fails."""
    site, trials = environment(BUILD / "release"), Path(mkdtemp(prefix="release-"))
    binaries = BUILD / "release" / "bin"

    def run(*words: object) -> None:
        print("$", shlex.join(map(str, words)), flush=True)
        subprocess.run(
            [binaries / str(words[0]), *map(str, words[1:])], cwd=trials, check=True, stdout=subprocess.DEVNULL
        )

    run("python", "-c", f"import landscape; assert {str(BUILD)!r} in landscape.__file__, landscape.__file__")
    run("landscape", "demo", "--out", "demo")
    for file in ("point_cloud.ply", "theirs/point_cloud.ply"):
        run("landscape", "convert", "demo/run", file)
    (trials / "notebooks").symlink_to(ROOT / "notebooks")
    (trials / "balls.xyzrgb").write_text("0 0 0 1 0 0\n0.2 0 0 0 1 0\n")
    (trials / "clipped").mkdir()
    tried: list[list[str]] = []  # pages share some
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for code, command in BLOCK.findall(page.read_text(encoding="utf-8")):
            if file := re.match(r"# (\S+\.\w+)\n", code):  # of the package that a page makes
                (trials / "clipped" / file[1]).write_text(code, encoding="utf-8")
            elif (words := ["python", "-c", code] if code else shortened(command, trials)) and words not in tried:
                tried.append(words)
                run(*words)
    pytest = ["python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib"]
    run(*pytest, "--doctest-modules", *(site / name for name in PACKAGES))
    run(*pytest, "--rootdir", ROOT, ROOT / "tests" / "splat" / "gpu" / "every_kernel.py")


def environment(folder: Path) -> Path:
    """The packages of a new environment with the wheel, all of it, which finds those of this one, but not this checkout."""
    words = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir"]
    subprocess.run([sys.executable, "-m", "pip", *words, BUILD / "wheel", ROOT], check=True)
    wheel = max((BUILD / "wheel").glob("*.whl"), key=lambda path: path.stat().st_mtime)
    venv.EnvBuilder(clear=True).create(folder)
    others = [path for path in sys.path if path.endswith("site-packages")]  # of folders named so no .pth is read
    site = next(folder.glob("lib/*/site-packages"))
    (site / "others.pth").write_text("\n".join(others))
    subprocess.run([folder / "bin/python", "-m", "pip", "install", *OFFLINE, wheel], check=True)
    data = [path.relative_to(ROOT) for name in PACKAGES for kind in DATA for path in (ROOT / name).rglob(kind)]
    lacking = [path for path in data if not (site / path).is_file()]
    assert data and not lacking and [*site.glob("splat_landscape-*.dist-info/**/CITATION.cff")], lacking
    return site


def shortened(line: str, trials: Path) -> list[str]:
    """A page's command, for the demonstration's scene; none for a run that another page has made."""
    words = shlex.split(re.sub("SCENE|data/fern", "demo/scene", line), comments=True)
    if words[0] == "pip":
        return ["python", "-m", *words, *OFFLINE, "--no-build-isolation"]
    name = words[2 if words[0] == "python" else 1]
    if name == "train" and "--out" not in words:
        words += ["--out", mkdtemp(dir=trials) + "/run"]
    if "--out" in words and (trials / words[words.index("--out") + 1]).exists():
        return []
    more = next((SHORT[word] for word in SHORT if word in words), [])
    return words if {*more} & {*words} else [*words, *more]


if __name__ == "__main__":
    main()
