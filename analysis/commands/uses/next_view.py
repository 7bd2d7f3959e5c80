"""`landscape next-view`: what each candidate camera would tell about a scene (`splat.curvature.scores.information`).

gains.csv       every gain of every candidate over the training views alone; `behind`: by how much that of --by is smaller than
                the best one's, and `error`, its standard error, as if the Gaussians were a sample; three rules that ask for no
                curvature; `pick`: 1 for the first that is chosen by --by, 2 for the next when that one has been added, ...
                gains.png
next-view.json  where it comes from

The error is that of a sum over Gaussians drawn independently: neighbours are alike, so it is the least that another training of
the same views would change.  Candidates that are behind by at most TWICE the error are called equal.

coverage        the Gaussians that the camera sees, each over one more than the number of training views that see it
farthest        the distance of the camera from the nearest training view, world units
uniform         the places between the camera and the nearest training view in the order of the capture
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
import torch
from rich.console import Console

from analysis.bench.tables import rich_table
from analysis.commands.options import GEOMETRY, TWICE, NextViewOptions
from analysis.console.drawing import draw
from analysis.console.options import require_known
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.records.json_files import json_text, plain
from analysis.records.provenance import provenance_of
from analysis.records.quantities import quantity
from analysis.records.records import record_folder, require_replaceable
from landscape.errors import InputError
from splat.curvature.scores.information import GAINS, Information, gains, gains_of_each, informations, prior_of
from splat.scenes.scene import Scene
from splat.training.checkpoint import open_subject
from splat.training.origin.subject import Checkpoint, data_of

RECORD = "next-view.json"  # the file by which a folder of results is known


def run_next_view(options: NextViewOptions, command: Sequence[str]) -> int:
    """Judge the candidates; returns the exit code.  command: as typed, for the record."""
    require_known("by", options.by, GAINS)
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
            table = judged_alone(seen, {name: known[name] for name in candidates}, options.by)
            table = table.join(geometry(checkpoint.scene.train, candidates, known, scene))
            table.index.name = "view"
            for place, name in enumerate(picked(seen, known, candidates, options.take, options.by)):
                table.loc[name, "pick"] = place + 1
            table = table.sort_values(["pick", options.by], ascending=[True, False])
            table.to_csv(folder / "gains.csv")
        judged = checkpoint.fingerprint({"take": options.take, "by": options.by}, 0, further=data_of(scene, candidates))
        made = provenance_of(judged, subject, command)
        (folder / RECORD).write_text(json_text(plain(made)), encoding="utf-8")
        notes = draw("uses", folder)
    _conclude(table, options, out)
    say(*notes, *checkpoint.assumptions, style="yellow", console=Console(stderr=True))
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


def judged_alone(seen: Sequence[Information], candidates: Mapping[str, Information], by: str) -> pd.DataFrame:
    """Gains over the training views alone, a row for each candidate, and how far it is behind the best, with the error."""
    total = sum(seen[1:], seen[0])
    parts = {name: gains_of_each(total, prior_of(total), each) for name, each in candidates.items()}
    best = max((each[by] for each in parts.values()), key=lambda part: float(part.sum()))
    rows = {}
    for name, each in parts.items():
        behind = best - each[by]
        error = float(behind.std() * len(behind) ** 0.5)
        rows[name] = {gain: float(part.sum()) for gain, part in each.items()} | {
            "behind": float(behind.sum()),
            "error": error,
        }
    return pd.DataFrame(rows).T


def geometry(
    train: Sequence[str], candidates: Sequence[str], known: Mapping[str, Information], scene: Scene
) -> pd.DataFrame:
    """What three rules that ask for no curvature say of each candidate."""
    sees = {name: known[name].diagonal.sum(dim=1) > 0 for name in (*train, *candidates)}
    views = torch.stack([sees[name] for name in train]).sum(dim=0)
    centres = {frame.name: frame.camera.centre for frame in scene.frames}
    rows = {}
    for name in candidates:
        far = min(float((centres[name] - centres[other]).norm()) for other in train)
        places = min(abs(scene.names.index(name) - scene.names.index(other)) for other in train)
        rows[name] = {"coverage": float((sees[name] / (1 + views)).sum()), "farthest": far, "uniform": float(places)}
    return pd.DataFrame(rows).T


def _conclude(table: pd.DataFrame, options: NextViewOptions, out: Path) -> None:
    console, behind = Console(), [quantity(*each) for each in zip(table["behind"], table["error"], strict=True)]
    shown = table.assign(behind=behind).reset_index().filter(["view", options.by, *GEOMETRY, "behind", "pick"])
    console.print(rich_table(shown, f"behind: the best by {options.by} ± its error over Gaussians"))
    names, equal = ", ".join(table.index[table.pick.notna()]), [*table.index[table.behind <= TWICE * table.error]]
    say(f"next, by {options.by}: {names}", console=console)
    if len(equal) > 1:
        say(f"the first {len(equal)} are equal within twice their error: {', '.join(equal)}", console=console)
    best = "; ".join(f"by {rule}: {table[rule].idxmax()}" for rule in GEOMETRY)
    say(f"without curvature {best}", f"gains.csv, gains.png in {out}", console=console)
