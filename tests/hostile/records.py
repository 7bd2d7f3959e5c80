"""What our own commands write and read: runs, records, what an interrupted command goes on from, and what notebooks read."""

import io
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from analysis.records.page import report
from analysis.records.records import ProbeRecord, SliceRecord, read_record
from splat.scenes.view import View
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.loop import train
from splat.training.origin.subject import Checkpoint
from splat.training.state import Training
from tests.hostile.broken import Read, Reader
from tests.hostile.mutations import Random
from tests.recorded import synthetic, synthetic_line, written, written_map
from tests.splat.tiny import EXTENT, REFERENCE, tiny_config, tiny_gaussians, tiny_views

DRAWN = 0.01  # of the records that are accepted are drawn too, which takes most of the time


@cache
def views() -> list[View]:
    return tiny_views()


def tiny_training() -> Training:
    training = Training.start(tiny_gaussians(), EXTENT, tiny_config())
    next(iter(train(training, views())))
    return training


def _write_checkpoint(root: Path) -> None:
    save_checkpoint(root / "checkpoint.pt", tiny_training(), REFERENCE)


def _use_checkpoint(root: Path, chance: Random) -> Read:
    training = load_checkpoint(root / "checkpoint.pt").training
    flat = training.gaussians.flat.clone()
    if flat.dtype == torch.float32 and not training.config.method.name.startswith("cor"):
        try:
            next(iter(train(training, views())), None)
        except NotImplementedError:
            return [flat]
    save_checkpoint(root / "again.pt", training, REFERENCE)
    load_checkpoint(root / "again.pt")
    return [flat]


def _write_probes(root: Path) -> None:
    from tests.analysis.runs.test_compare import record

    for run, scale in ((root, 1.0), (root / "other", 0.5)):
        run.mkdir(exist_ok=True)
        _write_checkpoint(run)
        record(run / "probe", scale)


def _use_probes(root: Path, chance: Random) -> Read:
    from analysis.records.findings import findings
    from analysis.records.tables import family_table, number_rows
    from analysis.runs.compare import cautions, render_page
    from analysis.runs.compare_table import Run, compare_table, comparison, frame
    from analysis.runs.seeds import groups_of

    record, other = (read_record(run / "probe", ProbeRecord) for run in (root, root / "other"))
    checkpoint = Checkpoint(Training.start(tiny_gaussians(), EXTENT, tiny_config()), REFERENCE)
    with io.StringIO() as quiet:
        console = Console(file=quiet, width=100)
        number_rows(record.data)
        console.print(family_table(record.data))
        findings(record.data)
        runs = [Run(root, name, checkpoint, None, each.data) for name, each in (("a", record), ("b", other))]
        rows = comparison(runs)
        frame(rows, ["a", "b"]).to_csv(index=False)
        console.print(compare_table(rows, ["a", "b"]))
    render_page(runs, groups_of([Path("a"), Path("b")]), rows, [], cautions(runs), root)
    report.render_report(record)
    _draw(record, chance)
    return [array for arrays in record.arrays.values() for array in arrays.values()]


def _draw(record: Any, chance: Random) -> None:
    if chance.random() < DRAWN:
        import matplotlib.pyplot as plt

        from figures.make_all import FIGURES, recorded_figures

        for name in recorded_figures(record):
            if name != "surface":
                plt.close(FIGURES[name](record))


def _use_slice(root: Path, chance: Random) -> Read:
    from analysis.slice.command import _conclude

    record = read_record(root / "slice", SliceRecord)
    _conclude(record.data, record.folder)
    _draw(record, chance)
    return None


def _write_origin(root: Path) -> None:
    data, arrays = synthetic()
    preset = {"render": {"antialias": "none"}, "loss": {"opacity_reg": 0.0, "scale_reg": 0.01}}
    origin = {"trained_by": "gsplat", "images": None, "downscale": 2.0, "preset": preset, "notes": ["assumed"]}
    data["provenance"] |= {"origin": origin, "scene_folder": "fern", "views": ["a.png"]}
    written(root / "probe", data, arrays)


