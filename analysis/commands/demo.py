"""`landscape demo`: make a synthetic scene, train on three of its views, probe the result; or go on with one.

OUT/scene    the scene (`splat.scenes.synthetic`) as transforms.json with pictures
OUT/run      the training, and in OUT/run/probe the record of the probe
"""

import shlex
from itertools import count
from pathlib import Path

from rich.console import Console

from analysis.commands.options import DemoOptions
from analysis.console.drawing import drawing
from analysis.console.plain import say
from analysis.probe.command import run_probe
from analysis.probe.options import ProbeOptions
from analysis.records.run_files import CHECKPOINT
from analysis.train.command import run_training
from analysis.train.options import TrainOptions
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene

SCENE = SyntheticSettings(width=160, height=120)
VIEWS, ITERATIONS = 3, 600


def run_demo(options: DemoOptions) -> int:
    """Make, train, probe, what is not done yet; returns the exit code."""
    out = free_folder(options.out)
    if out != options.out:
        say(f"{options.out} exists, so this run goes to {out}")
    if not (out / "scene").exists():
        with Console(stderr=True).status("making a synthetic scene"):
            write_transforms_scene(synthetic_scene(SCENE).scene, out / "scene")
    run, checkpoint = out / "run", out / "run" / CHECKPOINT
    begun = checkpoint.is_file()
    training = TrainOptions(out / "scene", out=run, views=VIEWS, iterations=ITERATIONS, resume=begun)
    typed = ["train", str(training.scene), "--out", str(run), "--views", str(VIEWS)]
    typed += ["--iterations", str(ITERATIONS), *(["--resume"] if begun else [])]
    _announce(typed)
    if code := run_training(training, ["landscape", *typed]):
        return code
    typed = ["probe", str(checkpoint)]
    _announce(typed)
    with drawing("make_all") as drawn:
        return run_probe(ProbeOptions(checkpoint), ["landscape", *typed], drawn)


def _announce(arguments: list[str]) -> None:
    """The command that does the same."""
    say(f"\n$ {shlex.join(['landscape', *arguments])}", style="bold")


def free_folder(wanted: Path) -> Path:
    """The first of wanted, wanted-2, wanted-3, ... that does not exist yet, or holds a demo that was interrupted."""
    candidates = (wanted if n == 1 else wanted.with_name(f"{wanted.name}-{n}") for n in count(1))
    left = (each for each in candidates if not (each / "run" / "probe").exists())
    return next(each for each in left if not each.exists() or (each / "scene").exists())
