"""`landscape train`: a run folder that appears at once, a progress bar, checkpoints, scores of the held-out views.

RUN/checkpoint.pt   the latest checkpoint, see `splat/training/checkpoint.py`; written at the start, every so many steps, on
                    Ctrl-C and at the end
RUN/seconds.json    how long that took, see `analysis/train/training_time.py`
RUN/history.csv     what the method noted along the way, a row each with its "step"; where there is any
RUN/trajectory.csv, RUN/start/checkpoint.pt     with --probe-every: the landscape along the way, see
`analysis/train/trajectory.py`
RUN/test/NAME.png   the held-out views as rendered at the end
RUN/metrics.json    {"step", "method", "protocol", "gaussians", "train": scores, "test": scores or null, "seconds",
                    "provenance"}, where scores are
                    {"psnr", "ssim", "lpips", "masked", "views": {NAME: {"psnr", "ssim", "lpips"}}}, psnr in dB;
                    "Infinity" for a perfect image; lpips null where it cannot be computed; masked: inside masks only
"""

import io
import math
import os
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from PIL import Image
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text
from torch import Tensor

from analysis.console.interruption import interruption
from analysis.console.overrides import assignments, overridden
from analysis.records.json_files import json_text, plain
from analysis.records.provenance import provenance
from analysis.records.run_files import CHECKPOINT, METRICS
from analysis.train.options import TrainOptions
from analysis.train.remarks import remarks
from analysis.train.source import from_checkpoint
from analysis.train.training_time import TrainingTime
from analysis.train.trajectory import START, Trajectory, TrajectorySettings
from landscape.errors import InputError
from splat.backend.device import device_named
from splat.losses.reference import LossSettings
from splat.model.typed import leaves, typed
from splat.model.untrusted import beside, locked
from splat.scenes.images import IMAGE_SUFFIXES
from splat.scenes.layers import require_depths
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split, split_scene, usual_views
from splat.scenes.view import View
from splat.training.checkpoint import load_checkpoint, save_checkpoint, write_atomically
from splat.training.densify import DensifySettings
from splat.training.loop import prepare, train
from splat.training.methods.methods import METHODS
from splat.training.methods.protocols import presets
from splat.training.origin.scene_reference import SceneReference
from splat.training.score.evaluate import Evaluation, ViewScore, evaluate, have_masks
from splat.training.score.perceptual import MissingPerceptual, load_lpips
from splat.training.start import Source, initial_gaussians
from splat.training.state import TrainConfig, Training

HISTORY, RENDERS = "history.csv", "test"
COLOURS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
OPTIONS = {  # settings of the training that have an option of their own
    "iterations": "iterations",
    "seed": "seed",
    "sh_degree": "sh_degree",
    "background": "background",
    "random_background": "background",
    "loss.pixel": "pixel_loss",
    "loss.ssim_weight": "ssim_weight",
    "densify.enabled": "densify",
}
AGAIN = "repeat its command with --resume, or choose another --out"
PLAIN: dict[str, Any] = {"soft_wrap": True, "highlight": False, "markup": False}  # paths and names may hold brackets
WARNING: dict[str, Any] = PLAIN | {"style": "yellow"}
SMOOTHING = 0.05  # the bar's loss is a running mean: a step sees one view, and views differ


def run_training(options: TrainOptions, command: Sequence[str]) -> int:
    """Train, or continue, a run; returns the exit code.  command: as typed, for the message on how to resume."""
    if options.checkpoint_every < 1:
        raise InputError(f"expected checkpoint_every of at least 1, got {options.checkpoint_every}")
    along = None if options.probe_every is None else TrajectorySettings(options.probe_every, options.probe_share)
    out = options.out or Path("runs") / options.scene.resolve().name
    _require_run(out, options.resume)
    plan, given = from_checkpoint(options, planned(options, out), out)
    scene, split, config, reference = plan
    device = device_named(options.device)
    views, held_out = scene.load(split.train), scene.load(split.test)
    for together in (views, held_out):
        have_masks(together)
    if options.depths:
        require_depths(views, options.depths)
    if options.resume:
        training = resumed(out / CHECKPOINT, config, reference)
    else:
        generator = torch.Generator().manual_seed(config.seed)
        start = given
        if start is None:
            start = initial_gaussians(scene, views, 0, generator=generator, source=reference.start)
        training = Training.start(start, scene.extent(split.train), config)
    training.move(device)
    prepare(training, views)  # refuses what cannot be trained before there is a folder
    if not out.parent.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
    with locked(beside(out), f"no other training in {out}"):
        if not options.resume:
            _require_run(out, resume=False)  # another may have been faster
            _create_run(out, training, reference, keep_start=along is not None)
        return _run(options, command, training, scene, views, held_out, reference, out, along)


