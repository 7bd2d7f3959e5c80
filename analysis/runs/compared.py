"""Subjects of `landscape compare`: folders of landscape train and files of other tools, their checkpoints and their probes.

The probe of a file is `probe` beside it, where that is of this file, else `probe-NAME`.  A file that was probed is opened as it
was then, so that nothing has to be said twice; where something is said, the probe has to be of the same.
"""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Literal

from analysis.probe.command import run_probe
from analysis.probe.options import ProbeOptions
from analysis.records.provenance import Provenance, require_own
from analysis.records.records import ProbeRecord, read_record
from analysis.records.run_files import CHECKPOINT, METRICS, Scores, read_scores
from analysis.runs.options import CompareOptions
from analysis.runs.sweep.sweep_file import arguments
from landscape.errors import InputError
from splat.training.checkpoint import load_checkpoint, open_checkpoint, open_subject
from splat.training.origin.fingerprint import changes
from splat.training.origin.options import Foreign
from splat.training.origin.subject import Checkpoint

PROBE, RENDER = "probe", ("objective.render.", "objective.similarity", "objective.centred", "objective.background")
AGAIN = "repeat the training's command with --resume, which scores again"
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
    if made and made.origin and made.scene_folder and options.foreign == Foreign():
        return open_checkpoint(run, _as_probed(made), folder, made.views or None)
    return open_subject(run, replace(options.foreign, max_views=None), folder).checkpoint


def _as_probed(made: Provenance) -> Foreign:
    assert made.origin and made.scene_folder
    origin, loss = made.origin, made.origin.preset.loss
    return Foreign(
        scene=Path(made.scene_folder),
        trained_by=origin.trained_by,
        images=origin.images,
        downscale=origin.downscale,
        antialiased=origin.preset.render.get("antialias", "none") != "none",
        opacity_reg=loss.opacity_reg,
        scale_reg=loss.scale_reg,
    )


def probed(run: Path, checkpoint: Checkpoint) -> bool:
    """Whether there is a record of this checkpoint, by its renderer, of its views or some of them.

    The loss is compared between the records (`analysis.runs.compare`).
    """
    made = _made(probe_folder(run))
    if made is None or not made.fingerprint:
        return False
    found, asked = made.fingerprint, checkpoint.fingerprint({}, 0)
    renders = [{k: v for k, v in each.question.items() if k.startswith(RENDER)} for each in (found, asked)]
    if found.state != asked.state or renders[0] != renders[1] or not found.data.keys() <= asked.data.keys():
        return False
    # of another tool's file the views are those of today, of a training its own: what was accepted is said of it
    return checkpoint.origin is None or not changes({name: asked.data[name] for name in found.data}, found.data)


def _probing(run: Path, options: CompareOptions, loss: Loss) -> ProbeOptions:
    fewer = Foreign(max_views=options.foreign.max_views)
    asked = ProbeOptions(checkpoint_path(run), device=options.device, loss=loss, foreign=fewer)
    if run.is_file():
        asked = replace(asked, out=probe_folder(run), foreign=options.foreign)
    return asked


def probe_command(run: Path, options: CompareOptions, loss: Loss) -> str:
    """The command that makes the missing probe, as it is typed."""
    return shlex.join(["landscape", *arguments("probe", _probing(run, options, loss))])


def probe(run: Path, options: CompareOptions, loss: Loss) -> None:
    asked = _probing(run, options, loss)
    run_probe(asked, ["landscape", *arguments("probe", asked)])


def scores_of(run: Path, checkpoint: Checkpoint, notes: list[str]) -> Scores | None:
    """Scores of the checkpoint; None where a run was stopped before, or is another tool's file.

    notes: is told of scores that are another checkpoint's, which are left out.
    """
    if not (run / METRICS).is_file():
        return None
    found = read_scores(run)
    try:
        require_own(found.provenance and found.provenance.fingerprint, checkpoint.state, run / METRICS, AGAIN)
    except InputError as error:
        notes.append(f"scores are left out: {error}")
        return None
    return found
