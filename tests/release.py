"""A release, tried as its users get it: `make test-release`, minutes.

A wheel is built and installed into a new environment, which otherwise has the packages of this one; there, in empty folders,
the demonstration, the examples of all docstrings, and every command and Python block of the README and the pages run.  The
scene is the demonstration's, at few steps.
"""

import os
import re
import shlex
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("landscape", "splat", "analysis", "figures")
PAGES = (
    "README",
    "docs/first-probe",
    "docs/map-and-view",
    "docs/python",
    "docs/uses",
    "docs/methods",
    "docs/other-tools",
)
SHORT = {"train": ["--iterations", "20"], "probe": ["--quick"], "view": ["--html"]}  # words that end a command soon


def main() -> None:
    """CalledProcessError at the first thing that fails."""
    build = ROOT / "build"
    words = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        build / "wheel",
        ROOT,
    ]
    subprocess.run(words, check=True)
    wheel = max((build / "wheel").glob("*.whl"), key=lambda path: path.stat().st_mtime)
    binaries = environment(build / "release", wheel)
    trials = build / f"trials-{os.getpid()}"
    trials.mkdir()

    def run(*words: object) -> None:
        print("$", shlex.join(map(str, words)), flush=True)
        subprocess.run(
            [binaries / str(words[0]), *map(str, words[1:])], cwd=trials, check=True, stdout=subprocess.DEVNULL
        )

    where = f"import landscape; assert {str(build / 'release')!r} in landscape.__file__, landscape.__file__"
    run("python", "-c", where)
    run("landscape", "demo", "--out", "demo")
    run("landscape", "convert", "demo/run", "point_cloud.ply")
    (trials / "theirs").mkdir()
    (trials / "point_cloud.ply").rename(trials / "theirs/point_cloud.ply")
    (trials / "point_cloud.ply").symlink_to("theirs/point_cloud.ply")
    for page in PAGES:
        text = (ROOT / f"{page}.md").read_text(encoding="utf-8")
        for block in re.findall(r"^```python\n(.*?)^```|^    (landscape [^\n]*)$", text, re.M | re.S):
            run("python", "-c", block[0]) if block[0] else run(*shortened(block[1], trials))
    folders = [next((build / "release").glob(f"lib/*/site-packages/{name}")) for name in PACKAGES]
    run(
        "python",
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--import-mode=importlib",
        "--doctest-modules",
        *folders,
    )


def environment(folder: Path, wheel: Path) -> Path:
    """The programs of a new environment with the wheel, which finds the packages of this one, but not this checkout."""
    venv.EnvBuilder(clear=True, with_pip=False).create(folder)
    packages = next(folder.glob("lib/*/site-packages"))
    others = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "others.pth").write_text("\n".join(others))  # of folders named so no .pth is read
    python = folder / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", wheel], check=True)
    return folder / "bin"


def shortened(line: str, trials: Path) -> list[str]:
    """A command of a page as the demonstration's scene runs it.  A run that another page has made is not made again."""
    command, *words = shlex.split(
        line.replace("SCENE", "demo/scene").replace("data/fern", "demo/scene"), comments=True
    )[1:]
    if command == "train" and "--out" not in words:
        words += ["--out", f"runs/unnamed-{len(list(trials.glob('runs/*')))}"]
    out = trials / words[words.index("--out") + 1] if "--out" in words else None
    if out is not None and out.exists():
        return ["landscape", "--version"]
    return ["landscape", command, *words, *SHORT.get(command, [])]


if __name__ == "__main__":
    main()
