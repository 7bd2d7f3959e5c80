"""`landscape compare`: several probed runs in one table and on one page.

OUT/compare.html    everything side by side; needs no network
OUT/compare.csv     every number, see `analysis/runs/compare_table.py`
OUT/compare.json    {"runs": {LABEL: folder of its record}}, from which `figures/compare.py` draws
OUT/*.png           traces, densities of the spectrum and slices in common limits

What must be the same for curvatures to be comparable at all is demanded: the loss that was probed, the training views and their
sizes.  Runs that were trained with other losses are probed with that of 3DGS (`landscape probe --loss 3dgs`).  What must be
kept in mind beside that is said: other starts, steps, losses of training, budgets, failed checks, numbers of Gaussians.
"""

import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from analysis.console.drawing import draw
from analysis.console.plain import say
from analysis.records.findings import of_budgets, of_checks, unresolved
from analysis.records.json_files import json_text, plain
from analysis.records.page.report import pictures_in, template_environment
from analysis.records.provenance import require_alike
from analysis.records.quantities import quantity
from analysis.records.records import ProbeRecord, read_record
from analysis.records.run_files import COMPARISON, Comparison
from analysis.runs.compare_table import Row, Run, compare_table, comparison, frame
from analysis.runs.compared import checkpoint_path, compared, probe, probe_command, probe_folder, probed, scores_of
from analysis.runs.options import CompareOptions
from analysis.runs.seeds import SPREAD, Group, grouped, groups_of, headings, sayings
from landscape.errors import InputError
from splat.training.checkpoint import write_atomically
from splat.training.origin.fingerprint import changes, in_short
from splat.training.origin.subject import Checkpoint

PAGE, TABLE = "compare.html", "compare.csv"
ASKED = ("settings.", "seed", "objective.of")  # of the question: cautions have its other parts
PICTURES = {
    "compare_traces": "Traces by attribute; a line: the interval, where it is longer than the marker. Open markers: negative; "
    "crosses: not decided.",
    "compare_densities": "How many directions are at least so curved, down (left) and up (right). Thin: each start "
    "vector's quadrature alone: where these lie apart, its few steps do not decide. Dotted: the extreme eigenvalues.",
    "compare_slices": "The plane of the two steepest directions of each run, in the window that all have, the same colours.",
    "compare_sections": "The loss along the two steepest directions of each run, in units of the parameters.",
}


def run_compare(options: CompareOptions) -> int:
    """Read, probe where asked to, compare; returns the exit code."""
    groups = groups_of(options.runs)
    paths = [folder for group in groups for folder in group.folders]
    folders = _folders(paths)
    common = Path(os.path.commonpath(folders))
    common = common.parent if common in folders else common
    labels = [str(folder.relative_to(common)) for folder in folders]
    checkpoints = [compared(path, options) for path in paths]
    require_same(labels, checkpoints, trained_alike=False)
    of_training = [checkpoint.training.config.loss for checkpoint in checkpoints]
    loss = "training" if of_training == of_training[:1] * len(of_training) else "3dgs"
    missing = [path for path, checkpoint in zip(paths, checkpoints) if not probed(path, checkpoint)]
    others = [path for path in missing if (probe_folder(path) / ProbeRecord.FILE).is_file()]
    if missing and not options.probe:
        again = "; ".join(probe_command(path, options, loss) for path in missing)
        there = f", where {probe_folder(others[0])} is of another" if missing[0] in others else ""
        raise InputError(
            f"expected probed runs, got no record of the checkpoint in {missing[0]}{there}; run {again}, or add --probe"
        )
    notes = [
        f"{probe_folder(path)} was of another checkpoint or renderer, and has been measured anew" for path in others
    ]
    for path in missing:
        probe(path, options, loss)
    records = [read_record(probe_folder(path), ProbeRecord).data for path in paths]
    scores = [scores_of(path, checkpoint, notes) for path, checkpoint in zip(paths, checkpoints)]
    runs = [Run(*each) for each in zip(paths, labels, checkpoints, scores, records)]
    losses = {run.label: run.data.objective.loss for run in runs}
    require_alike("loss", losses, "probe all of them with --loss 3dgs")
    named = [replace(group, label=os.path.relpath(Path(group.label).resolve(), common)) for group in groups]
    _write(runs, named, notes, options.out or common / "compare")
    return 0


