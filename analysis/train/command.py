"""`landscape train`: train a scene into a run folder, with checkpoints, and score its held-out views.

    RUN/checkpoint.pt           the latest checkpoint (`splat/training/checkpoint.py`), written at the start, every
                                --checkpoint-every steps, on Ctrl-C and at the end
    RUN/step-N/checkpoint.pt    with --keep-checkpoints: the latest ones, by step; a probe of one writes beside it
    RUN/psnr-X/checkpoint.pt    with --save-at-psnr: the first, of those that are looked at every LOOK steps, whose training
                                views have X dB, by the mean of their squared errors; absent where none has
    RUN/train.csv               progress (`analysis/train/progress.py`)
    RUN/seconds.json            time of the steps (`analysis/train/progress.py`)
    RUN/history.csv             notes of the training method, a row each with its "step"; absent without any
    RUN/trajectory.csv, RUN/start/checkpoint.pt     with --probe-every: the landscape during the training
                                (`analysis/train/trajectory.py`)
    RUN/test/                   renders of the held-out views at the end (`analysis/train/scores.py`)
    RUN/metrics.json            {"step", "method", "protocol", "gaussians", "train": scores, "test": scores or null, "seconds",
                                "provenance"}, where scores are {"psnr", "ssim", "lpips", "avge", "masked", "views": {NAME:
                                the first four}}: psnr in dB, "Infinity" for a perfect image; lpips and avge
                                (`splat/training/score`) null where LPIPS cannot be computed; masked: inside masks only

The run folder appears at once, with its first checkpoint.
"""

import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import inf
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import torch
from rich.console import Console

from analysis.console.interruption import interruption
from analysis.console.overrides import assignments, overridden
from analysis.console.plain import say
from analysis.records.run_files import CHECKPOINT
from analysis.train.options import TrainOptions
from analysis.train.progress import TrainingProgress, TrainingTime, scored, tracker_module
from analysis.train.remarks import begins, remarks
from analysis.train.scores import report
from analysis.train.trajectory import START, Trajectory, TrajectorySettings
from landscape.errors import InputError, did_you_mean
from splat.backend.device import device_named
from splat.losses.reference import LossSettings
from splat.model.files.read import is_foreign
from splat.model.gaussians import Gaussians
from splat.model.typed import leaves, typed
from splat.model.untrusted import beside, locked, replacing
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split, explicit_split, read_names, split_scene, usual_views
from splat.scenes.view import View
from splat.training.checkpoint import load_checkpoint, open_checkpoint, save_checkpoint, write_atomically
from splat.training.densify import DensifySettings
from splat.training.loop import prepare, train
from splat.training.methods.methods import METHODS, presets
from splat.training.origin.fingerprint import Fingerprint
from splat.training.origin.foreign import REGULARIZERS
from splat.training.origin.frames import posed, shift_to_origin
from splat.training.origin.options import Foreign
from splat.training.origin.subject import Checkpoint, SceneReference
from splat.training.score.evaluate import have_masks
from splat.training.start import Source, initial_gaussians
from splat.training.state import TrainConfig, Training

