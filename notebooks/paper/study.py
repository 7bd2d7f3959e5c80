"""The runs of a study as a table, OUT/study.csv of `python -m notebooks.paper`: a row for each run.

    scene, method, seed         method: its name and the settings that differ from its defaults, as in "stablegs vsp_weight=0"
    steps, views, size          of the training: steps, number of training views, and their sizes in pixels
    date, machine, commit       of the scores
    psnr, ssim, ...             as in a sweep's results.csv (`analysis.runs.sweep.sweep_results`): scores, Gaussians, seconds,
                                threads, traces, ends of the spectrum and indices, those of the probe where the run has one
    lambda_second               the second largest eigenvalue
    depth_gradient              the root mean square gradient of the positions along the rays, over that across them; where
                                `landscape map` has been run, or a probe without --quick
    needles_quats, needles_log_scales   share of the attribute's curvature, sum over Gaussians of |trace|, on Gaussians with
                                kappa above 100; where `landscape map` has been run
    needles, needle_count       share of the steepest eigenvector's squared mass on Gaussians with kappa above 100, and share of
                                the visible Gaussians that these are
    one_gaussian                share of the steepest eigenvector's squared mass on a single Gaussian
    INDEX_scene, INDEX_optimiser   the indices in units of the scene's size or of the optimiser's steps, where the families were
                                measured in these
    finite_curvature            second difference along the steepest eigenvector, at a step as long as Adam's first with random
                                signs has along it
    opacity_one_view            rank correlation of a Gaussian's curvature in opacity with the share of its weight that one view
                                sees; where `landscape map` has been run
    hutchinson_ATTRIBUTE, hutchinson_ATTRIBUTE_most   the least and the largest relative standard error that ten Gaussian
                                samples of the block's trace can have (`_hutchinson`); where families were measured

A number that a run does not have is empty.
"""

from collections.abc import Sequence
from dataclasses import asdict
from math import nan, sqrt
from pathlib import Path
from typing import Any

import pandas as pd
from msgspec import structs

from analysis.console.overrides import overridden
from analysis.records.provenance import require_own
from analysis.records.records import ProbeRecord, read_record
from analysis.records.run_files import CHECKPOINT, METRICS, MapRecord, read_map, read_scores
from analysis.runs.sweep.sweep_results import PROBE, metrics_of, probe_of
from landscape.errors import InputError
from notebooks.paper.effects import STRETCHED
from notebooks.paper.table import FILE, KEYS, read_table
from splat.model.typed import leaves
from splat.training.checkpoint import load_checkpoint
from splat.training.methods.methods import presets
from splat.training.start import Source
from splat.training.state import TrainConfig

SAMPLES = 10  # the paper's B


def study(paths: Sequence[Path]) -> pd.DataFrame:
    """The rows of all paths: folders with runs at any depth, and tables FILE.

    Raises InputError where a path has no run, or a run is there twice on one machine.
    """
    tables = [read_table(path) if path.is_file() else pd.DataFrame(map(row_of, _runs(path))) for path in paths]
    rows = pd.concat(tables, ignore_index=True)
    if (again := rows.duplicated([*KEYS, *rows.columns.intersection(["machine"])])).any():
        twice = rows[again].iloc[0]
        raise InputError(
            f"expected every run once, got {twice['method']} with seed {twice['seed']} of {twice['scene']} twice"
        )
    return rows


def _runs(path: Path) -> list[Path]:
    """Runs with scores.  Raises InputError where there is none."""
    found = [run for run in _trained(path) if (run / METRICS).is_file()]
    if not found:
        raise InputError(
            f"expected a run that has ended, a folder of such or the table {FILE} of a study, got {path} with none"
        )
    return found


def unended(paths: Sequence[Path]) -> list[Path]:
    """Runs without scores, which have no row.  Not listed: the further checkpoints within a run's folder."""
    found = [run for path in paths if path.is_dir() for run in _trained(path) if not (run / METRICS).is_file()]
    return [run for run in found if not any((parent / CHECKPOINT).is_file() for parent in run.parents)]


def _trained(path: Path) -> list[Path]:
    return sorted(checkpoint.parent for checkpoint in path.rglob(CHECKPOINT))


def row_of(run: Path) -> dict[str, Any]:
    """The row of one run.  InputError where one of its records is of another checkpoint."""
    checkpoint = load_checkpoint(run / CHECKPOINT)
    config, step, state = checkpoint.training.config, checkpoint.training.step, checkpoint.state
    row = {
        "scene": Path(checkpoint.scene.absolute).name,
        "method": method_name(config, checkpoint.scene.start),
        "seed": config.seed,
        "steps": step,
        "views": len(checkpoint.scene.train),
        "size": ", ".join(sorted({f"{width} x {height}" for width, height in checkpoint.scene.sizes})),
    }
    made = read_scores(run).provenance
    require_own(
        made and made.fingerprint,
        state,
        run / METRICS,
        "repeat the training's command with --resume, which scores again",
    )
    assert made
    row |= metrics_of(run) | {"date": made.created[:10], "machine": made.machine.cpu}
    row |= {"commit": made.commit or ""} | _of_map(run, state)
    if not (run / PROBE / ProbeRecord.FILE).is_file():
        return row
    data = read_record(run / PROBE, ProbeRecord).data
    require_own(data.provenance.fingerprint, state, run / PROBE / ProbeRecord.FILE, "probe again")
    return row | probe_of(run) | _more(data)


