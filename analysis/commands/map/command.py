"""`landscape map`: where a checkpoint's loss is curved, as numbers of every Gaussian and as pictures of the training views.

    fields.ply          the Gaussians as 3DGS writes them, and every field (`splat.curvature.fields`) as a property of its
                        name; nan where no view sees a Gaussian
    FIELD.ply           the Gaussians in the colours of one field, grey where it has no value; opens in every viewer
    top.csv             the hundred Gaussians with the largest values of that field
    view-NNN.png        each training view: photograph, render, error, and the field composited with the splats' weights
    fragility-NNN.png   each training view: where it is fragile in position, conditioning and opacity
    steepest-*.png      with a probe beside the checkpoint: the Gaussians that carry both ends of the spectrum
    map.json            the record (`MapRecord`); NAME.npz: the pictures' maps, in bytes

Everything is computed on the CPU.  The ends of a map's scale are percentiles over the Gaussians in sight, by their weight in
the images.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from msgspec import structs
from rich.console import Console

from analysis.commands.map.files import coloured_ply, csv_text, fields_ply, top_table
from analysis.commands.map.pictures import error_shade, view_maps, write_maps
from analysis.commands.options import MapOptions
from analysis.console.drawing import Draw
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.measures.fragility import fragility, fragility_sentences
from analysis.measures.localization import masses
from analysis.measures.steepest import End, steepest
from analysis.probe.command import opened, scene_objective
from analysis.probe.record import provenance_of
from analysis.records.json_files import json_text, plain
from analysis.records.quantities import Shade, percent, quantity
from analysis.records.records import record_folder, require_replaceable
from analysis.records.run_files import MAP, Fragility, MapRecord, Panel, Steepest
from analysis.slice.directions import recorded_probe
from landscape.errors import InputError, did_you_mean
from landscape.results import Progress
from splat.backend.cpu.threads import single_threaded
from splat.curvature.fields import FIELDS, Field, Values, scene_fields
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import Gaussians
from splat.render.sight import Sight
from splat.scenes.view import View
from splat.training.checkpoint import Checkpoint
from splat.training.origin.fingerprint import Fingerprint

ENDS = {"e1": "e₁", "e_min": "eₘᵢₙ"}  # fields of a probe's eigenvectors: the share of each in a Gaussian
AXES = ("order_gap", "condition", "one_view")  # of fragility
PROBE = "probe"


@dataclass(frozen=True, eq=False)
class Fields:
    """Fields of the Gaussians in sight, with their kinds.  ends: of the spectrum that a probe recorded, by field."""

    values: Values
    kinds: Mapping[str, Field]
    ends: Mapping[str, End]
    sights: Sequence[Sight]

    @property
    def weight(self) -> np.ndarray:
        return self.values["weight"].numpy()

    def shade(self, name: str) -> Shade:
        """The scale of a field; of `one_view` from 1 / views, equal weights, to 1."""
        kind, views = self.kinds[name], len(self.sights)
        shade = Shade.of(name, kind.words, kind.unit, kind.scale, self.values[name].numpy(), self.weight)
        return structs.replace(shade, low=1 / views, high=1.0) if name == "one_view" and views > 1 else shade


def in_words(kind: Field, value: float) -> str:
    """A value of a field with its unit: whole numbers as such, shares in percent.

    >>> [in_words(FIELDS[name], x) for name, x in (("views", 2.0), ("one_view", 1.0), ("weight", 2.5))]
    ['2', '100%', '2.50 px']
    """
    whole = f"{value:,.0f}" if value.is_integer() else quantity(value)
    return f"{percent(value) if kind.words.startswith('share') else whole} {kind.unit}".rstrip()


def run_map(options: MapOptions, command: Sequence[str], drawn: Draw) -> int:
    """Map the checkpoint; returns the exit code.  command: as typed, for the record; drawn: draws the pictures."""
    out, probe = options.out or options.checkpoint.parent / MAP, options.checkpoint.parent / PROBE
    require_known_field(options.shown, [*FIELDS, *ENDS])
    start, notes = perf_counter(), list[str]()
    require_replaceable(out, MapRecord.FILE)
    stages = Stages(Console(stderr=True))
    with stages.stage("load"):
        checkpoint, scene = opened(options.checkpoint, options.scene, options.foreign, out)
        objective = scene_objective(checkpoint, scene)
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
        # beside the next stages, none of which uses more than one processor
        swapping = beside.submit(_fragility, objective, found, options.seed)
        with stages.stage("maps") as report:
            shades = {name: found.shade(name) for name in dict.fromkeys((options.shown, *AXES))}
            panels = _write_panels(folder, objective, found, shades, chosen, report)
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
            provenance=provenance_of(made, options.checkpoint, command, checkpoint, scene),
        )  # fmt: skip
        _write(folder, data)
        with stages.stage("pictures"):
            data.notes += drawn(folder)
        data.timing = {**stages.timing, "total": perf_counter() - start}
        _write(folder, data)
    if found.ends:
        from analysis.records.report import write_report  # slow to import

        write_report(probe)  # its page shows the map's pictures
    _conclude(data, first, found.kinds[options.shown], out)
    return 0


def require_known_field(name: str, known: Sequence[str]) -> None:
    """InputError unless --field names one of these."""
    if name not in known:
        raise InputError(f"expected --field {', '.join(known)}, got {name!r}{did_you_mean(name, known)}")


def _chosen(names: Sequence[str], views: Sequence[View]) -> list[int]:
    """Indices of the views named, by file name, full name or index; by default all."""
    places = {view.name: i for i, view in enumerate(views)} | {Path(view.name).name: i for i, view in enumerate(views)}
    places |= {str(i): i for i in range(len(views))}
    if unknown := [name for name in names if name not in places]:
        raise InputError(
            f"expected --draw of a training view, 0 to {len(views) - 1} or a name such as {views[0].name}, got {unknown[0]!r}"
        )
    return sorted({places[name] for name in names}) or [*range(len(views))]


def measured_fields(
    objective: SceneObjective, probe: Path, made: Fingerprint, notes: list[str], report: Progress
) -> Fields:
    """Fields of the blocks and the views, and masses in the eigenvectors of the probe, where that is of what is asked for."""
    values, sights = scene_fields(objective, report)
    ends, kinds, recorded = {}, dict(FIELDS), recorded_probe(probe, made, notes)
    if recorded is not None:
        about, vectors = recorded.data.eigenvalues, recorded.arrays["eigenvectors"]
        known = {
            "e1": ("largest", about.max, "the steepest direction"),
            "e_min": ("smallest", about.min, "the other end"),
        }
        for name, (group, end, title) in known.items():
            if group in vectors and vectors[group].shape[1] and end.value:
                title = "the most negative direction" if end.value < 0 else title
                ends[name] = End(ENDS[name], title, torch.from_numpy(vectors[group][:, 0]), end.value)
                values[name] = masses(ends[name].vector, objective.active)
                kinds[name] = Field(f"share of {ENDS[name]}", "", "log")
    return Fields(values, kinds, ends, sights)


@single_threaded()
def _fragility(objective: SceneObjective, found: Fields, seed: int) -> Fragility:
    generator = torch.Generator().manual_seed(seed)
    return fragility(objective, found.values, found.sights, generator, lambda *_: None)


def _write_panels(
    folder: Path,
    objective: SceneObjective,
    found: Fields,
    shades: dict[str, Shade],
    chosen: Sequence[int],
    report: Progress,
) -> list[Panel]:
    """Write the maps of the chosen views; adds to the shades the scale of the error, which all views share."""
    names, panels = list(shades), []
    shares = {name: torch.from_numpy(shades[name].share(found.values[name].numpy())) for name in names}
    shades["error"] = error_shade(objective)
    for done, index in enumerate(chosen):
        maps, psnr = view_maps(objective, index, shares, shades["error"])
        file = f"view-{index:03d}"
        write_maps(folder / f"{file}.npz", maps)
        panels.append(Panel(name=objective.views[index].name, place=index, file=file, psnr=psnr))
        report(done + 1, len(chosen), "views")
    return panels


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
    (folder / "top.csv").write_text(csv_text(top), encoding="utf-8")
    return {name: column[0] for name, column in top.items()}


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
        say("for the Gaussians that carry the steepest directions: landscape probe, then map again")
    say(f"{kind.words}: most of it at Gaussian {int(first['gaussian']):,}, {in_words(kind, float(first[data.field]))}")
    say(*data.notes, style="yellow")
    pictures = ", ".join(path.name for path in sorted(out.glob("*.png"))[:4]) or "none"
    more = "" if len(data.panels) <= 4 else ", ..."
    say(f"pictures: {pictures}{more}; splats: fields.ply, {data.field}.ply; table: top.csv; in {out}")
