"""`landscape next-view`: what each candidate camera would tell about a scene (`splat.curvature.scores.information`).

gains.csv       every gain of every candidate over the training views alone, and `pick`: 1 for the first that is chosen by
                --by, 2 for the next when that one has been added, ...; gains.png
next-view.json  where it comes from
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
import torch
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from torch import Tensor

from analysis.commands.uses.options import NextViewOptions
from analysis.console.drawing import draw_or_say
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.records.json_files import json_text, plain
from analysis.records.provenance import provenance_of
from analysis.records.records import record_folder, require_replaceable
from landscape.errors import InputError, did_you_mean
from landscape.results import Progress
from splat.curvature.scores.information import GAINS, Information, gains, information, prior_of
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.scenes.scene import Scene
from splat.training.checkpoint import open_subject
from splat.training.origin.scene_reference import data_of
from splat.training.origin.subject import Checkpoint

RECORD = "next-view.json"  # the file by which a folder of results is known


def run_next_view(options: NextViewOptions, command: Sequence[str]) -> int:
    """Judge the candidates; returns the exit code.  command: as typed, for the record."""
    if options.by not in GAINS:
        raise InputError(f"expected --by {', '.join(GAINS)}, got {options.by!r}{did_you_mean(options.by, GAINS)}")
    out = options.out or options.checkpoint.parent / "next-view"
    require_replaceable(out, RECORD)
    stages = Stages(Console(stderr=True))
    with stages.stage("load"):
        subject = open_subject(options.checkpoint, options.foreign, out)
        checkpoint, scene = subject.checkpoint, subject.scene
        candidates = _candidates(options.candidates, checkpoint, scene)
        if not 1 <= options.take <= len(candidates):
            raise InputError(f"expected --take of 1 to {len(candidates)}, the candidates, got {options.take}")
        config = checkpoint.training.config
        cameras = {frame.name: frame.camera for frame in scene.select((*checkpoint.scene.train, *candidates))}
    with record_folder(out, RECORD) as folder, stages:
        with stages.stage("information") as report:
            background = config.background_colour(torch.float32)
            known = informations(checkpoint.training.gaussians, cameras, background, config.render, report)
        with stages.stage("gains"):
            seen = [known[name] for name in checkpoint.scene.train]
            table = pd.DataFrame({name: gains_over(seen, [], known[name]) for name in candidates}).T
            table.index.name = "view"
            for place, name in enumerate(picked(seen, known, candidates, options.take, options.by)):
                table.loc[name, "pick"] = place + 1
            table = table.sort_values(["pick", options.by], ascending=[True, False])
            table.to_csv(folder / "gains.csv")
        judged = checkpoint.fingerprint({"take": options.take, "by": options.by}, 0, further=data_of(scene, candidates))
        made = provenance_of(judged, subject, command)
        (folder / RECORD).write_text(json_text(plain(made)), encoding="utf-8")
        notes = draw_or_say("uses", folder)
    _conclude(table, options, out)
    say(*notes, style="yellow", console=Console(stderr=True))
    return 0


def _candidates(names: Sequence[str], checkpoint: Checkpoint, scene: Scene) -> list[str]:
    train, used = checkpoint.scene.train, {*checkpoint.scene.train, *checkpoint.scene.test}
    if names:
        if again := [name for name in names if name in train]:
            raise InputError(f"expected --candidates that are no training views, got {again[0]}")
        return [frame.name for frame in scene.select(list(dict.fromkeys(names)))]
    found = [frame.name for frame in scene.frames if frame.name not in used]
    if not found:
        raise InputError("expected views that are neither trained on nor held out, got none; name some by --candidates")
    return found


def informations(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    background: Float[Tensor, "3"],
    settings: RenderSettings,
    report: Progress | None = None,
) -> dict[str, Information]:
    """Information of each camera about the Gaussians."""
    gaussians, found = gaussians.aligned_to(gaussians), {}
    for name, camera in cameras.items():
        found[name] = information(gaussians, camera, background, settings)
        if report:
            report(len(found), len(cameras), "views")
    return found


def gains_over(seen: Sequence[Information], taken: Sequence[Information], candidate: Information) -> dict[str, float]:
    """The gains of a candidate over the training views and those taken before, with the prior of the training views."""
    total = sum(seen[1:], seen[0])
    return gains(sum(taken, total), prior_of(total), candidate)


def picked(
    seen: Sequence[Information], known: Mapping[str, Information], candidates: Sequence[str], count: int, by: str
) -> list[str]:
    """So many candidates, each the best one when those before it have been added."""
    chosen: list[str] = []
    for _ in range(count):
        left = [name for name in candidates if name not in chosen]
        taken = [known[name] for name in chosen]
        chosen.append(max(left, key=lambda name, t=taken: gains_over(seen, t, known[name])[by]))
    return chosen


def _conclude(table: pd.DataFrame, options: NextViewOptions, out: Path) -> None:
    console, shown = Console(), Table(caption="gains over the training views; picks: each knows those before it")
    for title in ("view", *GAINS, "pick"):
        shown.add_column(title, justify="left" if title == "view" else "right")
    for row in table.reset_index().to_dict("records"):
        pick = f"{row['pick']:.0f}" if row["pick"] > 0 else ""
        shown.add_row(row["view"], *(f"{row[gain]:.4g}" for gain in GAINS), pick)
    console.print(shown)
    names = ", ".join(table.index[table.pick.notna()])
    say(f"next, by {options.by}: {names}", f"gains.csv, gains.png in {out}", console=console)
