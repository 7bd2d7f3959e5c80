"""Loss and scores along trainings that kept their checkpoints.

RUNS/SCENE/METHOD/SEED/curve.csv    of every run of a sweep with `keep_checkpoints = "all"`: a row for each checkpoint

    step, cpu       steps so far, and the seconds of all processors that they took (train.csv)
    passes          over the pixels of one view: two a step of Adam, else as history.csv has them
    loss, psnr      of all training views: the mean of the training's loss, and dB
    held_out        dB of the held-out views
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.records.run_files import CHECKPOINT
from landscape.errors import InputError
from splat.model.untrusted import read_table
from splat.scenes.view import View
from splat.training.checkpoint import load_checkpoint, open_subject
from splat.training.score.evaluate import evaluate

LOG, HISTORY = "train.csv", "history.csv"
OF_ADAM = 2  # forward and backward


def curve(run: Path) -> pd.DataFrame:
    """The rows of a run that has ended.  InputError where it kept no checkpoints or logged none of their steps."""
    log = read_table(run / LOG).set_index("step")
    kept = sorted((int(path.parent.name.removeprefix("step-")), path) for path in run.glob(f"step-*/{CHECKPOINT}"))
    if not kept:
        raise InputError(f"expected checkpoints along {run}, found none; train with --keep-checkpoints all")
    if missing := [step for step, _ in kept if step not in log.index or "cpu" not in log]:
        raise InputError(
            f"expected the step {missing[0]} in {run / LOG}, found no time of it; train with --log-every 1"
        )
    views, held_out = _views(kept[0][1])
    passes = _passes(run)
    rows: list[dict[str, Any]] = []
    for step, path in kept:
        training = load_checkpoint(path).training
        config, gaussians = training.config, training.gaussians
        background = config.background_colour(gaussians.flat.dtype)
        objective = config.objective(gaussians, views)
        known, unknown = (evaluate(gaussians, each, background, config.render).psnr for each in (views, held_out))
        rows.append(
            {
                "step": step,
                "cpu": float(log.loc[step, "cpu"]),  # pyright: ignore[reportArgumentType]
                "passes": OF_ADAM * step if passes is None else int(passes[:step].sum()),
                "loss": objective.loss(objective.active.flat),
                "psnr": known,
                "held_out": unknown,
            }
        )
    return pd.DataFrame(rows)


def _views(path: Path) -> tuple[list[View], list[View]]:
    subject = open_subject(path)
    scene, views = subject.scene, subject.checkpoint.scene
    if not views.test:
        raise InputError(f"expected held-out views in {path}, got none")
    return scene.load(views.train), scene.load(views.test)


def _passes(run: Path) -> "pd.Series | None":
    """Passes of each step, where the method counts them."""
    if not (run / HISTORY).is_file():
        return None
    return read_table(run / HISTORY).get("passes")


def against(table: pd.DataFrame, reference: str) -> pd.DataFrame:
    """A row for each scene and method of `curves.csv`: seeds, how many reached the reference's last loss, its seconds over the
    reference's (mean and standard deviation over these), and the last held-out dB, its mean and deviation over all seeds."""
    runs: dict[Any, pd.DataFrame] = dict(iter(table.groupby(["scene", "method", "seed"], sort=False)))
    rows = []
    for (scene, method, seed), run in runs.items():
        if (other := runs.get((scene, reference, seed))) is not None:
            time = reached(run, float(other["loss"].iloc[-1])) / float(other["cpu"].iloc[-1])
            rows.append({"scene": scene, "method": method, "seconds": time, "held_out": run["held_out"].iloc[-1]})
    if not rows:
        raise InputError(f"expected runs of {reference!r}, got {', '.join(map(repr, table['method'].unique()))}")
    groups = pd.DataFrame(rows).groupby(["scene", "method"], sort=False)
    found = groups.agg(["mean", "std"])
    found.columns = ["seconds", "seconds_sd", "held_out", "held_out_sd"]
    found.insert(0, "seeds", groups.size())
    found.insert(1, "reached", groups["seconds"].count())
    return found.reset_index()


def reached(run: pd.DataFrame, loss: float) -> float:
    """The seconds that a run takes to a loss; nan where it does not get there.

    >>> round(reached(pd.DataFrame({"cpu": [1.0, 3.0], "loss": [0.1, 0.001]}), 0.01), 9)
    2.0
    """
    losses, seconds = run["loss"].to_numpy(), run["cpu"].to_numpy()
    if not (losses <= loss).any():
        return float("nan")
    after = int(np.argmax(losses <= loss))
    if after == 0:
        return float(seconds[0])
    share = np.log(losses[after - 1] / loss) / np.log(losses[after - 1] / losses[after])
    return float(seconds[after - 1] + share * (seconds[after] - seconds[after - 1]))
