"""`landscape map`: where a checkpoint's loss is curved, as numbers of every Gaussian and as pictures of the training views.

    fields.ply          the Gaussians as 3DGS writes them, and every field (`splat.curvature.fields`) as a property of its
                        name; nan where no view sees a Gaussian
    FIELD.ply           the Gaussians in the colours of one field, grey where it has no value; opens in every viewer
    top.csv             the hundred Gaussians with its largest values
    view-NNN.png        each training view: photograph, render, error, and the field composited with the splats' weights
    fragility-NNN.png   each training view: where it is fragile in position, conditioning and opacity
    steepest-*.png      with a probe beside the checkpoint: the Gaussians that carry both ends of the spectrum
    map.json            the record (`MapRecord`); NAME.npz: the pictures' maps, in bytes

Everything is computed on the CPU.  The ends of a map's scale are percentiles over the Gaussians in sight, by their weight in
the images.
"""

import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool, Float64
from rich.console import Console
from torch import Tensor

from analysis.commands.map.fields import ENDS, PROBE, Fields, in_words, measured_fields
from analysis.commands.map.pictures import error_shade, view_maps, write_maps
from analysis.commands.options import MapOptions
from analysis.console.drawing import Draw
from analysis.console.options import require_known
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.measures.fragility import fragility, fragility_sentences
from analysis.measures.steepest import steepest
from analysis.records.json_files import json_text, plain
from analysis.records.provenance import provenance_of
from analysis.records.quantities import GREY, Shade
from analysis.records.records import record_folder, require_replaceable
from analysis.records.run_files import MAP, Fragility, MapRecord, Panel, Steepest
from landscape.errors import InputError
from landscape.results import Progress
from splat.backend.cpu.threads import single_threaded
from splat.curvature.fields import FIELDS, Field, Values
from splat.curvature.objective import SceneObjective
from splat.model.files.splat_ply import splat_ply
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.projection.antialias import baked
from splat.scenes.view import View
from splat.training.checkpoint import open_subject
from splat.training.origin.subject import Checkpoint

AXES = ("order_gap", "condition", "one_view")  # of fragility


def run_map(options: MapOptions, command: Sequence[str], drawn: Draw) -> int:
    """Map the checkpoint; returns the exit code.  command: as typed, for the record; drawn: draws the pictures."""
    out, probe = options.out or options.checkpoint.parent / MAP, options.checkpoint.parent / PROBE
    require_known("field", options.shown, (*FIELDS, *ENDS))
    start, notes = perf_counter(), list[str]()
    require_replaceable(out, MapRecord.FILE)
    stages = Stages(Console(stderr=True))
    with stages.stage("load"):
        subject = open_subject(options.checkpoint, options.foreign, out)
        checkpoint = subject.checkpoint
        objective = subject.objective()
        chosen = _chosen(options.draw, objective.views)
    made = checkpoint.fingerprint({"field": options.shown, "draw": options.draw}, options.seed)
    gaussians = checkpoint.training.gaussians
    with record_folder(out, MapRecord.FILE) as folder, stages, ThreadPoolExecutor(1) as beside:
        with stages.stage("fields") as report:
            found = measured_fields(objective, probe, made, notes, report)
        if options.shown not in found.values:
            raise InputError(
                f"expected a probe with eigenvectors of this checkpoint in {probe} for --field {options.shown}, got none; "
                "run landscape probe first"
            )
        # beside the next stages, which use one processor
        swapping = beside.submit(_fragility, objective, found, options.seed)
        with stages.stage("maps") as report:
            shades = {name: found.shade(name) for name in dict.fromkeys((options.shown, *AXES))}
            shares = {name: torch.from_numpy(shade.share(found.values[name].numpy())) for name, shade in shades.items()}
            shades["error"], panels = error_shade(objective), list[Panel]()  # of the error one scale for all views
            for index in chosen:
                maps, psnr = view_maps(objective, index, shares, shades["error"])
                name, file = objective.views[index].name, f"view-{index:03d}"
                write_maps(folder / f"{file}.npz", maps)
                panels.append(Panel(name=name, place=index, file=file, psnr=psnr))
                report(len(panels), len(chosen), "views")
        with stages.stage("steepest") as report:
            shown = _write_ends(folder, objective, found, report)
        with stages.stage("files"):
            first = _write_files(folder, gaussians, objective, found.values, shades[options.shown])
        with stages.stage("fragility"):
            fragile = swapping.result()
        data = MapRecord(
            gaussians=len(gaussians), seen=len(objective.active), field=options.shown, shades=shades, panels=panels,
            sentences=[f"{each.sentence} {each.rendered}" for each in shown] + fragility_sentences(fragile),
            steepest=shown, fragility=fragile, notes=notes + checkpoint.assumptions + _views_left_out(checkpoint),
            provenance=provenance_of(made, subject, command),
        )  # fmt: skip
        _write(folder, data)
        with stages.stage("pictures"):
            data.notes += drawn(folder)
        data.timing = {**stages.timing, "total": perf_counter() - start}
        _write(folder, data)
    if found.ends:
        from analysis.records.page.report import write_report  # slow to import

        write_report(probe)  # its page shows the map's pictures
    _conclude(data, first, found.kinds[options.shown], out)
    return 0


