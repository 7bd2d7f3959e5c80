"""`landscape prune`: a scene with fewer Gaussians, and how good each score for choosing them is.

    checkpoint.pt, pruned.ply   the Gaussians that are kept
    scores.csv          every score (`splat.curvature.scores.removal`) of the Gaussians in sight, and `error`, the true rise of
                        the loss, where one was removed alone
    correlations.csv    rank correlations (Spearman) of the scores with that truth and with each other
    curve.csv           with --curve: PSNR and SSIM by score, share removed, and steps of training after it and
                        their seed; curve.png
    prune.json          where it comes from

Gaussians that no training view sees go first.  What --curve has measured is kept until it is done: the same command continues.
"""

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float64, Int64
from rich.console import Console
from torch import Tensor

from analysis.bench.tables import rich_table
from analysis.commands.convert import own_file
from analysis.commands.options import PruneOptions
from analysis.console.drawing import draw
from analysis.console.kept import Kept
from analysis.console.options import require_known
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.records.json_files import json_text, plain
from analysis.records.provenance import provenance_of
from analysis.records.quantities import quantity
from analysis.records.records import record_folder, require_replaceable
from landscape.errors import InputError
from landscape.results import Progress, t_quantile
from splat.curvature.objective import SceneObjective
from splat.curvature.scores.removal import EXACT, SCORES, removal_errors, removal_scores
from splat.losses.reference import LossSettings
from splat.model.files.splat_ply import splat_ply
from splat.model.gaussians import Gaussians
from splat.scenes.view import View
from splat.training.checkpoint import open_subject, save_checkpoint
from splat.training.loop import train
from splat.training.origin.subject import Checkpoint
from splat.training.score.evaluate import evaluate
from splat.training.state import ThreeDGS, Training

RECORD = "prune.json"  # the file by which a folder of results is known

L2 = LossSettings("l2", ssim_weight=0)
REMOVED = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
REFINED = (0.5, 0.9)
TRUTH = "error"
STEPS, SEEDS = 300, 3  # of training after the removal, for the curve, and of it
CHOICE = ("keep", "score")  # about the pruned scene; the curve does not depend on them
STAGES = ("true removals", *SCORES, *(f"{name} refined" for name in SCORES))
Row = dict[str, str | int | float]


def run_prune(options: PruneOptions, command: Sequence[str]) -> int:
    """Prune the checkpoint; returns the exit code.  command: as typed, for the record."""
    _require_sensible(options)
    out = options.out or options.checkpoint.parent / "prune"
    console, unfinished = Console(stderr=True), out.with_name(f".{out.name}.unfinished")
    require_replaceable(out, RECORD)
    stages = Stages(console)
    with stages.stage("load"):
        subject = open_subject(options.checkpoint, options.foreign, out)
        checkpoint, scene = subject.checkpoint, subject.scene
        objective, l2 = (subject.objective(loss=loss) for loss in (None, L2))
        held_out = scene.load(checkpoint.scene.test) if checkpoint.scene.test else []
    amounts = {name: getattr(options, name) for name in ("curve", "sample", *CHOICE)}
    tested = {name: checkpoint.scene.views[name] for name in checkpoint.scene.test}
    made = checkpoint.fingerprint(amounts, options.seed, further=tested)
    identity = made.but(*(f"settings.{name}" for name in CHOICE)).digest
    with record_folder(out, RECORD) as folder, stages:
        kept = Kept(stages, torch.Generator().manual_seed(options.seed), STAGES, folder=unfinished, identity=identity)
        with stages.stage("scores"):
            scores = removal_scores(objective, l2)
        ranks = _write_scores(folder, objective, scores, _truth(kept, objective, options))
        curve = None
        if options.curve:
            curve = _curve(kept, checkpoint, objective, held_out, scores, options)
            curve.to_csv(folder / "curve.csv", index=False)
        with stages.stage("pruned"):
            training = pruned(checkpoint.training, objective, scores[options.score], options.keep)
            scene_from_there = replace(checkpoint.scene, relative=os.path.relpath(scene.root, out.resolve()))
            _write_pruned(folder, replace(checkpoint, training=training, scene=scene_from_there))
        origin = provenance_of(made, subject, command)
        (folder / RECORD).write_text(json_text(plain(origin)), encoding="utf-8")
        notes = draw("uses", folder) if curve is not None else []
        result = _scored(training.gaussians, objective, held_out)
    shutil.rmtree(unfinished, ignore_errors=True)
    _conclude(ranks, curve, training.gaussians, result, out)
    say(*notes, *checkpoint.assumptions, style="yellow", console=console)
    return 0