def _use_origin(root: Path, chance: Random) -> Read:
    from analysis.runs.compared import _as_probed

    made = read_record(root / "probe", ProbeRecord).data.provenance
    if made.origin and made.scene_folder:
        _as_probed(made)
    return None


def _write_map(root: Path) -> None:
    from analysis.records.json_files import plain
    from splat.training.origin.fingerprint import Fingerprint
    from tests.analysis.records.test_report import with_views

    data, _ = synthetic()
    data["provenance"]["fingerprint"] = plain(Fingerprint({}, {}, "00"))
    written_map(root / "map", data["provenance"])
    with_views(root / "probe", ["a.png"], data)


def _use_map(root: Path, chance: Random) -> Read:
    text = report.render_report(read_record(root / "probe"))
    assert text.rstrip().endswith("</html>") and "photograph" in text, "a page without its own pictures"
    return None


def _write_numbers_of_a_run(root: Path) -> None:
    scores = {"psnr": 20.0, "ssim": 0.5, "lpips": None, "masked": False, "views": {"a": {"psnr": 20.0, "ssim": 0.5}}}
    clock = {"step": 3, "wall": 1.0, "cpu": 2.0, "threads": 2}
    metrics = {"step": 3, "gaussians": 5, "train": scores, "test": scores, "seconds": clock}
    files = {"metrics": metrics, "seconds": clock, "compare": {"runs": {"a": "probe"}}}
    for name, content in files.items():
        (root / f"{name}.json").write_text(json.dumps(content))


def _use_numbers_of_a_run(root: Path, chance: Random) -> Read:
    from analysis.records.run_files import read_comparison, read_scores
    from analysis.train.progress import TrainingTime

    for read in (read_scores, read_comparison, TrainingTime.read):
        read(root)
    return None


def _use_trajectory(root: Path, chance: Random) -> Read:
    from analysis.runs.trajectories import first_and_last, gathered
    from analysis.train.trajectory import _read_rows

    table = gathered([root])
    first_and_last(table)
    _read_rows(root / "trajectory.csv", 10**6)
    if chance.random() < DRAWN:
        import matplotlib.pyplot as plt

        from figures.trajectory import draw

        plt.close(draw(table))
    return None


def _write_trajectory(root: Path) -> None:
    from tests.figures.test_trajectory_figure import rows

    rows().to_csv(root / "trajectory.csv", index=False)


def _write_sweep(root: Path) -> None:
    (root / "sweep.toml").write_text(
        'out = "runs"\nseeds = [0, 1]\niterations = 30\nviews = 3\n[probe]\nend_products = 45\n'
        '[scenes.fern]\npath = "fern"\nviews = 3\n[methods.3dgs]\n[methods."asp only"]\nmethod = "stablegs"\n'
        'set = { vsp_weight = 0, probe.attributes = ["means"] }\n'
    )


def _use_sweep(root: Path, chance: Random) -> Read:
    from analysis.runs.sweep.sweep_file import arguments, read_sweep

    for cell in read_sweep(root / "sweep.toml").cells:
        arguments("train", cell.training)
    return None


# Notebooks


def _write_study(root: Path) -> None:
    from tests.notebooks.test_claims import PAPER, made_up

    made_up(PAPER).to_csv(root / "study.csv", index=False)


def _use_study(root: Path, chance: Random) -> Read:
    from notebooks.paper.__main__ import tell
    from notebooks.paper.figures import captions
    from notebooks.paper.predictors import predictors
    from notebooks.paper.statements import effect_table, judgements
    from notebooks.paper.study import study

    rows = study([root / "study.csv"])
    found = judgements(rows)
    effect_table(found).to_csv(index=False)
    with io.StringIO() as quiet:
        tell(rows, found, Console(file=quiet))
    if chance.random() < DRAWN:
        captions(rows, found, predictors(rows), ["predictors", "budget", "axes"])
    return None


