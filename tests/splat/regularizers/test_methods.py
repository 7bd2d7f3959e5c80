"""What holds for every method of training: its name, and that it resumes to the same bits."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splat.checkpoint import load_checkpoint, save_checkpoint
from splat.regularizers.corgs import CoRGS
from splat.regularizers.dngaussian import DNGaussian
from splat.regularizers.dropgaussian import DropGaussian
from splat.regularizers.dropoutgs import DropoutGS
from splat.regularizers.fsgs import FSGS
from splat.regularizers.methods import METHODS, ThreeDGS
from splat.regularizers.regularizer import Method
from splat.regularizers.sam import SAM
from splat.regularizers.stablegs import StableGS
from splat.scenes.view import View
from splat.train import Training, train
from tests.splat.tiny import EXTENT, REFERENCE, tiny_config, tiny_gaussians, tiny_views

SHORT: dict[str, Method] = {
    "3dgs": ThreeDGS(),
    "stablegs": StableGS(warm_up=3, every=4),
    "sam": SAM(),
    "dropgaussian": DropGaussian(),
    "dropoutgs": DropoutGS(),
    "fsgs": FSGS(threshold=0.1, large=0.01),
    "dngaussian": DNGaussian(soft_start=3),
    "cor-gs": CoRGS(prune_every=4, prune_start=3, distance=0.3, pseudo_start=5),
}  # schedules that fit into a dozen steps


def views() -> list[View]:
    """The tiny views with depth maps: a bowl."""
    rows, columns = torch.meshgrid(torch.arange(14.0), torch.arange(20.0), indexing="ij")
    return [replace(view, depth=(rows - 7) ** 2 + (columns - 10) ** 2) for view in tiny_views()]


def checkpoint_of(training: Training, path: Path) -> bytes:
    save_checkpoint(path, training, REFERENCE)
    return path.read_bytes()


def test_every_method_is_known_by_its_name():
    assert list(SHORT) == list(METHODS)
    for name, settings in METHODS.items():
        assert settings().name == name


@pytest.mark.parametrize("name", METHODS)
def test_a_training_by_any_method_continues_from_a_checkpoint_to_the_same_bits(tmp_path, name):
    path, config = tmp_path / "checkpoint.pt", replace(tiny_config(), method=SHORT[name])
    whole = Training.start(tiny_gaussians(), EXTENT, config)
    kept = {}
    for done in train(whole, views()):
        kept[done.step] = checkpoint_of(whole, path)
    for stop in (1, 6, 9):
        path.write_bytes(kept[stop])
        resumed = load_checkpoint(path).training
        assert resumed.config == config
        for _ in train(resumed, views()):
            pass
        assert checkpoint_of(resumed, path) == kept[12]


@pytest.mark.parametrize("name", [name for name in METHODS if name != "3dgs"])
def test_every_method_changes_what_is_trained(name):
    ends = []
    for method in (SHORT["3dgs"], SHORT[name]):
        training = Training.start(tiny_gaussians(), EXTENT, replace(tiny_config(), method=method))
        for _ in train(training, views()):
            pass
        ends.append(training.gaussians.flat)
    assert ends[0].shape != ends[1].shape or not torch.equal(*ends)
