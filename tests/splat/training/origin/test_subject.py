"""The door: a run, its checkpoint or another tool's file, with its scene and the loss that is studied."""

from pathlib import Path

import pytest
import torch

from landscape.errors import TooLittleMemory
from splat.losses.reference import LossSettings
from splat.scenes.scene import load_scene
from splat.scenes.splits import split_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import open_subject, save_checkpoint
from splat.training.origin import subject
from splat.training.origin.options import Foreign
from splat.training.origin.subject import SceneReference
from splat.training.state import TrainConfig, Training
from tests.refusals import refused

MADE = synthetic_scene(SyntheticSettings(gaussians=50, views=5, width=24, height=18))


@pytest.fixture
def run(tmp_path) -> Path:
    """A run on three of five views; its scene lies beside it."""
    write_transforms_scene(MADE.scene, tmp_path / "scene")
    (tmp_path / "run").mkdir()
    split, path = split_scene(MADE.scene, 3), tmp_path / "run" / "checkpoint.pt"
    training = Training.start(MADE.truth, MADE.scene.extent(split.train), TrainConfig())
    save_checkpoint(path, training, SceneReference.to(load_scene(tmp_path / "scene"), path, split, None, 1.0))
    return path.parent


def test_a_run_stands_for_its_checkpoint(run):
    by_folder, by_file = open_subject(run), open_subject(str(run / "checkpoint.pt"))
    assert by_folder.path == by_file.path == run / "checkpoint.pt"
    objectives = by_folder.objective(), by_file.objective()
    assert torch.equal(*(each.gradient for each in objectives))
    assert [view.name for view in objectives[0].views] == by_folder.checkpoint.scene.train


def test_views_and_loss_are_those_of_the_training_unless_others_are_named(run):
    found = open_subject(run)
    held_out, plain = found.checkpoint.scene.test, LossSettings("l2", ssim_weight=0)
    objective = found.objective(held_out, plain, keep_unseen=True)
    assert [view.name for view in objective.views] == held_out and objective.loss_settings == plain
    assert len(objective.active) == len(MADE.truth)
    assert found.objective().loss_settings == LossSettings()


def test_a_scene_that_moved_is_named_and_fewer_views_are_spread(run):
    moved = (run.parent / "scene").rename(run.parent / "moved")
    refused("--scene", open_subject, run, error=FileNotFoundError)
    found = open_subject(run, Foreign(scene=moved, max_views=2))
    assert len(found.checkpoint.scene.train) == 2 and found.checkpoint.all_views == 3 and found.scene.root == moved


def test_pictures_that_do_not_fit_are_refused_before_they_are_read(run, monkeypatch):
    found = open_subject(run)
    two = subject.COPIES * found.checkpoint.training.gaussians.flat.nbytes + 2 * subject.PLANES * 4 * 24 * 18
    for room, remedy in ((0, "allow or free at least"), (two, "--max-views 2 would fit")):
        monkeypatch.setattr(subject, "free_memory", lambda _, room=room: room)
        refused(remedy, found.objective, error=TooLittleMemory)