def _require_sensible(options: PruneOptions) -> None:
    if not 0 < options.keep <= 1:
        hint = f"; for {options.keep:g}% say --keep {options.keep / 100:g}" if 1 < options.keep <= 100 else ""
        raise InputError(f"expected --keep as a share above 0 and up to 1, got {options.keep:g}{hint}")
    if options.sample < 3:
        raise InputError(f"expected --sample of at least 3, got {options.sample}")
    require_known("score", options.score, SCORES)


def pruned(training: Training, objective: SceneObjective, score: Float64[Tensor, " n"], keep: float) -> Training:
    """The training with the Gaussians of the highest scores alone, at least one; nothing is left of Adam's moments.

    score: of the objective's active Gaussians; the others go first.
    """
    everyone = torch.full((len(objective.mask),), -torch.inf, dtype=torch.float64)
    everyone[objective.mask] = score
    count = max(round(keep * len(everyone)), 1)
    chosen = everyone.argsort(descending=True, stable=True)[:count].sort().values
    gaussians, config = training.gaussians.select(chosen), training.config
    config = replace(config, method=ThreeDGS(), densify=replace(config.densify, enabled=False))
    fresh = Training.start(gaussians, training.extent, config)
    fresh.step = training.step
    return fresh


def refine(training: Training, views: Sequence[View], steps: int, seed: int) -> None:
    """Train on, at the rates that the training ended with and without density control."""
    config = training.config
    rates = replace(config.rates, position=config.rates.position_final)
    training.config = replace(config, iterations=training.step + steps, rates=rates)
    training.generator = torch.Generator().manual_seed(seed)
    for _ in train(training, views):
        pass


def _truth(kept: Kept, objective: SceneObjective, options: PruneOptions) -> Float64[Tensor, " n"]:
    """The true rise of the loss by removing each Gaussian in sight; nan outside the sample."""
    n = len(objective.active)
    generator = torch.Generator().manual_seed(options.seed)
    chosen: Int64[Tensor, " m"] = torch.randperm(n, generator=generator)[: options.sample].sort().values
    found = kept.run(STAGES[0], Tensor, lambda _g, report, _n: removal_errors(objective, chosen, report))
    errors = torch.full((n,), torch.nan, dtype=torch.float64)
    errors[chosen] = found
    return errors


def _write_scores(
    folder: Path, objective: SceneObjective, scores: dict[str, Float64[Tensor, " n"]], errors: Float64[Tensor, " n"]
) -> pd.DataFrame:
    """Write the scores and the truth beside them, and return their rank correlations, written too."""
    table = pd.DataFrame({name: score.numpy() for name, score in scores.items()})
    table.insert(0, "gaussian", objective.mask.nonzero()[:, 0].numpy())
    table[TRUTH] = errors.numpy()
    table.to_csv(folder / "scores.csv", index=False)
    ranks = table.filter([TRUTH, *SCORES]).corr(method="spearman")
    ranks.to_csv(folder / "correlations.csv")
    return ranks


def _write_pruned(folder: Path, checkpoint: Checkpoint) -> None:
    """Write the checkpoint, and its Gaussians as PLY."""
    save_checkpoint(folder / "checkpoint.pt", checkpoint.training, checkpoint.scene)
    file, _ = own_file(checkpoint)
    said = {"antialiased": file.antialiased, "train": file.train, "width": file.width}
    (folder / "pruned.ply").write_bytes(splat_ply(file.gaussians, tool=file.tool, **said))


def _curve(
    kept: Kept,
    checkpoint: Checkpoint,
    objective: SceneObjective,
    held_out: Sequence[View],
    scores: dict[str, Float64[Tensor, " n"]],
    options: PruneOptions,
) -> pd.DataFrame:
    """The scene's measures by score, share removed, and steps of training after it, for each of its seeds."""

    def points(
        name: str, steps: int, at: Sequence[tuple[float, int]], _: torch.Generator, report: Progress, __: list[str]
    ) -> list[Row]:
        rows = []
        for done, (removed, seed) in enumerate(at):
            training = pruned(checkpoint.training, objective, scores[name], 1 - removed)
            if steps:
                refine(training, objective.views, steps, seed)
            found = _scored(training.gaussians, objective, held_out)
            rows.append({"score": name, "removed": removed, "steps": steps, "seed": seed, **found})
            report(done + 1, len(at), name)
        return rows

    rows, first = list[Row](), options.seed
    plain = [(removed, first) for removed in REMOVED]
    refined = [(removed, seed) for removed in REFINED for seed in range(first, first + SEEDS)]
    for name in SCORES:
        rows += kept.run(name, list[Row], partial(points, name, 0, plain))
        rows += kept.run(f"{name} refined", list[Row], partial(points, name, STEPS, refined))
    return pd.DataFrame(rows)


