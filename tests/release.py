"""A release, tried as its users get it: `make test-release`, minutes.

A wheel is built and installed into a new environment, which otherwise has the packages of this one; there, in an empty folder,
the demonstration, every command and Python block of the README and the pages, and the examples of all docstrings run.  The
scene is the demonstration's, at few steps.
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
PAGES = (
    "README",
    "docs/first-probe",
    "docs/map-and-view",
    "docs/python",
    "docs/uses",
    "docs/methods",
    "docs/other-tools",
)
SHORT = {"train": ["--iterations", "20"], "probe": ["--quick"], "view": ["--html", "view.html"]}  # which end them soon
BLOCK = re.compile(r"^```python\n(.*?)^```|^    (landscape [^\n]*)$", re.M | re.S)


def main() -> None:
    """CalledProcessError at the first thing that fails."""
    binaries, trials = environment(BUILD / "release"), Path(mkdtemp(prefix="release-"))

    def run(*words: object) -> None:
        print("$", shlex.join(map(str, words)), flush=True)
        subprocess.run(
            [binaries / str(words[0]), *map(str, words[1:])], cwd=trials, check=True, stdout=subprocess.DEVNULL
        )

    run("python", "-c", f"import landscape; assert {str(BUILD)!r} in landscape.__file__, landscape.__file__")
    run("landscape", "demo", "--out", "demo")
    for file in ("point_cloud.ply", "theirs/point_cloud.ply"):
        run("landscape", "convert", "demo/run", file)
    for page in PAGES:
        for code, command in BLOCK.findall((ROOT / f"{page}.md").read_text(encoding="utf-8")):
            if code:
                run("python", "-c", code)
            elif words := shortened(command, trials):
                run("landscape", *words)
    packages = [
        next((BUILD / "release").glob(f"lib/*/*/{name}")) for name in ("landscape", "splat", "analysis", "figures")
    ]
    run(
        "python",
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--import-mode=importlib",
        "--doctest-modules",
        *packages,
    )


def environment(folder: Path) -> Path:
    """The programs of a new environment with the wheel, which finds the packages of this one, but not this checkout."""
    words = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir"]
    subprocess.run([sys.executable, "-m", "pip", *words, BUILD / "wheel", ROOT], check=True)
    wheel = max((BUILD / "wheel").glob("*.whl"), key=lambda path: path.stat().st_mtime)
    venv.EnvBuilder(clear=True).create(folder)
    others = [path for path in sys.path if path.endswith("site-packages")]  # of folders named so no .pth is read
    (next(folder.glob("lib/*/site-packages")) / "others.pth").write_text("\n".join(others))
    words = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([folder / "bin/python", *words, wheel], check=True)
    return folder / "bin"


def shortened(line: str, trials: Path) -> list[str]:
    """The words of a page's command, for the demonstration's scene; none for a run that another page has made."""
    command, *words = shlex.split(line.replace("SCENE", "demo/scene"), comments=True)[1:]
    if command == "train" and "--out" not in words:
        words += ["--out", mkdtemp(dir=trials) + "/run"]
    if "--out" in words and (trials / words[words.index("--out") + 1]).exists():
        return []
    return [command, *words, *SHORT.get(command, [])]


if __name__ == "__main__":
    main()
