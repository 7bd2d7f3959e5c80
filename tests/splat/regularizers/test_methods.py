"""What holds for every method of training: its name, and that it resumes to the same bits."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, get_args

import pytest
import torch

from splat.checkpoint import load_checkpoint, save_checkpoint
from splat.regularizers.dropgaussian import DropGaussian
from splat.regularizers.methods import METHODS, MethodSettings, ThreeDGS
from splat.regularizers.sam import SAM
from splat.regularizers.stablegs import StableGS
from splat.train import Training, train
from tests.splat.tiny import EXTENT, REFERENCE, tiny_config, tiny_gaussians, tiny_views

SHORT: dict[str, MethodSettings] = {
    "3dgs": ThreeDGS(),
    "stablegs": StableGS(warm_up=3, every=4),
    "sam": SAM(),
    "dropgaussian": DropGaussian(),
}  # schedules that fit into a dozen steps


def checkpoint_of(training: Training, path: Path) -> bytes:
    save_checkpoint(path, training, REFERENCE)
    return path.read_bytes()


def same(one: Any, other: Any) -> bool:
    """Whether two contents of a checkpoint agree to the bit."""
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return type(one) is type(other) and one == other


def test_every_method_is_known_by_its_name():
    assert set(METHODS.values()) == set(get_args(MethodSettings))
    assert list(SHORT) == list(METHODS)
    for name, settings in METHODS.items():
        assert settings().name == name


@pytest.mark.parametrize("name", METHODS)
def test_a_training_by_any_method_continues_from_a_checkpoint_to_the_same_bits(tmp_path, name):
    path, config = tmp_path / "checkpoint.pt", replace(tiny_config(), method=SHORT[name])
    whole = Training.start(tiny_gaussians(), EXTENT, config)
    kept = {}
    for done in train(whole, tiny_views()):
        kept[done.step] = checkpoint_of(whole, path)
    for stop in (1, 6, 9):
        path.write_bytes(kept[stop])
        resumed = load_checkpoint(path).training
        assert resumed.config == config
        for _ in train(resumed, tiny_views()):
            pass
        ends = [torch.load(BytesIO(end), weights_only=True) for end in (checkpoint_of(resumed, path), kept[12])]
        assert same(*ends)


@pytest.mark.parametrize("name", [name for name in METHODS if name != "3dgs"])
def test_every_method_changes_what_is_trained(name):
    ends = []
    for method in (SHORT["3dgs"], SHORT[name]):
        training = Training.start(tiny_gaussians(), EXTENT, replace(tiny_config(), method=method))
        for _ in train(training, tiny_views()):
            pass
        ends.append(training.gaussians.flat)
    assert ends[0].shape != ends[1].shape or not torch.equal(*ends)
