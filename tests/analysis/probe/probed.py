"""The scene whose training the tests of this folder probe, and how."""

from dataclasses import replace
from pathlib import Path

import torch

from analysis.commands.cli import main
from analysis.records.records import Record, read_record
from splat.scenes.synthetic import SyntheticSettings
from splat.training.adam import Adam
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.densify import ScreenGradients

SCENE = SyntheticSettings(gaussians=60, views=5, width=16, height=12)


def save_double(checkpoint: Path, out: Path, change=lambda gaussians: gaussians) -> None:
    """The checkpoint in double precision, with other Gaussians."""
    loaded = load_checkpoint(checkpoint)
    gaussians = change(loaded.training.gaussians.to(torch.float64))
    state = Adam.zero(gaussians), ScreenGradients.zero(len(gaussians), torch.float64)
    training = replace(loaded.training, gaussians=gaussians, adam=state[0], screen_gradients=state[1])
    save_checkpoint(out, training, loaded.scene)


def unlimited(checkpoint: Path, out: Path, *options: str) -> Record:
    """A probe whose numbers depend on no clock, with a slice of few points."""
    assert main(["probe", str(checkpoint), "--out", str(out), "--slice-points", "5", *options]) == 0
    return read_record(out)