def _of_map(run: Path, state: str) -> dict[str, float]:
    path = run / MapRecord.COMMAND / MapRecord.FILE
    if not path.is_file():
        return {}
    data = read_map(path.parent)
    require_own(data.provenance.fingerprint, state, path, "map again")
    found = data.fragility
    row = {f"needles_{name}": found.needles_trace.get(name, nan) for name in STRETCHED}
    row |= {"needle_count": found.needles, "depth_gradient": _number(found.depth_gradient)}
    return row | {"opacity_one_view": _number(found.opacity_one_view)}


PAPERS = {"stablegs": {"viewpoints": "all"}}  # what a paper's text says where the default is another


def method_name(config: TrainConfig, start: Source = "scene") -> str:
    """The method, its start and protocol where they are not the default, and its settings that differ from their defaults.

    Defaults are those scaled to the length of the training, but for PAPERS; the setting `depths`, of input files, is not
    compared.

    >>> from splat.training.methods.stablegs.stablegs import StableGS
    >>> method_name(TrainConfig(500, method=StableGS(vsp_weight=0.0, warm_up=50, viewpoints="all")))
    'stablegs vsp_weight=0'
    >>> method_name(TrainConfig(), "dense")
    '3dgs start=dense'
    """
    name, preset = config.method.name, presets(config.method.name, config.protocol)
    usual = TrainConfig(iterations=config.iterations, method=type(config.method)())
    usual = overridden(usual, {key: value for key, value in preset.items() if key != "start"})
    published = leaves(asdict(usual.method.scaled(usual).method)) | PAPERS.get(name, {})
    settings = leaves(asdict(config.method))
    changed = [
        f"{key}={_text(value)}" for key, value in settings.items() if value != published[key] and key != "depths"
    ]
    started = [f"start={start}"] if start != preset.get("start", "scene") else []
    protocol = [f"protocol={config.protocol}"] if preset else []
    return " ".join([name, *started, *protocol, *changed])


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ",".join(map(_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _more(data: ProbeRecord) -> dict[str, float]:
    """Columns for statements and predictors in addition to those of a sweep."""
    second, lives = data.eigenvalues.second, data.eigenvalues.max.lives_on
    row = {"lambda_second": _number(second and second.value)}
    if (renders := data.eigenvalues.max.renders) and (ratio := renders.at_step) is not None:
        row["finite_curvature"] = ratio * _number(data.eigenvalues.max.value)
    if carrier := data.eigenvalues.max.carrier:
        row["one_gaussian"] = carrier.share
    if data.depth:
        row["depth_gradient"] = _number(data.depth.gradient_ratio)
    if lives:
        row |= {"needles": lives.needles, "needle_count": lives.needle_count / max(data.counts.visible_gaussians, 1)}
    for family in data.per_attribute or ():
        if (family.operator, family.block, family.split) == ("hessian", "all", False) and family.metric != "parameters":
            indices = {name: index for name, index in structs.asdict(family.indices).items() if index}
            row |= {f"{name}_{family.metric}": _number(index.value) for name, index in indices.items()}
    return row | _hutchinson(data)


def _hutchinson(data: ProbeRecord) -> dict[str, float]:
    """Lower and upper bound of the relative standard error of the mean of B samples v . H v with Gaussian v, by block.

    Its square is 2 |H|_F^2 / (B tr^2) = (2 / (B r)) (S / tr)^2 with S = sum |lambda| >= |tr| and r = S^2 / sum lambda^2.
    """
    found = {}
    for row in data.per_attribute or ():
        rank, share, trace = row.indices.participation_ratio, row.indices.top_mass, data.traces.get(row.block)
        if row.operator != "hessian" or row.split or row.metric != "parameters" or not (rank and share and trace):
            continue
        if rank.high:
            found[f"hutchinson_{row.block}"] = sqrt(2 / (SAMPLES * rank.high))
        top, residual, error = (
            _number(x) for x in (row.lambda_max.value, row.lambda_max.residual, trace.standard_error)
        )
        least = abs(_number(trace.value)) - 2 * error
        if rank.low and share.low and least > 0:
            absolute_sum = (top + residual) / share.low
            found[f"hutchinson_{row.block}_most"] = sqrt(2 / (SAMPLES * rank.low)) * absolute_sum / least
    return found


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else nan
