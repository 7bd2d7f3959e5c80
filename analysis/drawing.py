"""Pictures of a record: the figures' own commands, each run in a process of its own.

`figures/` reads what this package wrote and is not imported here, so that the arrow between them points one way; a
renderer that ends its process (VTK does, where OpenGL is missing) cannot take a probe along.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def draw(module: str, target: Path) -> list[str]:
    """Run `python -m figures.MODULE TARGET`; returns what it warned of.  Raises RuntimeError with its words if it failed."""
    command = [sys.executable, "-m", f"figures.{module}", str(target)]
    done = subprocess.run(command, capture_output=True, text=True, env=module_environment())
    said = [line for line in done.stderr.splitlines() if line.strip()]
    if done.returncode:
        raise RuntimeError(f"drawing failed; draw again with: {' '.join(command)}\n" + "\n".join(said))
    return [line.split("Warning: ", 1)[1] for line in said if "Warning: " in line]


def module_environment() -> dict[str, str]:
    """In which `python -m` finds the modules of this repository, and all that this process finds."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
