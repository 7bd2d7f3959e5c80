"""Options of the commands on several runs: `landscape sweep`, `trajectory` and `compare`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from analysis.console.options import Device, OtherTools
from splat.training.origin.options import Foreign


@dataclass(frozen=True)
class SweepOptions:
    """Train every method with every seed on every scene, and give mean and standard deviation over the seeds.

    What is done already is kept: a sweep that was stopped or killed continues when it is run again.
    Each run lies in OUT/SCENE/METHOD/SEED; results.csv has a row for each, summary.csv means and deviations.
    """

    file: Annotated[Positional[Path], arg(metavar="SWEEP.toml")]
    """The methods, seeds, scenes and settings, with paths relative to the file:
    out = "runs/sweep"
    seeds = [0, 1, 2]
    iterations = 3000  # any option of train, here for all, below for a scene or a method
    [probe]  # probe every run; options of probe
    [scenes.fern]
    path = "data/fern"
    views = 3
    [methods.3dgs]
    [methods."asp only"]
    method = "stablegs"
    set = { vsp_weight = 0 }"""
    out: Path | None = None
    """Folder of the runs and tables.  Default: the file's."""
    only: UseAppendAction[tuple[str, ...]] = ()
    """Run these cells alone, by SCENE/METHOD/SEED or the beginning of it, such as fern/3dgs; may be repeated."""
    jobs: int = 1
    """Runs at once, each on its share of the processors."""


@dataclass(frozen=True)
class TrajectoryOptions:
    """Plot the landscape along trainings that were made with --probe-every, several in one picture."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN...", help_behavior_hint="")]
    """Folders that landscape train --probe-every wrote."""
    out: Path | None = None
    """Folder of the table and the picture.  Default: trajectory, in the folder that holds all runs."""


@dataclass(frozen=True)
class CompareOptions:
    """Compare probed runs in one table and on one page: scores, traces, spectra, anisotropy, slices."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN...", help_behavior_hint="")]
    """Two or more folders that landscape train wrote, or files of other tools, of the same views and loss, each probed.
    A folder whose sub-folders are runs, such as OUT/SCENE/METHOD of a sweep, stands for all its seeds: mean and spread."""
    out: Path | None = None
    """Folder of the page, the table and the pictures.  Default: compare, in the folder that holds all runs."""
    probe: bool = False
    """Probe the runs that have no record of their checkpoint yet."""
    device: Device = "auto"
    foreign: OtherTools = field(default_factory=Foreign)