def _scored(gaussians: Gaussians, objective: SceneObjective, held_out: Sequence[View]) -> dict[str, float]:
    """Mean PSNR and SSIM on the training views and, where there are any, on those held out."""
    found = {}
    for name, views in (("train", objective.views), ("test", held_out)):
        if views:
            scores = evaluate(gaussians, views, objective.background, objective.settings)
            found |= {f"{name}_psnr": scores.psnr, f"{name}_ssim": scores.ssim}
    return found


def lost(curve: pd.DataFrame, removed: float, steps: int, column: str) -> pd.DataFrame:
    """Loss of a measure by each score, against the scene with all its Gaussians; a row for each seed of the steps."""
    at = curve[(curve["removed"] == removed) & (curve["steps"] == steps)]
    whole = curve.loc[curve["removed"] == 0].groupby("score")[column].first()
    return whole - at.pivot_table(column, "seed", "score")


def verdict(losses: pd.DataFrame) -> str:
    """What the losses by seed say of the best score of exact curvature and of the best other, by Student's interval of 95%.

    >>> seeds = pd.DataFrame({name: [1.0, 1.0] for name in SCORES} | {"removal_error": [0.2, 0.3], "opacity": [0.6, 0.8]})
    >>> verdict(seeds), verdict(seeds[:1])
    ('removal_error and opacity: undecided over 2 seeds', 'removal_error loses 0.400 dB less than opacity')
    >>> verdict(seeds.assign(opacity=[0.25, 0.351])).split()[1:6]
    ['loses', '0.0505', '±', '0.0064', 'dB']
    """
    by = {name: losses[name].to_numpy(float) for name in SCORES}
    best, other = (
        min(names, key=lambda name: float(by[name].mean())) for names in (EXACT, [x for x in SCORES if x not in EXACT])
    )
    n, (gain, deviation) = len(losses), _over_seeds(by[other] - by[best])
    error = t_quantile(n - 1, 0.95) * deviation / n**0.5 if deviation is not None else 0.0
    if abs(gain) <= error:
        return f"{best} and {other}: undecided over {n} seeds"
    return f"{best} loses {quantity(abs(gain), error)} dB {'less' if gain > 0 else 'more'} than {other}"


def _over_seeds(values: Float64[np.ndarray, " n"]) -> tuple[float, float | None]:
    """Mean and standard deviation; None of a single one."""
    return float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else None


def _conclude(
    ranks: pd.DataFrame, curve: pd.DataFrame | None, gaussians: Gaussians, result: dict[str, float], out: Path
) -> None:
    columns = [] if curve is None else [(removed, steps) for removed in REFINED for steps in sorted({*curve.steps})]
    measure = "test_psnr" if "test_psnr" in result else "train_psnr"
    say("rank: Spearman's correlation with the true rise of the loss")
    if columns:
        say(
            f"further columns: {measure.split('_')[0]} PSNR lost at that share removed, dB; ±: the standard deviation over "
            "seeds of the steps after it.  All of one training"
        )
    table = pd.DataFrame({"score": SCORES, "rank": ranks.loc[TRUTH, [*SCORES]].to_numpy(float)})
    losses = [lost(curve, *at, measure) for at in columns] if curve is not None else []
    for (removed, steps), loss in zip(columns, losses, strict=True):
        cells = [quantity(*_over_seeds(loss[name].to_numpy(float))) for name in SCORES]
        table[f"{removed:.0%}{f', {steps} steps' if steps else ''}"] = cells
    Console().print(rich_table(table, ""))
    for (removed, steps), loss in zip(columns, losses, strict=True):
        say(f"{removed:.0%} removed, {steps} steps after: {verdict(loss)}")
    scored = ", ".join(
        f"{name.replace('_', ' ')} {quantity(value)}" for name, value in result.items() if np.isfinite(value)
    )
    say(f"kept {len(gaussians):,} Gaussians: {scored}")
    say(f"checkpoint.pt, pruned.ply, scores.csv, correlations.csv{', curve.png' if columns else ''} in {out}")