def _write_next_views(root: Path) -> None:
    text = 'out = "out"\nrules = ["d"]\nseeds = [0]\n[scenes."fern 2"]\npath = "fern"\n'
    row = {"scene": "fern", "rule": "d", "seed": 0, "round": 0, "views": 2, "added": "", "psnr": 9.0, "ssim": 0.5}
    (root / "study.toml").write_text(text)
    (root / "cell.json").write_text(json.dumps({"told": "this", "rows": [row]}))


def _use_next_views(root: Path, chance: Random) -> Read:
    from notebooks.uses.study import _kept, read_study

    study = read_study(root / "study.toml")
    assert all((root / name).parent == root for name in study.scenes), "a name that leads out"
    _kept(root / "cell.json", "this")
    return None


# What an interrupted command goes on from


def _use_stages(root: Path, chance: Random) -> Read:
    """Damaged ones are measured again."""
    from analysis.console.kept import Kept
    from analysis.console.stages import Stages
    from landscape import DenseOperator, EigenEnds, extreme_eigenpairs

    operator = DenseOperator(torch.diag(torch.linspace(-2, 7, 12, dtype=torch.float64)))
    kept = Kept(Stages(), torch.Generator().manual_seed(0), ["ends", "more ends"], lambda: 1, root, "this")
    found = [
        kept.run(name, EigenEnds, lambda generator, report, notes: extreme_eigenpairs(operator, generator))
        for name in ("ends", "more ends")
    ]
    return [pairs.vectors for ends in found if ends for pairs in (ends.largest, ends.smallest)]


def _use_points(root: Path, chance: Random) -> Read:
    """Renders of a slice."""
    from landscape.slices.grid_evaluations import GridEvaluations
    from splat.model.untrusted import KeptArrays

    points = torch.cartesian_prod(*[torch.linspace(-1, 1, 5, dtype=torch.float64)] * 2)
    center, directions = torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[:, :2]
    store = KeptArrays(root / "points.npz")
    found = GridEvaluations(lambda theta: (theta**2).sum(), center, directions, points, store=store)
    found.require(range(len(points)))
    assert found.known.all() and found.value.dtype == np.float64, "points without a value"
    return [found.value]


PROBE, ARRAYS = "probe/probe.json", "probe/*.npz"
RECORDS = {
    "checkpoint.pt": Reader(_write_checkpoint, _use_checkpoint, "checkpoint.pt", "checkpoint.pt"),
    "probe.json": Reader(_write_probes, _use_probes, PROBE),
    "probe's *.npz": Reader(_write_probes, _use_probes, ARRAYS, ARRAYS),
    "fingerprint": Reader(_write_probes, _use_probes, PROBE, part=("provenance", "fingerprint")),
    "origin": Reader(_write_origin, _use_origin, PROBE, part=("provenance", "origin")),
    "slice.json, slice.npz": Reader(lambda root: written(root / "slice", *synthetic_line()), _use_slice, "slice/*"),
    "map.json, map/*.npz, *.png": Reader(_write_map, _use_map, "map/*", refuses=False),
    "metrics.json, seconds.json, compare.json": Reader(_write_numbers_of_a_run, _use_numbers_of_a_run, "*.json"),
    "trajectory.csv": Reader(_write_trajectory, _use_trajectory, "trajectory.csv"),
    "sweep.toml": Reader(_write_sweep, _use_sweep, "sweep.toml"),
    "study.csv": Reader(_write_study, _use_study, "study.csv"),
    "study.toml, cells/*.json": Reader(_write_next_views, _use_next_views, "study.toml cell.json"),
    "STAGE.msgpack": Reader(
        lambda root: _use_stages(root, Random(0)), _use_stages, "*.msgpack", "*.msgpack", refuses=False
    ),
    "evaluations of a slice": Reader(
        lambda root: _use_points(root, Random(0)), _use_points, "points.npz", "points.npz", refuses=False
    ),
}
