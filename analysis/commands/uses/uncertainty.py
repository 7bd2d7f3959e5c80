"""`landscape uncertainty`: variances of held-out views' pixels (`splat.curvature.scores.information`) beside their true errors.

    agreement.csv       by view and by precision (the blocks of the Gaussians, or their diagonal alone): Spearman's rank
                        correlation of variance and |error| over the pixels, and AUSE
    view-NNN.npz, .png  photograph, |error|, and the standard deviations by both
    uncertainty.json    where it comes from

A sparsification curve is the mean |error| of the pixels that are left when a share of them is taken away, over the mean of all.
AUSE is the area between the curve that takes the largest variances first and the one that takes the largest errors first; 0 at
best.  `ause_random`: the same for pixels taken at random.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from rich.console import Console

from analysis.commands.options import UncertaintyOptions
from analysis.console.drawing import draw
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.records.json_files import json_text, plain
from analysis.records.provenance import provenance_of
from analysis.records.quantities import quantity
from analysis.records.records import record_folder, require_replaceable
from landscape.errors import InputError
from splat.curvature.linearize import LinearizedView
from splat.curvature.scores.information import Information, informations, pixel_variance, prior_of
from splat.losses.reference import LossSettings
from splat.render.backend import CPU
from splat.scenes.view import View
from splat.training.checkpoint import open_subject

RECORD = "uncertainty.json"  # the file by which a folder of results is known

L2 = LossSettings("l2", ssim_weight=0)
PRECISIONS = {"block": False, "diagonal": True}
SHARES = 100  # of the pixels that are taken away


def run_uncertainty(options: UncertaintyOptions, command: Sequence[str]) -> int:
    """Measure and draw; returns the exit code.  command: as typed, for the record."""
    if options.samples < 2:
        raise InputError(f"expected --samples of at least 2, got {options.samples}")
    out = options.out or options.checkpoint.parent / "uncertainty"
    require_replaceable(out, RECORD)
    stages, generator, rows = Stages(Console(stderr=True)), torch.Generator().manual_seed(options.seed), []
    with stages.stage("load"):
        subject = open_subject(options.checkpoint, options.foreign, out)
        checkpoint, scene = subject.checkpoint, subject.scene
        if not checkpoint.scene.test:
            raise InputError("expected a scene with held-out views, whose errors are the truth, got none")
        held_out, training = scene.load(checkpoint.scene.test), checkpoint.training
        gaussians, config = training.gaussians.aligned_to(training.gaussians), training.config
        background = config.background_colour(gaussians.flat.dtype)
    with record_folder(out, RECORD) as folder, stages:
        with stages.stage("information") as report:
            cameras = {frame.name: frame.camera for frame in scene.select(checkpoint.scene.train)}
            seen = [*informations(gaussians, cameras, background, config.render, report).values()]
            total = sum(seen[1:], seen[0])
            total = total + prior_of(total)
        with stages.stage("views") as report:
            for place, view in enumerate(held_out):
                loss = CPU.view_loss(view.image, L2, gaussians.flat)
                linearized = LinearizedView(gaussians, view.camera, loss, background, config.render)
                found, maps = _compared(linearized, view, total, generator, options.samples)
                rows += found
                np.savez(folder / f"view-{place:03d}.npz", **maps)
                report(place + 1, len(held_out), "held-out views")
        table = pd.DataFrame(rows)
        table.to_csv(folder / "agreement.csv", index=False)
        tested = {name: checkpoint.scene.views[name] for name in checkpoint.scene.test}
        of = checkpoint.fingerprint({"samples": options.samples}, options.seed, L2, tested)
        made = provenance_of(of, subject, command)
        (folder / RECORD).write_text(json_text(plain(made)), encoding="utf-8")
        notes = draw("uses", folder)
    means = table.drop(columns="view").pivot_table(index="precision")  # by default means
    words = (
        "ause: area under the sparsification error, 0 at best; ause_random: of an order that knows nothing",
        "a variance leaves out what couples the Gaussians (diagonal: also their parameters), and has no unit of the error",
        f"means over {len(held_out)} held-out views; agreement.csv, view-*.png in {out}",
    )
    say(means.to_string(float_format=quantity), *words, *notes, *checkpoint.assumptions)
    return 0


def _compared(
    linearized: LinearizedView, view: View, total: Information, generator: torch.Generator, samples: int
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of the table and maps of one held-out view.  total: B of `splat.curvature.scores.information`."""
    error = (linearized.image.clamp(0, 1) - view.image).abs().mean(dim=0).double().numpy()
    rows, maps = [], {"photograph": view.image.permute(1, 2, 0).numpy(), "error": error}
    for name, diagonal in PRECISIONS.items():
        variance = pixel_variance(linearized, total, generator, samples, diagonal=diagonal).numpy()
        rows.append({"view": view.name, "precision": name, **agreement(variance, error)})
        maps[name] = np.sqrt(variance)
    return rows, {name: each.astype(np.float32) for name, each in maps.items()}


def agreement(variance: Float[np.ndarray, "h w"], error: Float[np.ndarray, "h w"]) -> dict[str, float]:
    """Agreement of a map of predicted errors with one of true errors.

    >>> perfect = agreement(np.arange(1000.0).reshape(50, 20), np.arange(1000.0).reshape(50, 20))
    >>> {name: round(value, 2) for name, value in perfect.items()}
    {'rank_correlation': 1.0, 'ause': 0.0, 'ause_random': 0.5}
    """
    predicted, true = variance.ravel(), error.ravel()
    best = _left(true, true)
    return {
        "rank_correlation": float(pd.Series(predicted).corr(pd.Series(true), method="spearman")),
        "ause": float((_left(true, predicted) - best).mean()),
        "ause_random": float((1 - best).mean()),
    }


def _left(error: Float[np.ndarray, " p"], order: Float[np.ndarray, " p"]) -> Float[np.ndarray, " s"]:
    """The mean error when each share of the pixels is taken away, the largest in order first, over the mean of all."""
    ascending = error[np.argsort(order, kind="stable")]
    counts = np.ceil(len(error) * (1 - np.arange(SHARES) / SHARES)).astype(int)
    return np.cumsum(ascending)[counts - 1] / counts / max(error.mean(), np.finfo(float).tiny)
