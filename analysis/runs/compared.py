"""Subjects of `landscape compare`: folders of landscape train and files of other tools, their checkpoints and their probes.

The probe of a file is `probe` beside it, where that is of this file, else `probe-NAME`.  A file that was probed is opened as it
was then, so that nothing has to be said twice; where something is said, the probe has to be of the same.
"""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Literal

from msgspec import UNSET

from analysis.console.options import ForeignOptions
from analysis.probe.command import opened, run_probe
from analysis.probe.options import ProbeOptions
from analysis.records.provenance import Provenance
from analysis.records.records import ProbeRecord, read_record
from analysis.records.run_files import CHECKPOINT, METRICS, Scores, read_scores
from analysis.runs.options import CompareOptions
from analysis.runs.sweep.sweep_file import arguments
from splat.training.checkpoint import Checkpoint, load_checkpoint, open_checkpoint
from splat.training.origin.foreign import Foreign

PROBE = "probe"
Loss = Literal["training", "3dgs"]


def checkpoint_path(run: Path) -> Path:
    return run if run.is_file() else run / CHECKPOINT


def probe_folder(run: Path) -> Path:
    """Folder of the run's probe, which may not exist."""
    if not run.is_file():
        return run / PROBE
    usual = run.with_name(PROBE)
    made = _made(usual)
    return usual if made and Path(made.checkpoint or "").name == run.name else run.with_name(f"{PROBE}-{run.stem}")


def _made(folder: Path) -> Provenance | None:
    return read_record(folder, ProbeRecord).data.provenance if (folder / ProbeRecord.FILE).is_file() else None


def compared(run: Path, options: CompareOptions) -> Checkpoint:
    """The checkpoint of a run or a file."""
    if not run.is_file():
        return load_checkpoint(run / CHECKPOINT)
    folder = probe_folder(run)
    made = _made(folder)
    if made and made.origin is not UNSET and (options.scene, options.foreign) == (None, ForeignOptions()):
        return open_checkpoint(run, _as_probed(made), folder.with_name(f"{folder.name}-mismatch.png"))
    return opened(run, options.scene, replace(options.foreign, max_views=None), folder)[0]


def _as_probed(made: Provenance) -> Foreign:
    assert made.origin is not UNSET and made.scene_folder is not UNSET
    origin, loss = made.origin, made.origin["preset"]["loss"]
    return Foreign(
        scene=Path(made.scene_folder),
        train_list=tuple(made.views or ()),
        trained_by=origin["trained_by"],
        images=origin["images"],
        downscale=origin["downscale"],
        antialiased=origin["preset"]["render"]["antialias"] != "none",
        opacity_reg=loss["opacity_reg"],
        scale_reg=loss["scale_reg"],
    )


def probed(run: Path, checkpoint: Checkpoint) -> bool:
    """Whether there is a record of this checkpoint's step; of a file, also by its trainer's conventions, of its views."""
    made = _made(probe_folder(run))
    if made is None or made.iteration != checkpoint.training.step:
        return False
    if checkpoint.origin is None:
        return True
    alike = made.origin is not UNSET and made.origin["trained_by"] == checkpoint.origin["trained_by"]
    return alike and {*(made.views or ())} <= {*checkpoint.scene.train}


def _probing(run: Path, options: CompareOptions, loss: Loss) -> ProbeOptions:
    fewer = replace(ForeignOptions(), max_views=options.foreign.max_views)
    asked = ProbeOptions(checkpoint_path(run), device=options.device, loss=loss, foreign=fewer)
    if run.is_file():
        asked = replace(asked, scene=options.scene, out=probe_folder(run), foreign=options.foreign)
    return asked


def probe_command(run: Path, options: CompareOptions, loss: Loss) -> str:
    """The command that makes the missing probe, as it is typed."""
    return shlex.join(["landscape", *arguments("probe", _probing(run, options, loss))])


def probe(run: Path, options: CompareOptions, loss: Loss) -> None:
    asked = _probing(run, options, loss)
    run_probe(asked, ["landscape", *arguments("probe", asked)])


def scores_of(run: Path) -> Scores | None:
    """Scores of a run; None where it was stopped before, or is another tool's file."""
    return read_scores(run) if (run / METRICS).is_file() else None