def _chosen(names: Sequence[str], views: Sequence[View]) -> list[int]:
    """Indices of the views named, by file name, full name or index; by default all."""
    places = {view.name: i for i, view in enumerate(views)} | {Path(view.name).name: i for i, view in enumerate(views)}
    places |= {str(i): i for i in range(len(views))}
    if unknown := [name for name in names if name not in places]:
        raise InputError(
            f"expected --draw of a training view, 0 to {len(views) - 1} or a name such as {views[0].name}, got {unknown[0]!r}"
        )
    return sorted({places[name] for name in names}) or [*range(len(views))]


@single_threaded()
def _fragility(objective: SceneObjective, found: Fields, seed: int) -> Fragility:
    generator = torch.Generator().manual_seed(seed)
    return fragility(objective, found.values, found.sights, generator, lambda *_: None)


def _write_ends(folder: Path, objective: SceneObjective, found: Fields, report: Progress) -> list[Steepest]:
    """The known ends of the spectrum; writes their pictures."""
    shown = []
    for done, (name, end) in enumerate(found.ends.items()):
        one, pictures = steepest(objective, end, found.values, found.sights, f"steepest-{name}")
        write_maps(folder / f"{one.file}.npz", pictures)
        shown.append(one)
        report(done + 1, len(found.ends), "directions")
    return shown


def _write_files(
    folder: Path, gaussians: Gaussians, objective: SceneObjective, values: Values, shade: Shade
) -> dict[str, Any]:
    """Write the splats and the table; returns the first row of the table, by column.  shade: of the field that is shown."""
    field = shade.name
    (folder / "fields.ply").write_bytes(fields_ply(gaussians, objective.mask, values))
    (folder / f"{field}.ply").write_bytes(coloured_ply(gaussians, objective.mask, shade, values[field]))
    top = top_table(objective, values, field)
    top.to_csv(folder / "top.csv", index=False, float_format="%.6g")
    return dict(top.iloc[0])


def _views_left_out(checkpoint: Checkpoint) -> list[str]:
    if checkpoint.all_views is None:
        return []
    seen = len(checkpoint.scene.train)
    return [
        f"measured on {seen} of {checkpoint.all_views} training views; what the others would change is not known of single "
        "Gaussians, which may be seen by none of the views measured"
    ]


def _write(folder: Path, data: MapRecord) -> None:
    (folder / data.FILE).write_text(json_text(plain(data)), encoding="utf-8")


def _conclude(data: MapRecord, first: Mapping[str, Any], kind: Field, out: Path) -> None:
    say(f"{data.seen:,} of {data.gaussians:,} Gaussians are in sight", *data.sentences)
    if not data.steepest:
        say(
            f"for Gaussians that carry the steepest directions: {data.provenance.other_command('probe')}, then map again"
        )
    most = f"most of it at Gaussian {int(first['gaussian']):,}"
    say(f"of each Gaussian by itself, {kind.words}: {most}, {in_words(kind, float(first[data.field]))}")
    say(*data.notes, style="yellow")
    names = [re.sub(r"-\d{3,}[.]", "-NNN.", path.name) for path in sorted(out.glob("*.png"))]
    pictures = ", ".join(dict.fromkeys(names)) or "none"
    say(f"pictures: {pictures}; splats: fields.ply, {data.field}.ply; table: top.csv; in {out}")


TOP = 100


def fields_ply(gaussians: Gaussians, seen: Bool[Tensor, " n"], values: Values) -> bytes:
    """All Gaussians with their fields, nan out of sight."""
    extra = {}
    for name, column in values.items():
        extra[name] = np.full(len(gaussians), np.nan, np.float32)
        extra[name][seen.numpy()] = column.numpy()
    return splat_ply(gaussians, extra)


def coloured_ply(gaussians: Gaussians, seen: Bool[Tensor, " n"], shade: Shade, values: Float64[Tensor, " m"]) -> bytes:
    """All Gaussians, each in the colour of its value, the same from everywhere."""
    rgb = torch.full((len(gaussians), 3), GREY / 255)
    rgb[seen] = torch.from_numpy(shade.colours_of(values.numpy()))
    attributes = gaussians.attributes | {"sh": ((rgb - 0.5) / Y00)[:, None].to(gaussians.flat)}
    return splat_ply(baked(Gaussians.pack(attributes).with_filter(gaussians.filter_widths)))


def top_table(objective: SceneObjective, values: Values, by: str) -> pd.DataFrame:
    """The Gaussians with the largest |field|, or the smallest `order_gap`: every number, place, size and opacity of each.

    gaussian: its number among all of the checkpoint.  sigma_0 to 2: standard deviations, world units, the largest first.
    """
    column = values[by].abs()
    order = torch.where(column.isnan(), -torch.inf, -column if by == "order_gap" else column)
    chosen = order.argsort(descending=True, stable=True)[:TOP]
    active = objective.active
    sigmas = active.log_scales[chosen].double().exp().sort(dim=1, descending=True).values
    table = {"gaussian": objective.mask.nonzero()[:, 0][chosen].numpy()}
    table |= {name: found[chosen].numpy() for name, found in values.items()}
    table |= dict(zip("xyz", active.means[chosen].double().numpy().T))
    table |= {f"sigma_{i}": sigma for i, sigma in enumerate(sigmas.numpy().T)}
    return pd.DataFrame(table | {"opacity": active.opacity_logits[chosen].double().sigmoid().numpy()})