def _run(
    options: TrainOptions,
    command: Sequence[str],
    training: Training,
    scene: Scene,
    views: list[View],
    held_out: list[View],
    reference: SceneReference,
    out: Path,
    along: TrajectorySettings | None,
) -> int:
    """Train to the end and score, in a folder that exists; as `run_training`."""
    config, console = training.config, Console(stderr=True)
    camera = views[0].camera
    console.print(
        f"{scene.name}: {len(views)} views to train on, {len(held_out)} held out, {camera.width} x {camera.height} px, "
        f"{len(training.gaussians)} Gaussians",
        markup=False,
    )
    begun = None if options.resume else (reference.start, len(training.gaussians))
    for remark in remarks(scene, _asked(options, scene), config, begun):
        console.print(remark, **WARNING)
    trajectory = None if along is None else Trajectory(out, training, views, along)
    if trajectory and (hopeless := trajectory.hopeless):
        console.print(hopeless, **WARNING)
    if code := _follow(training, views, out / CHECKPOINT, reference, options.checkpoint_every, trajectory, console):
        again = shlex.join([*command, *([] if options.resume else ["--resume"])])
        console.print(f"stopped after step {training.step}; to continue: {again}", **PLAIN)
        return code
    _report(training, views, held_out, out)
    if trajectory and (skipped := trajectory.skipped):
        console.print(skipped, **WARNING)
    return 0


def planned(options: TrainOptions, out: Path) -> tuple[Scene, Split, TrainConfig, SceneReference]:
    """What the options stand for, before any image is read.  ValueError or FileNotFoundError where they are wrong."""
    colour, preset = COLOURS.get(options.background or "scene"), presets(options.method, options.protocol)
    scene = load_scene(
        options.scene, options.images, options.downscale, colour, options.masks, options.depths,
        strict_frames=options.strict_frames,
    )  # fmt: skip
    views = usual_views(scene) if options.views is None else options.views
    split = split_scene(scene, None if views == "all" else views)
    start = typed(Source, options.start or preset.get("start", "scene"), "start")
    reference = SceneReference.to(
        scene, out / CHECKPOINT, split, options.images, options.downscale, start, options.depths
    )
    return scene, split, _config(options, scene), reference


def _config(options: TrainOptions, scene: Scene) -> TrainConfig:
    """The settings asked for, with the schedule of the method scaled to the length, but for what --set gives."""
    config = _asked(options, scene)
    return config.method.scaled(config, [key.removeprefix("method.") for key in assignments(options.set)])


def _asked(options: TrainOptions, scene: Scene) -> TrainConfig:
    red, green, blue = scene.background.tolist()
    if options.method not in METHODS:
        raise InputError(f"expected a method among {', '.join(METHODS)}, got {options.method!r}")
    config = TrainConfig(
        iterations=TrainConfig.iterations if options.iterations is None else options.iterations,
        seed=options.seed,
        sh_degree=options.sh_degree,
        background=(red, green, blue),
        random_background=options.background == "random",
        loss=LossSettings(pixel=options.pixel_loss, ssim_weight=options.ssim_weight),
        densify=DensifySettings(enabled=options.densify),
        method=METHODS[options.method](),
        protocol=options.protocol,
    )
    changes = assignments(options.set)
    for key, name in OPTIONS.items():
        given = getattr(options, name)
        if key in changes and given != getattr(TrainOptions, name):
            raise InputError(
                f"expected one value for {key}, got --set {key}={changes[key]} beside the option --{name.replace('_', '-')}, "
                f"which is {given}; leave one out"
            )
    given = {key for key, name in OPTIONS.items() if getattr(options, name) != getattr(TrainOptions, name)}
    preset = presets(options.method, options.protocol)
    beneath = {key: value for key, value in preset.items() if key not in given | {"start"}}
    return overridden(config, beneath | changes)


