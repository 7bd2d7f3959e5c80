"""Progress of a training: rows of RUN/train.csv, a line of the terminal for each where there is no bar, a tracker if asked.

RUN/train.csv           a row before the first step, every --log-every steps and after the last; complete lines at any time
RUN/seconds.json        `TrainingTime`, written after every checkpoint
RUN/tracked/            with --track: the same numbers for TensorBoard, Weights & Biases or trackio

Columns:

step, gaussians    steps made, and the Gaussians after them
loss, psnr         of the first training view as it would be rendered then: the loss that a step descends, and dB, peak 1
seconds, cpu       that the steps so far took, by the clock and of all processors together, without loading, saving and scoring
"""

import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from math import inf, isnan, nan
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from time import perf_counter, process_time
from typing import Any

import msgspec
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from analysis.console.plain import say
from analysis.records.json_files import read_json
from analysis.records.run_files import SECONDS, Seconds
from landscape.errors import InputError
from splat.losses.autograd import view_loss
from splat.losses.reference import psnr
from splat.losses.regularizers import Regularizers
from splat.render.render import render
from splat.scenes.view import View
from splat.training.checkpoint import write_atomically
from splat.training.loop import StepResult
from splat.training.state import Training

LOG, TRACKED = "train.csv", "tracked"
COLUMNS = ("step", "loss", "psnr", "gaussians", "seconds", "cpu")
# a run whose Gaussians become more than FAST times those of its start in this share of it says why
EARLY, FAST = 0.1, 3
SMOOTHING = 0.05  # the bar's loss is a running mean: a step sees one view, and views differ


class TrainingTime(Seconds):
    """Time of a training's steps until one of them, over resumes, without loading, saving and scoring; and its peak memory.

    A kernel that has to be compiled first counts in.
    """

    @classmethod
    def read(cls, run: Path) -> "TrainingTime":
        """Time of a run folder; zero where it has not been saved yet."""
        if not (path := run / SECONDS).is_file():
            return cls(0, 0.0, 0.0)
        remedy = "remove it: nothing but the time until its last checkpoint is lost"
        return read_json(path, cls, "the seconds of a training", remedy)

    def write(self, run: Path) -> None:
        unit = 1 if sys.platform == "darwin" else 1024
        self.peak = max(self.peak or 0, unit * getrusage(RUSAGE_SELF).ru_maxrss)
        write_atomically(run / SECONDS, msgspec.json.encode(self) + b"\n")

    def timed(self, steps: Iterable[StepResult]) -> Iterator[StepResult]:
        """The same steps; the time that each takes is added up as it is made."""
        iterator = iter(steps)
        threads = torch.get_num_threads()
        self.threads = threads if self.threads == threads or self.step == 0 else None
        while True:
            wall, cpu = perf_counter(), process_time()
            done = next(iterator, None)
            if done is None:
                return
            self.step = done.step
            self.wall += perf_counter() - wall
            self.cpu += process_time() - cpu
            yield done


