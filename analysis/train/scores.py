"""Scores of a finished training: metrics, renders and panels of the held-out views, and the table of the terminal.

RUN/metrics.json            as in `analysis/train/command.py`
RUN/test/NAME.png           the held-out views as rendered at the end
RUN/test/panels/NAME.png    side by side: photograph, render, and the error, which is the mean over the colours of
                            |render - photograph|: black is 0, the brightest ERROR_SHOWN or more; 0 outside a mask
"""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from msgspec import structs
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from analysis.console.plain import say
from analysis.records.json_files import json_text, plain
from analysis.records.provenance import provenance
from analysis.records.quantities import PLACES, SCORES
from analysis.records.run_files import CHECKPOINT, METRICS
from analysis.train.progress import TrainingTime
from splat.model.untrusted import short, write_atomically
from splat.scenes.images import IMAGE_SUFFIXES
from splat.scenes.view import View
from splat.scenes.write import bytes_of, png
from splat.training.origin.fingerprint import Fingerprint
from splat.training.score.evaluate import Evaluation, MissingPerceptual, ViewScore, evaluate, load_lpips
from splat.training.state import Training

RENDERS, PANELS = "test", "panels"
ERROR_SHOWN = 0.25  # of the range of a colour
GAP = 4  # white pixels between the pictures of a panel


def report(training: Training, views: Sequence[View], held_out: Sequence[View], out: Path, made: Fingerprint) -> None:
    """Score the views, write renders, panels and metrics, print the table.  made: what the scores are about."""
    config = training.config
    background = config.background_colour(training.gaussians.flat.dtype)
    renders, photographs = out / RENDERS, {view.name: view for view in held_out}

    def keep(name: str, image: Tensor) -> None:
        file = render_name(name)
        write_atomically(renders / file, png(bytes_of(image)))
        write_atomically(renders / PANELS / file, png(panel(image, photographs[name])))

    console = Console()
    try:
        lpips = load_lpips()
    except MissingPerceptual as error:
        lpips = None
        if not isinstance(error.__cause__, ModuleNotFoundError):  # installed, and yet it does not run
            say(str(error), console=console)
    seen = evaluate(training.gaussians, views, background, config.render, lpips=lpips)
    tested = None
    if held_out:
        (renders / PANELS).mkdir(parents=True, exist_ok=True)
        tested = evaluate(training.gaussians, held_out, background, config.render, lpips=lpips, on_image=keep)
    metrics = {
        "step": training.step,
        "method": config.method.name,
        "protocol": config.protocol,
        "gaussians": len(training.gaussians),
        "train": _scores(seen),
        "test": _scores(tested) if tested else None,
        "seconds": structs.asdict(TrainingTime.read(out)),
        "provenance": plain(provenance(config.seed, checkpoint=str(out / CHECKPOINT), fingerprint=made)),
    }
    write_atomically(out / METRICS, json_text(metrics).encode())
    console.print(_table(seen, tested))
    rendered = (
        f"renders of the held-out views: {renders}, beside photograph and error: {renders / PANELS}; "
        if tested
        else "no view was held out, so nothing was tested; "
    )
    next_step = f"next: landscape probe {shlex.quote(str(out))}"
    say(f"{rendered}scores: {out / METRICS}", next_step, console=console)


def render_name(view: str) -> str:
    """File name of a view's render: `train/r_3` becomes `train_r_3.png`, `IMG_1.JPG` becomes `IMG_1.png`; of a long name
    its digest."""
    flat = Path(view.replace("/", "_"))
    return f"{short(flat.stem if flat.suffix.lower() in IMAGE_SUFFIXES else flat.name)}.png"


def panel(image: Float[Tensor, "3 h w"], view: View) -> UInt8[np.ndarray, "h w3 3"]:
    """Photograph, render and error side by side."""
    from matplotlib import colormaps  # half a second of imports

    render = image.clamp(0, 1).to(view.image.device)
    error = (render - view.image).abs().mean(dim=0)
    if view.mask is not None:
        error = torch.where(view.mask, error, 0.0)
    shown = colormaps["inferno"]((error / ERROR_SHOWN).clamp(0, 1).cpu().numpy(), bytes=True)[..., :3]
    gap = np.full((shown.shape[0], GAP, 3), 255, np.uint8)
    return np.concatenate([bytes_of(view.image), gap, bytes_of(render), gap, shown], axis=1)


def _scores(evaluation: Evaluation) -> dict[str, Any]:
    def of(scores: ViewScore | Evaluation) -> dict[str, Any]:
        return {key: getattr(scores, key) for key in SCORES}

    return {**of(evaluation), "masked": evaluation.masked, "views": {view.name: of(view) for view in evaluation.views}}


def _table(seen: Evaluation, tested: Evaluation | None) -> Table:
    shown = tested or seen
    title = "held-out views" if tested else "training views"
    table = Table("view", title=f"{title}, inside their masks" if shown.masked else title)
    columns = [key for key in SCORES if getattr(shown, key) is not None]
    for key in columns:
        table.add_column(SCORES[key], justify="right")

    def row(name: str, scores: ViewScore | Evaluation, style: str | None = None) -> None:
        cells = ["" if (value := getattr(scores, key)) is None else f"{value:.{PLACES[key]}f}" for key in columns]
        table.add_row(escape(name), *cells, style=style)

    if tested:
        for view in tested.views:
            row(view.name, view)
        table.add_section()
        row("mean", tested, "bold")
    row("mean of the training views" + (", whole" if shown.masked and not seen.masked else ""), seen)
    return table