def _require_run(out: Path, resume: bool) -> None:
    """The folder must exist for a run to resume, and must not for a new one."""
    if resume and not (out / CHECKPOINT).is_file():
        raise FileNotFoundError(f"expected a run to resume in {out}, found no {CHECKPOINT} there; leave out --resume")
    if not resume and out.exists():
        raise FileExistsError(
            f"expected a new folder for the run, but {out} exists; choose another --out or add --resume"
        )


def _create_run(out: Path, training: Training, reference: SceneReference, *, keep_start: bool) -> None:
    """Make the folder with its first checkpoint appear at once.  keep_start: with a copy that stays."""
    partial = out.absolute().with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a run that was killed: the lock is ours
    partial.mkdir()
    try:
        save_checkpoint(partial / CHECKPOINT, training, reference)
        if keep_start:
            (partial / START).mkdir()
            deeper = replace(reference, relative=os.path.join(os.pardir, reference.relative))
            save_checkpoint(partial / START / CHECKPOINT, training, deeper)
        os.rename(partial, out)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def resumed(path: Path, config: TrainConfig, reference: SceneReference, remedy: str = AGAIN) -> Training:
    """The training of a checkpoint, which must have been started with the same settings on the same views.  remedy: what a
    refusal advises."""
    loaded = load_checkpoint(path)
    asked = {**leaves(asdict(config)), **leaves(asdict(replace(reference, absolute="", relative="")))}
    saved = {
        **leaves(asdict(loaded.training.config)),
        **leaves(asdict(replace(loaded.scene, absolute="", relative=""))),
    }
    for key, value in saved.items():
        if asked[key] != value:
            raise InputError(
                f"expected the settings that the run in {path.parent} was started with, {key} = {value}, got "
                f"{asked[key]}; {remedy}"
            )
    return loaded.training


def _follow(
    training: Training,
    views: list[View],
    path: Path,
    reference: SceneReference,
    every: int,
    trajectory: Trajectory | None,
    console: Console,
) -> int:
    """Train to the end with a progress bar and checkpoints; the exit code where a signal ended it, after a checkpoint."""
    total, spent = training.config.iterations, TrainingTime.read(path.parent)
    warned = (trajectory.skipped or trajectory.hopeless) if trajectory else ""
    with interruption() as interrupted, _progress(console) as progress:
        bar = progress.add_task("training", total=total, completed=training.step, state="")
        loss = math.nan
        for done in spent.timed(train(training, views)):
            loss = done.loss if math.isnan(loss) else loss + SMOOTHING * (done.loss - loss)
            progress.update(bar, completed=done.step, state=f"loss {loss:.4f} {done.gaussians} Gaussians")
            if trajectory:
                trajectory.after_step(spent.wall)
                if not warned and (warned := trajectory.skipped):
                    console.print(f"after step {done.step}: {warned}", **WARNING)
            stop = interrupted.is_set()
            if stop or done.step % every == 0 or done.step == total:
                save_checkpoint(path, training, reference)
                spent.write(path.parent)
                _write_history(training, path.with_name(HISTORY))
            if stop:
                return interrupted.exit_code if done.step < total else 0
    return 0


def _write_history(training: Training, path: Path) -> None:
    if training.method.history:
        write_atomically(path, pd.DataFrame(training.method.history).to_csv(index=False).encode())


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:5.1f} it/s" if task.speed else "  --- it/s")


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TextColumn("{task.fields[state]}"),
        TimeRemainingColumn(),
        console=console,
        refresh_per_second=4,
    )