HISTORY, KEPT, REACHED = "history.csv", "step-{}", "psnr-{:g}"
LOOK = 50  # steps between two looks at the training views' PSNR
COLOURS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
OPTIONS = {  # settings of the training that have an option besides --set
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


@dataclass(frozen=True, eq=False)
class Run:
    """A training with its scene, its views and its folder.

    keep: number of checkpoints that are kept besides the latest; levels: dB of the training views at which one more is.
    """

    out: Path
    training: Training
    scene: Scene
    views: list[View]
    held_out: list[View]
    reference: SceneReference
    keep: int | Literal["all"] = 0
    levels: Sequence[float] = ()

    @property
    def fingerprint(self) -> Fingerprint:
        """What the numbers of the training as it stands are about, with those of its held-out views."""
        tested = {name: self.reference.views[name] for name in self.reference.test}
        return Checkpoint(self.training, self.reference).fingerprint({}, self.training.config.seed, further=tested)

    def create(self, *, keep_start: bool) -> None:
        """Create the folder with its first checkpoint, atomically.  keep_start: with a copy in START."""
        with replacing(self.out.absolute(), folder=True) as partial:
            save_checkpoint(partial / CHECKPOINT, self.training, self.reference)
            if keep_start:
                self._save_within(partial / START)

    def save(self, spent: TrainingTime, *, stays: bool) -> None:
        """Write the checkpoint, time and history.  stays: also as a kept checkpoint; the oldest beyond `keep` are removed."""
        if stays and self.keep:
            self._save_within(self.out / KEPT.format(self.training.step))
        save_checkpoint(self.out / CHECKPOINT, self.training, self.reference)
        spent.write(self.out)
        if history := self.training.method.history:
            import pandas as pd  # slow to import

            write_atomically(self.out / HISTORY, pd.DataFrame(history).to_csv(index=False).encode())
        if self.keep != "all":
            folders = (path.parent.name for path in self.out.glob(f"{KEPT.format('*')}/{CHECKPOINT}"))
            kept = sorted(int(step) for name in folders if (step := name.removeprefix("step-")).isdigit())
            for step in kept[: max(len(kept) - self.keep, 0)]:
                (folder := self.out / KEPT.format(step)).joinpath(CHECKPOINT).unlink()
                if not any(folder.iterdir()):  # a probe of the checkpoint may lie there
                    folder.rmdir()

    def save_reached(self) -> None:
        """Keep the checkpoint for each of the levels that the training views reach now and did not before."""
        pending = [level for level in self.levels if not (self.out / REACHED.format(level) / CHECKPOINT).exists()]
        if pending:
            error = fmean(10 ** (-scored(self.training, view)[1] / 10) for view in self.views)
            for level in pending:
                if error <= 10 ** (-level / 10):
                    self._save_within(self.out / REACHED.format(level))

    def _save_within(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        deeper = replace(self.reference, relative=os.path.join(os.pardir, self.reference.relative))
        save_checkpoint(folder / CHECKPOINT, self.training, deeper)


def run_training(options: TrainOptions, command: Sequence[str]) -> int:
    """Train, or continue, a run; returns the exit code.  command: as typed, for the message on how to resume."""
    for name in ("checkpoint_every", "log_every"):
        if (value := getattr(options, name)) < 1:
            raise InputError(f"expected {name} of at least 1, got {value}")
    levels = options.save_at_psnr or ()
    if not all(0 < level < inf for level in levels):
        raise InputError(f"expected save_at_psnr in dB above 0, got {' '.join(map(str, levels))}")
    if options.keep_checkpoints != "all" and options.keep_checkpoints < 0:
        raise InputError(f"expected keep_checkpoints of at least 0, or all, got {options.keep_checkpoints}")
    if options.track:
        tracker_module(options.track)  # refuses before anything is loaded
    _asked(options, None)  # so do the settings
    along = None if options.probe_every is None else TrajectorySettings(options.probe_every, options.probe_quick)
    out = options.out or Path("runs") / options.scene.resolve().name
    _require_run(out, options.resume)
    plan, given = from_checkpoint(options, planned(options, out), out)
    scene, split, config, reference = plan
    device = device_named(options.device)
    views, held_out = scene.load(split.train), scene.load(split.test)
    for together in (views, held_out):
        have_masks(together)
    if options.resume:
        training = resumed(out / CHECKPOINT, config, reference).training
    else:
        generator = torch.Generator().manual_seed(config.seed)
        if given is None:
            given = initial_gaussians(scene, views, 0, generator=generator, source=reference.start)
        training = Training.start(given, scene.extent(split.train), config)
    training.move(device)
    prepare(training, views)  # refuses what cannot be trained before there is a folder
    run = Run(out, training, scene, views, held_out, reference, options.keep_checkpoints, levels)
    if not out.parent.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
    with locked(beside(out), f"no other training in {out}"):
        if not options.resume:
            _require_run(out, resume=False)  # another process may have created it before the lock was taken
            run.create(keep_start=along is not None)
        return _run(run, options, command, along)


def _run(run: Run, options: TrainOptions, command: Sequence[str], along: TrajectorySettings | None) -> int:
    """Train to the end and score, in a folder that exists; as `run_training`."""
    training, console = run.training, Console(stderr=True)
    first = begins(run.scene, run.views, len(run.held_out), training, options.from_ or run.reference.start)
    say(first, console=console)
    begun = None if options.resume or options.from_ else (run.reference.start, len(training.gaussians))
    settings = _asked(options, run.scene), _config(options, run.scene)
    say(*remarks(run.scene, *settings, begun, training, run.views[0]), style="yellow", console=console)
    trajectory = None if along is None else Trajectory(run.out, training, run.views, along, run.reference)
    if code := _follow(run, options, trajectory, console):
        again = shlex.join([*command, *([] if options.resume else ["--resume"])])
        say(f"stopped after step {training.step}; to continue: {again}", console=console)
        return code
    report(training, run.views, run.held_out, run.out, run.fingerprint)
    if trajectory:
        say(*filter(None, [trajectory.skipped]), style="yellow", console=console)
    return 0


def planned(options: TrainOptions, out: Path) -> tuple[Scene, Split, TrainConfig, SceneReference]:
    """Plan of a training from its options; reads no image.  Raises ValueError or FileNotFoundError where they are wrong."""
    colour, preset = COLOURS.get(options.background or "scene"), presets(options.method, options.protocol)
    scene = load_scene(options.scene, options.images, options.downscale, colour, options.masks, options.depths)
    split = _split(options, scene)
    start = typed(Source, options.start or preset.get("start", "scene"), "start")
    seen = options.images, options.downscale, start, options.depths, options.masks
    reference = SceneReference.to(scene, out / CHECKPOINT, split, *seen)
    shift = None if options.from_ else shift_to_origin(scene)  # a checkpoint brings its world
    world = None if shift is None else shift.tolist()
    return posed(scene, world, centred=False), split, _config(options, scene), replace(reference, similarity=world)


def _split(options: TrainOptions, scene: Scene) -> Split:
    if options.train_list is not None:
        if options.views is not None:
            raise InputError("expected --views or --train-list, got both; leave one out")
        return explicit_split(scene.names, read_names(options.train_list))
    views = usual_views(scene) if options.views is None else options.views
    return split_scene(scene, None if views == "all" else views)


def _config(options: TrainOptions, scene: Scene) -> TrainConfig:
    """The settings, with the method's schedule scaled to the number of steps, except for those given by --set."""
    config = _asked(options, scene)
    return config.method.scaled(config, [key.removeprefix("method.") for key in assignments(options.set)])


def _asked(options: TrainOptions, scene: Scene | None) -> TrainConfig:
    """The settings as given: options over --set over the protocol's presets over defaults; scene: of the background."""
    red, green, blue = scene.background.tolist() if scene else COLOURS["black"]
    if options.method not in METHODS:
        meant = did_you_mean(options.method, METHODS)
        raise InputError(f"expected a method among {', '.join(METHODS)}, got {options.method!r}{meant}")
    config = TrainConfig(
        iterations=METHODS[options.method].ITERATIONS if options.iterations is None else options.iterations,
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
    given = {key: name for key, name in OPTIONS.items() if getattr(options, name) != getattr(TrainOptions, name)}
    for key, name in given.items():
        if key in changes:
            raise InputError(
                f"expected one value for {key}, got --set {key}={changes[key]} beside the option --{name.replace('_', '-')}, "
                f"which is {getattr(options, name)}; leave one out"
            )
    preset = presets(options.method, options.protocol)
    beneath = {key: value for key, value in preset.items() if key not in given and key != "start"}
    return overridden(config, beneath | changes)


def _require_run(out: Path, resume: bool) -> None:
    """Raise FileNotFoundError or FileExistsError unless a run to resume exists, or a new one does not."""
    if resume and not (out / CHECKPOINT).is_file():
        raise FileNotFoundError(f"expected a run to resume in {out}, found no {CHECKPOINT} there; leave out --resume")
    if not resume and out.exists():
        raise FileExistsError(
            f"expected a new folder for the run, but {out} exists; choose another --out or add --resume"
        )


def resumed(path: Path, config: TrainConfig, reference: SceneReference, remedy: str = AGAIN) -> Checkpoint:
    """The checkpoint at a path.  Raises InputError, with this remedy, unless it has the same settings and views."""
    loaded = load_checkpoint(path)

    def settings(of: TrainConfig, scene: SceneReference) -> dict[str, Any]:
        return leaves(asdict(of)) | leaves(asdict(replace(scene, absolute="", relative="", views={})))

    asked, saved = settings(config, reference), settings(loaded.training.config, loaded.scene)
    for key, value in saved.items():
        if asked[key] != value:
            raise InputError(
                f"expected the settings that the run in {path.parent} was started with, {key} = {value}, got "
                f"{asked[key]}; {remedy}"
            )
    loaded.scene.require_unchanged(reference.views, reference.absolute)
    return loaded


def _follow(run: Run, options: TrainOptions, trajectory: Trajectory | None, console: Console) -> int:
    """Train to the end, with checkpoints; returns 0, or the exit code of the signal that ended it before."""
    training, spent = run.training, TrainingTime.read(run.out)
    total = training.config.iterations
    progress = TrainingProgress(run.out, training, run.views[0], options.log_every, console, options.track)
    with interruption() as interrupted, progress:
        progress.begin(spent)
        if trajectory:
            trajectory.before_steps()
        for done in spent.timed(train(training, run.views)):
            progress.after_step(done, spent)
            if trajectory:
                trajectory.after_step()
            if done.step % LOOK == 0:
                run.save_reached()
            stop = interrupted.is_set()
            due = done.step % options.checkpoint_every == 0 or done.step == total
            if stop or due:
                run.save(spent, stays=due)
            if stop:
                return interrupted.exit_code if done.step < total else 0
    return 0


Planned = tuple[Scene, Split, TrainConfig, SceneReference]


def from_checkpoint(options: TrainOptions, plan: Planned, out: Path) -> tuple[Planned, Gaussians | None]:
    """The plan in the checkpoint's world and with its renderer, and its Gaussians; the plan as it is without --from.

    Density control begins and recurs after as many steps as in a long training, unless --set says otherwise: each of the rounds
    that a short training from points has would double the Gaussians of a trained scene before the last ones have moved.
    InputError where the checkpoint is refused, and where --set changes its renderer or --trained-by has no file to speak of.
    """
    scene, split, config, reference = plan
    asked, train = Foreign(**vars(options.foreign)), None
    if options.from_ is None:
        if asked != Foreign():
            raise InputError(
                "expected --from beside --trained-by, --antialiased, --opacity-reg or --scale-reg, which speak of its file, "
                "got none"
            )
        return plan, None
    changes = assignments(options.set)
    if any(key.startswith("render.") for key in changes):
        raise InputError("expected --from, which brings its renderer, or --set render..., got both; leave one out")
    regularized = [name for name in REGULARIZERS if getattr(asked, name) is not None]
    if twice := [name for name in regularized if f"loss.{name}" in changes]:
        raise InputError(f"expected --{twice[0].replace('_', '-')} or --set loss.{twice[0]}, got both; leave one out")
    if is_foreign(options.from_):
        asked = replace(asked, scene=options.scene, images=options.images, downscale=options.downscale)
        train = split.train
    found = open_checkpoint(options.from_, asked, out, train)
    world = found.scene
    scene = posed(scene, world.similarity, centred=world.centred)
    reference = replace(reference, similarity=world.similarity, centred=world.centred)
    theirs = found.training.config
    weights = {name: getattr(theirs.loss, name) for name in regularized}
    loss = replace(config.loss, border=theirs.loss.border, **weights)
    whole = {name: 1.0 for name in ("start_share", "every_share") if f"densify.{name}" not in changes}
    config = replace(config, render=theirs.render, loss=loss, densify=replace(config.densify, **whole))
    return (scene, split, config, reference), found.training.gaussians
