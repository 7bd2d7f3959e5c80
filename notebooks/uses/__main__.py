"""Which rule picks the best next view: `python -m notebooks.uses [FILE.toml]`, by default notebooks/uses.toml.

The file and what is written are described in `notebooks.uses.study`; the same command continues a study that was stopped.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from analysis.console.failures import program
from notebooks.uses.study import run_study

FILE = Path(__file__).parents[1] / "uses.toml"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code."""
    parser = argparse.ArgumentParser("python -m notebooks.uses", description="A study of rules that pick next views.")
    parser.add_argument("file", type=Path, nargs="?", default=FILE, help="FILE.toml, see notebooks/uses/study.py")
    return run_study(parser.parse_args(arguments).file)


if __name__ == "__main__":
    program(main)
