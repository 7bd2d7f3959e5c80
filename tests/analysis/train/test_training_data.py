"""What `landscape train` takes beside the photographs: masks, depth maps, where to start; and LPIPS."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from analysis.commands.cli import main
from analysis.commands.convert import own_file
from analysis.console.overrides import overridden
from analysis.records.records import read_record
from analysis.train.command import planned
from analysis.train.options import TrainOptions
from analysis.train.remarks import (
    HOW_IT_STARTS,
    HOW_TO_START,
    _not_reached,
    _of_second_order,
    cut_by_near,
    poor_start,
    removes_for_size,
)
from splat.losses.reference import LossSettings
from splat.scenes.scene import load_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.densify import DensifySettings
from splat.training.methods.corgs import CoRGS
from splat.training.methods.second_order.solvers import GaussNewtonCG
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.origin.frames import posed, shift_in_words, shift_of
from splat.training.origin.subject import Checkpoint
from splat.training.start import Source
from splat.training.state import TrainConfig, Training
from tests.refusals import refused
from tests.splat.tiny import tiny_gaussians, tiny_views

SIZE = (24, 18)


def train(scene: Path, out: Path, *more: str) -> int:
    return main(["train", str(scene), "--out", str(out), "--views", "3", "--iterations", "1", *more])


def images(scene: Path) -> list[Path]:
    return sorted((scene / "images").iterdir())


def metrics(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


@pytest.fixture
def lpips(monkeypatch) -> None:
    """A stand-in for the package: the mean absolute difference."""

    class Network(torch.nn.Module):
        def __init__(self, **_: object) -> None:
            super().__init__()

        def forward(self, image: Tensor, target: Tensor) -> Tensor:
            return (image - target).abs().mean()

    module = ModuleType("lpips")
    module.LPIPS = Network  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", module)


@pytest.mark.parametrize(("views", "number"), [(None, 2), (3, 3), ("all", 4)])
def test_the_number_of_views_is_the_protocols_where_nobody_says_one(original, tmp_path, monkeypatch, views, number):
    monkeypatch.setattr("analysis.train.command.usual_views", lambda scene: 2)
    _, split, *_ = planned(TrainOptions(original, views=views), tmp_path / "run")
    assert len(split.train) == number


def test_frames_without_an_image_and_a_poor_start_are_said(original, tmp_path, capsys):
    scene = tmp_path / "scene"
    shutil.copytree(original, scene)
    images(scene)[1].unlink()
    assert train(scene, tmp_path / "run") == 0
    said = capsys.readouterr().err
    assert "1 of 5 frames that the scene lists were skipped" in said and "images/view_001.png" in said
    assert "points only, and may leave places empty; --start dense finds more" in said
    assert train(scene, tmp_path / "random", "--start", "random") == 0
    assert "random points, and most lie on no surface" in capsys.readouterr().err
    sources: tuple[Source, ...] = get_args(Source)
    assert all(poor_start(load_scene(scene), source, 2) for source in sources)
    assert set(HOW_IT_STARTS) == set(HOW_TO_START) == set(sources) - {"scene"}
    assert train(scene, tmp_path / "run", "--iterations", "2", "--resume") == 2  # the same scene, but other settings
    assert "iterations = 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("extent", "changes", "said"),
    [
        (0.1, {}, "above 0.01, here some 0.1 px, in each round from step 3,100 to 4,900"),
        (0.1, {"densify.prune_scale": "none"}, ""),
        (0.1, {"densify.reset_every": "5000"}, ""),
        (0.1, {"iterations": "6000"}, ""),  # density control ends with step 2,999
        (30.0, {}, ""),
    ],
    ids=str,
)
def test_a_rule_that_removes_what_is_small_in_the_image_is_said(extent, changes, said):
    config = overridden(TrainConfig(iterations=10000), changes)
    gaussians, (view, *_) = tiny_gaussians(), tiny_views()
    gaussians.means[:] = view.camera.centre + 3.0 * view.camera.forward
    near = replace(view, camera=replace(view.camera, fx=30.0))
    found = removes_for_size(Training.start(gaussians, extent, config), near)
    assert said in found and bool(found) == bool(said)


def test_gaussians_nearer_than_the_near_plane_are_counted():
    training, (view, *_) = Training.start(tiny_gaussians(), 1.0, TrainConfig()), tiny_views()
    assert cut_by_near(training, view) == ""
    training.gaussians.means[:2] = view.camera.centre + 0.1 * view.camera.forward
    said = f"2 of {len(training.gaussians)} Gaussians are nearer to {view.name} than the near plane at 0.2 world units"
    assert cut_by_near(training, view).startswith(said)


def test_a_world_far_from_its_origin_is_planned_near_it_and_loaded_again_as_it_was(original, tmp_path):
    made, away = load_scene(original), (431000.0, 5412000.0, 300.0)
    away_from = posed(made, np.column_stack([np.eye(3), away]).tolist(), centred=False)
    write_transforms_scene(away_from, tmp_path / "far")
    scene, split, config, reference = planned(TrainOptions(tmp_path / "far", views=2), tmp_path / "run")
    shift = shift_of(reference.similarity)
    assert shift is not None and "the world is moved by -(431000" in scene.notes[-1]
    rounding = np.spacing(5412000.0)
    training = Training.start(tiny_gaussians(), 1.0, config)
    loaded = Checkpoint(training, reference).with_scene(tmp_path / "run/checkpoint.pt").scene
    for plain, far, again in zip(made.frames, scene.frames, loaded.frames, strict=True):
        moved = plain.camera.centre.numpy() + np.array(away) - np.array(shift)
        assert np.abs(far.camera.centre.numpy() - moved).max() <= rounding
        assert torch.equal(far.camera.centre, again.camera.centre)
    assert scene.points is not None and scene.points.xyz.abs().max() < 100
    file, seen = own_file(Checkpoint(training, reference))
    assert file.notes == (shift_in_words(shift),) and not seen.moved and split.train
    opened = Checkpoint(training, reference).with_scene(tmp_path / "run/checkpoint.pt").checkpoint
    assert opened.assumptions == [shift_in_words(shift)]  # which every command that opens a checkpoint says
    assert planned(TrainOptions(original, views=2), tmp_path / "run")[3].similarity is None


def test_without_lpips_the_metric_is_null_and_the_help_says_how_to_have_it(original, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert train(original, tmp_path / "run") == 0
    said = capsys.readouterr().out
    assert "LPIPS" not in said and "AVGE" not in said
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    assert "pip install 'splat-landscape[lpips]'" in capsys.readouterr().out.splitlines()[-1]
    for part in (metrics(tmp_path / "run")[key] for key in ("train", "test")):
        assert all(each["lpips"] is each["avge"] is None for each in (part, *part["views"].values()))


@pytest.mark.usefixtures("lpips")
def test_with_lpips_it_stands_beside_psnr_and_ssim_with_its_network_and_avge(original, tmp_path, capsys):
    assert train(original, tmp_path / "run") == 0
    said, scores = capsys.readouterr().out, metrics(tmp_path / "run")
    assert "LPIPS (VGG)" in said and "AVGE" in said and "left out" not in said
    with_lpips = scores["test"]["views"]
    for view in load_scene(original).load(list(with_lpips)):
        name = view.name.removeprefix("images/")
        with Image.open(tmp_path / "run/test" / f"images_{name}") as file:
            pixels = torch.from_numpy(np.array(file)).permute(2, 0, 1) / 255
        wanted = float((pixels - view.image).abs().mean())
        assert with_lpips[view.name]["lpips"] == pytest.approx(wanted, abs=0.5 / 255)
        assert f"{with_lpips[view.name]['lpips']:.4f}" in said and f"{with_lpips[view.name]['avge']:.4f}" in said


def test_scores_are_taken_inside_masks_where_there_are_any(original, tmp_path, capsys):
    assert train(original, tmp_path / "whole") == 0
    for path in images(original):
        (tmp_path / "masks").mkdir(exist_ok=True)
        inside = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8)
        inside[4:12, 6:20] = 255
        Image.fromarray(inside).save(tmp_path / "masks" / path.name)
    capsys.readouterr()
    assert train(original, tmp_path / "inside", "--masks", str(tmp_path / "masks")) == 0
    assert "inside their masks" in capsys.readouterr().out
    whole, inside = metrics(tmp_path / "whole"), metrics(tmp_path / "inside")
    for part in ("train", "test"):
        assert inside[part]["masked"] and not whole[part]["masked"] and inside[part]["psnr"] != whole[part]["psnr"]
    kept = [load_checkpoint(tmp_path / run / "checkpoint.pt") for run in ("whole", "inside")]
    save_checkpoint(tmp_path / "again.pt", kept[1].training, kept[0].scene)  # masks are for the scores alone
    assert (tmp_path / "again.pt").read_bytes() == (tmp_path / "whole/checkpoint.pt").read_bytes()
    assert all(view.mask for view in kept[1].scene.views.values())


def test_masks_for_some_of_the_views_are_refused_before_the_training(original, tmp_path, capsys):
    (tmp_path / "masks").mkdir()
    Image.new("L", SIZE, 255).save(tmp_path / "masks" / images(original)[1].name)
    assert train(original, tmp_path / "run", "--masks", str(tmp_path / "masks")) == 2
    assert "expected a mask for each of 3 views" in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_depth_maps_must_be_there_for_every_training_view(original, tmp_path, capsys):
    (tmp_path / "depth").mkdir()
    for i, path in enumerate(images(original)):
        np.save(tmp_path / "depth" / f"{path.stem}.npy", np.arange(18 * 24).reshape(18, 24) + i)
    assert train(original, tmp_path / "run", "--depths", str(tmp_path / "depth"), "--method", "dngaussian") == 0
    chosen = load_checkpoint(tmp_path / "run/checkpoint.pt").scene.train[1]
    missing = f"{Path(chosen).stem}.npy"
    (tmp_path / "depth" / missing).unlink()
    capsys.readouterr()
    assert train(original, tmp_path / "again", "--depths", str(tmp_path / "depth"), "--method", "dngaussian") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert (
        f"got none of '{chosen}' (1 of 3 have none); save it as {missing}" in said and not (tmp_path / "again").exists()
    )


def test_a_method_that_lacks_its_depth_maps_is_refused_before_there_is_a_folder(original, tmp_path, capsys):
    assert train(original, tmp_path / "run", "--method", "fsgs") == 2
    assert "expected a depth map of every training view for the method fsgs" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_method_that_would_never_act_is_refused_before_there_is_a_folder(original, tmp_path, capsys):
    assert train(original, tmp_path / "late", "--method", "stablegs", "--set", "warm_up=1000") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "expected a training in which the method acts, got stablegs which never does in" in said
    assert "(warm_up = 1000); take more steps" in said and not (tmp_path / "late").exists()


def test_the_schedule_of_stablegs_is_scaled_to_the_length_and_said(original, tmp_path, capsys):
    assert train(original, tmp_path / "scaled", "--method", "stablegs") == 0
    said = " ".join(capsys.readouterr().err.split())
    config = load_checkpoint(tmp_path / "scaled" / "checkpoint.pt").training.config
    assert f"stablegs: its published schedule is scaled to {config.iterations} steps: warm_up 1000 to 0;" in said
    assert config.method == StableGS(warm_up=0) and config.densify == DensifySettings()


def test_a_part_of_a_method_that_a_run_does_not_reach_is_pointed_out():
    assert _not_reached(TrainConfig(3000, method=CoRGS())) == ""
    said = _not_reached(TrainConfig(500, method=CoRGS()))
    assert (
        "cor-gs: what begins after step prune_start = 500 and pseudo_start = 2000 is not reached in 500 steps" in said
    )
    assert said.endswith("or --set prune_start=250")


def test_the_start_can_be_chosen(original, tmp_path, capsys, monkeypatch):
    scene = load_scene(original)
    assert scene.points is not None
    monkeypatch.setattr("splat.training.start.triangulated_points", lambda views: scene.points)
    runs = {}
    for source in ("points", "triangulated", "random"):
        assert train(original, tmp_path / source, "--start", source) == 0
        runs[source] = len(load_checkpoint(tmp_path / source / "checkpoint.pt").training.gaussians)
        assert load_checkpoint(tmp_path / source / "checkpoint.pt").scene.start == source
    assert runs["points"] == runs["triangulated"] < runs["random"] == 10_000
    assert train(original, tmp_path / "random", "--start", "points", "--resume") == 2
    assert "start = random, got points" in capsys.readouterr().err


def test_a_run_resumes_with_the_depth_maps_that_it_was_started_with(original, tmp_path, capsys):
    for folder in ("depth", "other"):
        (tmp_path / folder).mkdir()
        for path in images(original):
            np.save(tmp_path / folder / f"{path.stem}.npy", np.arange(18 * 24).reshape(18, 24))
    assert train(original, tmp_path / "run", "--depths", str(tmp_path / "depth")) == 0
    assert train(original, tmp_path / "run", "--depths", str(tmp_path / "depth"), "--resume") == 0
    assert train(original, tmp_path / "run", "--depths", str(tmp_path / "other"), "--resume") == 2
    assert f"depths = {tmp_path / 'depth'}, got {tmp_path / 'other'}" in capsys.readouterr().err


def test_photographs_that_were_replaced_are_noticed_by_probe_and_resume(original, tmp_path, capsys):
    scene, out = tmp_path / "scene", tmp_path / "run"
    shutil.copytree(original, scene)
    assert train(scene, out) == train(scene, out, "--resume") == 0
    name = load_checkpoint(out / "checkpoint.pt").scene.train[1]
    with Image.open(scene / name) as image:
        pixels = np.array(image)
    pixels[3, 4] ^= 1
    Image.fromarray(pixels).save(scene / name)
    probe = ["probe", str(out / "checkpoint.pt"), "--quick"]
    assert train(scene, out, "--resume") == main(probe) == 2
    said = capsys.readouterr().err
    assert said.count(f"got changes in 1 of 4: '{name}': another photograph; restore them") == 2
    assert main([*probe, "--accept-changed"]) == 0
    made = read_record(out / "probe-quick").data.provenance.fingerprint
    assert made and len({view.photograph for view in made.data.values()}) == 3


def test_a_run_with_masks_of_a_folder_is_probed_and_resumed_with_these(original, tmp_path, capsys):
    (tmp_path / "masks").mkdir()
    for path in images(original):
        Image.fromarray(np.full((18, 24), 255, np.uint8)).save(tmp_path / "masks" / path.name)
    out, masks = tmp_path / "run", ["--masks", str(tmp_path / "masks")]
    assert train(original, out, *masks) == train(original, out, *masks, "--resume") == 0
    assert train(original, out, "--resume") == 2 and "masks = " in capsys.readouterr().err
    loaded = load_checkpoint(out / "checkpoint.pt")
    assert loaded.with_scene(out / "checkpoint.pt").scene.load(loaded.scene.test)[0].mask is not None
    (tmp_path / "masks" / Path(loaded.scene.test[0]).name).unlink()
    refused("no mask where there was one", loaded.with_scene, out / "checkpoint.pt")


def test_a_method_in_place_of_adam_says_what_it_leaves_out():
    assert _of_second_order(TrainConfig(method=CoRGS())) == []
    density, loss = _of_second_order(TrainConfig(method=GaussNewtonCG()))
    assert density.startswith("gn-cg: no Gaussian is cloned, split or removed") and "smooth l1" in loss
    config = TrainConfig(loss=LossSettings("l2"), densify=DensifySettings(enabled=False), method=GaussNewtonCG())
    assert _of_second_order(config) == []
    assert not config.method.density_control(TrainConfig()).enabled
