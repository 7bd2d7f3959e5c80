"""The scene whose training the tests of this folder probe, and how."""

from pathlib import Path

from analysis.commands.cli import main
from analysis.records.records import Record, read_record
from splat.scenes.synthetic import SyntheticSettings

SCENE = SyntheticSettings(gaussians=60, views=5, width=16, height=12)


def unlimited(checkpoint: Path, out: Path, *options: str) -> Record:
    """A probe whose numbers depend on no clock, with a slice of few points."""
    assert main(["probe", str(checkpoint), "--out", str(out), "--slice-points", "5", *options]) == 0
    return read_record(out)