class TrainingProgress:
    """A context manager; rows that an interrupted run left after the training's step are dropped.

    every: steps between rows; track: the name of a tracker, for which InputError where it is not installed.
    """

    def __init__(
        self, run: Path, training: Training, view: View, every: int, console: Console, track: str | None = None
    ) -> None:
        self.training, self.view, self.every, self.console = training, view, every, console
        self.loss, self.begun = nan, (training.step, 0.0)
        self.most = inf if training.step else FAST * len(training.gaussians)  # Gaussians, before it says why
        self.tracker = Tracker(track, run, training.step) if track else None
        write_atomically(run / LOG, "".join([",".join(COLUMNS) + "\n", *kept_rows(run / LOG, training.step)]).encode())
        self.file = (run / LOG).open("a", encoding="utf-8", newline="")
        self.bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(),
            TextColumn("{task.fields[state]}"),
            TimeRemainingColumn(),
            console=console,
            refresh_per_second=4,
            disable=not console.is_terminal,
        )
        total = training.config.iterations
        self.bar = self.bars.add_task("training", total=total, completed=training.step, state="")

    def __enter__(self) -> "TrainingProgress":
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()
        self.file.close()
        if self.tracker is not None:
            self.tracker.close()

    def begin(self, spent: TrainingTime) -> None:
        """spent: in the steps of an interrupted run."""
        self.begun = self.training.step, spent.wall
        if not self.training.step:
            self._row(spent)

    def after_step(self, done: StepResult, spent: TrainingTime) -> None:
        """spent: in all steps so far."""
        self.loss = done.loss if isnan(self.loss) else self.loss + SMOOTHING * (done.loss - self.loss)
        state = f"loss {self.loss:.4f} {done.gaussians} Gaussians"
        self.bars.update(self.bar, completed=done.step, state=state)
        if done.gaussians > self.most and done.step <= EARLY * self.training.config.iterations:
            say(self._grown(done), style="yellow", console=self.console)
            self.most = inf
        if done.step % self.every == 0 or done.step == self.training.config.iterations:
            self._row(spent)

    def _grown(self, done: StepResult) -> str:
        """Why there are many more Gaussians than at the start so early."""
        iterations = self.training.config.iterations
        settings = self.training.config.method.density_control(self.training.config)
        rounds = [n for n in range(1, done.step + 1) if settings.densifies(n, iterations)]
        return (
            f"step {done.step}: {done.gaussians:,} Gaussians, more than {FAST} times those of the start: each of {len(rounds)} "
            f"rounds of density control since step {rounds[0]} adds one for each Gaussian whose screen gradient is above "
            f"densify.gradient_threshold = {settings.gradient_threshold:g}, which few are not until the image fits; a "
            "higher threshold, or a later densify.start, adds fewer"
        )

    def _row(self, spent: TrainingTime) -> None:
        """Write a row, and say it where there is no bar."""
        seconds = spent.wall
        step, total = self.training.step, self.training.config.iterations
        loss, ratio, gaussians = *scored(self.training, self.view), len(self.training.gaussians)
        self.file.write(f"{step},{loss!r},{ratio!r},{gaussians},{seconds:.3f},{spent.cpu:.3f}\n")
        self.file.flush()
        if self.tracker is not None:
            self.tracker.add({"loss": loss, "psnr": ratio, "gaussians": gaussians}, step)
        if not self.console.is_terminal:
            steps, time = step - self.begun[0], seconds - self.begun[1]
            left = f", about {time / steps * (total - step):.0f} s left" if steps and step < total else ""
            words = f"step {step} of {total}: loss {loss:.4f}, {ratio:.2f} dB of the first training view"
            words += f"{self._after(step)}, {gaussians} Gaussians, {seconds:.0f} s{left}"
            self.console.print(words, soft_wrap=True, highlight=False)

    def _after(self, step: int) -> str:
        """What was done to the Gaussians since the row before, besides steps: after it the image fits worse."""
        config, since = self.training.config, range(max(step - (step % self.every or self.every), 0) + 1, step + 1)
        control, total, white = config.method.density_control(config), config.iterations, config.is_white
        done = {
            "density control": any(control.densifies(n, total) for n in since),
            "a reset of opacities": any(control.resets_opacity(n, total, white=white) for n in since),
        }
        return f" after {' and '.join(name for name in done if done[name])}" if any(done.values()) else ""


@torch.no_grad()
def scored(training: Training, view: View) -> tuple[float, float]:
    """Loss and PSNR, dB, of a view as the training would render it now; changes nothing."""
    config, gaussians = training.config, training.gaussians
    background = config.background_colour(gaussians.flat.dtype)
    image = render(gaussians, view.camera, background, config.render).image
    loss = view_loss(image, config.loss_against(view.image, gaussians.flat))
    regularizers = Regularizers(gaussians, config.loss, len(gaussians))
    return float(loss) + regularizers.value, psnr(image.to(view.image.device), view.image)


class Tracker:
    """Takes the rows of a run for TensorBoard (in RUN/tracked), or Weights & Biases or trackio, whose calls are the same."""

    def __init__(self, name: str, run: Path, step: int) -> None:
        """step: that the run is at; what an interrupted one told TensorBoard of later ones is dropped."""
        self.module, self.writer = tracker_module(name), None
        if name == "tensorboard":
            self.writer = self.module.SummaryWriter(str(run / TRACKED), purge_step=step + 1)
        else:
            self.module.init(project="landscape", name=run.name)

    def add(self, values: dict[str, float], step: int) -> None:
        if self.writer is None:
            return self.module.log(values, step=step)
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)
        return self.writer.flush()

    def close(self) -> None:
        (self.module.finish if self.writer is None else self.writer.close)()


def tracker_module(name: str) -> Any:
    """The module of a tracker.  InputError where it is not installed."""
    try:
        return import_module("torch.utils.tensorboard" if name == "tensorboard" else name)
    except ImportError as error:
        raise InputError(
            f"expected the package {name} for --track {name} ({error}); install it with pip install {name}, or leave the "
            f"option out: {LOG} holds the same numbers"
        ) from None


def kept_rows(path: Path, step: int) -> list[str]:
    """The lines of an earlier run up to a step; a last one that was cut short is left out."""
    if not path.is_file():
        return []
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True)[1:] if line.endswith("\n")]
        return [line for line in lines if int(line.split(",")[0]) <= step]
    except ValueError as error:
        raise InputError(f"expected the rows of landscape train in {path}, got {error}; remove it") from None


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:5.1f} it/s" if task.speed else "  --- it/s")