def _folders(runs: Sequence[Path]) -> list[Path]:
    folders = [run.resolve() for run in runs]
    if len(set(folders)) < 2 or len(set(folders)) < len(folders):
        named = ", ".join(map(str, runs)) or "none"
        raise InputError(
            f"expected at least two runs, each once, got {named}; name them as in landscape compare RUN OTHER"
        )
    return folders


def require_same(labels: Sequence[str], checkpoints: Sequence[Checkpoint], *, trained_alike: bool = True) -> None:
    """InputError where the runs' curvatures are those of different functions; trained_alike: of the loss of training."""
    demanded: dict[str, Callable[[Checkpoint], Any]] = {
        "training views": lambda c: c.scene.train,
        "sizes of the views": lambda c: c.scene.sizes,
        "background": lambda c: c.training.config.background,
    }
    if trained_alike:
        demanded["loss"] = lambda c: c.training.config.loss
    for what, of in demanded.items():
        require_alike(what, dict(zip(labels, map(of, checkpoints), strict=True)), "compare them apart")


def cautions(runs: Sequence[Run], seeds: bool = False) -> list[str]:
    """Differences between the runs, and lacks of some, that a reader has to keep in mind.  seeds: which differ here."""
    settings: dict[str, Callable[[Run], Any]] = {
        "scene": lambda run: run.data.provenance.scene,
        "steps": lambda run: run.checkpoint.training.step,
        "start": lambda run: getattr(run.checkpoint.scene, "start", None),
        "seed": lambda run: run.checkpoint.training.config.seed,
        "held-out views": lambda run: run.checkpoint.scene.test,
        "losses of the trainings": lambda run: run.checkpoint.training.config.loss,
        "protocol": lambda run: run.checkpoint.training.config.protocol,
        "random background": lambda run: run.checkpoint.training.config.random_background,
        "precision": lambda run: run.data.provenance.dtype,
    }
    lines = [f"The {what} are not the same." if what.endswith("s") else f"The {what} is not the same."
             for what, of in settings.items()
             if any(of(run) != of(runs[0]) for run in runs) and not (seeds and what == "seed")]  # fmt: skip
    if len({row.unit for run in runs for row in run.data.per_attribute or ()}) > 1:
        lines.append("The units of --per-attribute are not the same.")
    lines += _apart(runs)
    said: list[tuple[Run, str]] = []
    for run in runs:
        if run.data.slice and not run.data.slice.is_resolved:
            said.append((run, unresolved(run.data.slice, run.data.provenance)))
        said += [(run, line.text) for line in of_checks(run.data.checks)]
        ends = {"max": run.data.eigenvalues.max.reason, "min": run.data.eigenvalues.min.reason}
        said += [(run, line.text) for line in of_budgets(ends)]
        said += [(run, "It was not scored.")] * (run.scores is None)
    lines += _once(said)
    if without := [run for run in runs if not run.data.split_control]:
        lines.append(
            "Anisotropy depends on the number of Gaussians; how much, the split control says, which is missing:"
            + "".join(
                f"\n  landscape probe {shlex.quote(str(checkpoint_path(run.folder)))} --split-control"
                for run in without
            )
        )
    return lines


def _apart(runs: Sequence[Run]) -> list[str]:
    """What differs between the probes, part by part of their fingerprints: views, settings, formulas."""
    pairs = [(run, made) for run in runs if (made := run.data.provenance.fingerprint)]
    found, labels, lines = [made for _, made in pairs], [run.label for run, _ in pairs], []
    for run, made in pairs:
        views = run.checkpoint.scene.views
        trained = {name: views[name] for name in made.data if name in views}
        for words, views in (("of its training", trained), (f"of {labels[0]}", found[0].data)):
            if moved := changes({name: view for name, view in views.items() if name in made.data}, made.data):
                lines.append(f"The views of {run.label}'s probe are not those {words}: {in_short(moved)}.")
    asked = [
        {k.removeprefix("settings."): v for k, v in each.question.items() if k.startswith(ASKED)} for each in found
    ]
    different = [
        f"{name} {', '.join(str(settings.get(name)) for settings in asked)}"
        for name in dict.fromkeys(name for settings in asked for name in settings)
        if any(settings.get(name) != asked[0].get(name) for settings in asked)
    ]
    if different:
        lines.append(
            f"The probes were run with different settings (those of {', '.join(labels)}): {'; '.join(different)}."
        )
    if len(versions := sorted({made.formulas for made in found})) > 1:
        lines.append(f"The probes are of versions {', '.join(map(str, versions))} of the formulas: probe again.")
    return lines