def _report(training: Training, views: list[View], held_out: list[View], out: Path) -> None:
    """Score the views, write renders and metrics, print the table."""
    config = training.config
    background = config.background_colour(training.gaussians.flat.dtype)
    renders, names = out / RENDERS, render_names([view.name for view in held_out])

    def keep(name: str, image: Tensor) -> None:
        write_atomically(renders / names[name], _png(image))

    console = Console()
    try:
        lpips = load_lpips()
    except MissingPerceptual as error:
        lpips = None
        console.print(str(error), **PLAIN)
    seen = evaluate(training.gaussians, views, background, config.render, lpips=lpips)
    tested = None
    if held_out:
        renders.mkdir(exist_ok=True)
        tested = evaluate(training.gaussians, held_out, background, config.render, lpips=lpips, on_image=keep)
    metrics = {
        "step": training.step,
        "method": config.method.name,
        "protocol": config.protocol,
        "gaussians": len(training.gaussians),
        "train": _scores(seen),
        "test": _scores(tested) if tested else None,
        "seconds": asdict(TrainingTime.read(out)),
        "provenance": plain(provenance(config.seed, checkpoint=str(out / CHECKPOINT))),
    }
    write_atomically(out / METRICS, json_text(metrics).encode())
    console.print(_table(seen, tested))
    rendered = (
        f"renders of the held-out views: {renders}; " if tested else "no view was held out, so nothing was tested; "
    )
    for line in (f"{rendered}scores: {out / METRICS}", f"next: landscape probe {shlex.quote(str(out / CHECKPOINT))}"):
        console.print(line, **PLAIN)


def render_name(view: str) -> str:
    """File name of a view's render: `train/r_3` becomes `train_r_3.png`, `IMG_1.JPG` becomes `IMG_1.png`."""
    flat = Path(view.replace("/", "_"))
    return f"{flat.stem if flat.suffix.lower() in IMAGE_SUFFIXES else flat.name}.png"


def render_names(views: Sequence[str]) -> dict[str, str]:
    """`render_name` of each view; those that would be one file, in any case of letters, are told apart by a number.

    >>> render_names(["a/b.png", "a_b.png", "c"])
    {'a/b.png': 'a_b.png', 'a_b.png': 'a_b-2.png', 'c': 'c.png'}
    """
    names: dict[str, str] = {}
    for view in views:
        name, taken = render_name(view), {each.lower() for each in names.values()}
        stem = name.removesuffix(".png")
        numbered = (f"{stem}-{number}.png" for number in count(2))
        names[view] = (
            name if name.lower() not in taken else next(each for each in numbered if each.lower() not in taken)
        )
    return names


def _png(image: Tensor) -> bytes:
    pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def _scores(evaluation: Evaluation) -> dict[str, Any]:
    def of(scores: ViewScore | Evaluation) -> dict[str, Any]:
        return {"psnr": scores.psnr, "ssim": scores.ssim, "lpips": scores.lpips}

    return {**of(evaluation), "masked": evaluation.masked, "views": {view.name: of(view) for view in evaluation.views}}


def _table(seen: Evaluation, tested: Evaluation | None) -> Table:
    shown = tested or seen
    title = "held-out views" if tested else "training views"
    table = Table("view", title=f"{title}, inside their masks" if shown.masked else title)
    columns = {"PSNR (dB)": "psnr", "SSIM": "ssim", **({} if shown.lpips is None else {"LPIPS": "lpips"})}
    for column in columns:
        table.add_column(column, justify="right")

    def row(name: str, scores: ViewScore | Evaluation, style: str | None = None) -> None:
        values = [getattr(scores, key) for key in columns.values()]
        cells = ["" if v is None else f"{v:.{2 if key == 'psnr' else 4}f}" for v, key in zip(values, columns.values())]
        table.add_row(escape(name), *cells, style=style)

    if tested:
        for view in tested.views:
            row(view.name, view)
        table.add_section()
        row("mean", tested, "bold")
    row("mean of the training views" + (", whole" if shown.masked and not seen.masked else ""), seen)
    return table