def split_controls(runs: Sequence[Run]) -> list[str]:
    """Lines on what the split changes in the images of each run that has a split control."""
    lines = []
    for run in runs:
        if control := run.data.split_control:
            seen = next((row.gaussians for row in run.data.per_attribute or () if row.split), control.gaussians)
            gone = control.gaussians - seen
            lost = f", and {gone:,} of the halves touch no pixel." if gone > 0 else "."
            lines.append(
                f"{run.label}: the split into {control.gaussians:,} halves changes the images by {quantity(control.rms)} "
                f"(root mean square; {quantity(control.psnr)} dB){lost}"
            )
    return lines


def _once(lines: Sequence[tuple[Run, str]]) -> list[str]:
    """Remarks on runs; one for all runs whose remarks differ only in the command that mends them."""
    alike: dict[str, list[tuple[Run, str]]] = {}
    for run, text in lines:
        alike.setdefault(text.partition("; landscape ")[0], []).append((run, text))
    return [
        f"{group[0][0].label}: {group[0][1]}"
        + (f"  So it is of {', '.join(run.label for run, _ in group[1:])}." if group[1:] else "")
        for group in alike.values()
    ]


def _write(runs: Sequence[Run], groups: Sequence[Group], found: Sequence[str], out: Path) -> None:
    """Table, pictures, page; and what it says, the cautions and the table once more for the terminal.

    found: the cautions so far.
    """
    console, labels = Console(), [run.label for run in runs]
    rows, notes = comparison(runs), [*found, *cautions(runs, any(len(group.folders) > 1 for group in groups))]
    shown = grouped(rows, groups)
    says = sayings(shown, groups)
    shown_runs = {folder: group.label for group in groups for folder in group.folders[:1]}
    if len(shown_runs) < len(runs):
        notes.append(f"The pictures show the first run of each group: {', '.join(map(str, shown_runs))}.")
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / TABLE, frame(rows, labels).to_csv(index=False).encode(errors="backslashreplace"))
    made = {run.folder: run.data.provenance.fingerprint for run in runs}
    index = Comparison(
        runs={label: str(probe_folder(folder).resolve()) for folder, label in shown_runs.items()},
        fingerprints={label: of for folder, label in shown_runs.items() if (of := made[folder])},
    )
    write_atomically(out / COMPARISON, json_text(plain(index)).encode())
    for name in PICTURES:  # of an earlier comparison, which may show what this one has no numbers for
        (out / f"{name}.png").unlink(missing_ok=True)
    notes += draw("compare", out)
    write_atomically(out / PAGE, render_page(runs, groups, shown, says, notes, out).encode(errors="backslashreplace"))
    say(*says, console=console)
    say(*notes, style="yellow", console=console)
    console.print(compare_table(shown, headings(groups)))
    say(*[SPREAD] * (len(groups) < len(runs)), console=console)
    say(f"open {out / PAGE}; numbers: {out / TABLE}", console=console)


def render_page(
    runs: Sequence[Run],
    groups: Sequence[Group],
    rows: Sequence[Row],
    says: Sequence[str],
    notes: Sequence[str],
    out: Path,
) -> str:
    """The page as text, with the pictures that lie in the folder.  groups: of the rows' columns."""
    environment = template_environment()
    names = dict.fromkeys(row.section for row in rows)
    sections = {name: [row for row in rows if row.section == name] for name in names}
    return environment.get_template("compare.html.jinja").render(
        runs=runs,
        headings=headings(groups),
        spread=SPREAD if len(groups) < len(runs) else "",
        alone=any(len(group.folders) == 1 for group in groups),
        says=says,
        sections=sections,
        notes=notes,
        controls=split_controls(runs),
        pictures=pictures_in(out, PICTURES),
        objective=runs[0].data.objective,
    )
