"""`landscape convert`: what is written is read back to the last bit, and our own of another's file is a checkpoint like any."""

import shlex
from pathlib import Path

import numpy as np
import pytest
import torch

from analysis.commands.cli import main
from analysis.records.records import read_record
from splat.model.files.read import read_splats
from splat.model.files.splat_ply import splat_ply
from splat.model.settings import RenderSettings
from splat.render.render import render as rendered
from splat.render.render import render_depth
from splat.scenes.scene import load_scene
from splat.scenes.splits import split_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.origin.subject import SceneReference
from splat.training.state import TrainConfig, Training
from tests.splat.model.files import written

MADE = synthetic_scene(SyntheticSettings(gaussians=60, views=5, width=24, height=16))


@pytest.fixture
def folder(tmp_path) -> Path:
    write_transforms_scene(MADE.scene, tmp_path / "scene")
    columns = {**written.columns(MADE.truth), "weight": np.arange(len(MADE.truth)) / 7}
    (tmp_path / "in.ply").write_bytes(written.ply(columns, ("trained by splat-landscape",)))
    return tmp_path


def convert(*words: object) -> int:
    return main(["convert", *map(str, words)])


def test_round_trips_through_every_format_are_exact(folder):
    scene = ("--scene", folder / "scene", "--guess-views")
    assert convert(folder / "in.ply", folder / "a.pt", "--to", "gsplat") == 0
    assert convert(folder / "a.pt", folder / "b.ply") == 0
    assert read_splats(folder / "b.ply").extra["weight"].tolist() == (np.arange(60) / 7).astype(np.float32).tolist()
    assert convert(folder / "b.ply", folder / "run" / "checkpoint.pt", *scene) == 0
    assert convert(folder / "run" / "checkpoint.pt", folder / "c.ply") == 0
    for name in ("a.pt", "b.ply", "c.ply"):
        found = read_splats(folder / name)
        assert torch.equal(found.gaussians.flat, MADE.truth.flat) and found.tool == "splat-landscape", name
    loaded = load_checkpoint(folder / "run" / "checkpoint.pt")
    assert torch.equal(loaded.training.gaussians.flat, MADE.truth.flat)
    assert [*read_splats(folder / "c.ply").train] == loaded.scene.train != []
    assert loaded.scene.find(folder / "run" / "checkpoint.pt") == folder / "scene"


def test_nothing_is_overwritten_and_our_own_needs_a_scene(folder, capsys):
    assert convert(folder / "in.ply", folder / "in.ply") == 2
    assert "expected a new file" in capsys.readouterr().err
    assert convert(folder / "in.ply", folder / "own.pt") == 2
    assert "--scene" in capsys.readouterr().err and not (folder / "own.pt").exists()


def test_a_ply_is_probed_and_its_record_says_what_was_assumed(folder, capsys):
    common = [str(folder / "in.ply"), "--scene", str(folder / "scene"), "--guess-views", "--max-views", "2"]
    quick = ["--quick", "--slice-points", "5"]
    assert main(["probe", *common, *quick, "--out", str(folder / "probe")]) == 0
    assert f"landscape map {shlex.join(common)}\n" in capsys.readouterr().out  # whole
    record = read_record(folder / "probe").data
    assert record.provenance.origin.trained_by == "splat-landscape" and len(record.provenance.views) == 2
    assert any("trained by splat-landscape (the file)" in note for note in record.notes)
    assert (record.counts.views, record.counts.views_of) == (2, 4)
    ends, traces = record.eigenvalues, record.traces.values()
    assert all(each.views_error > 0 for each in (record.objective, ends.max, ends.second, ends.min, *traces))
    assert any("2 of 4 training views" in note for note in record.notes)


def test_a_training_starts_from_another_tools_gaussians_with_its_renderer(folder):
    out, source = folder / "run", folder / "in.ply"
    common = [
        "train",
        str(folder / "scene"),
        "--from",
        str(source),
        "--no-densify",
        "--iterations",
        "2",
        "--views",
        "2",
    ]
    assert main([*common, "--trained-by", "gsplat-raw", "--out", str(out)]) == 0
    training = load_checkpoint(out / "checkpoint.pt").training
    assert (training.config.render.alpha_max, training.config.loss.border, training.step) == (0.999, "valid", 2)
    assert len(training.gaussians) == len(MADE.truth)
    moved = (training.gaussians.means - MADE.truth.means).abs().max()
    assert 0 < moved < 0.01 * training.extent
    assert main([*common, "--set", "render.near=0.1", "--out", str(folder / "other")]) == 2


@pytest.mark.parametrize(("shares", "grows"), [([], False), (["start_share=0.25", "every_share=0.05"], True)])
def test_a_short_training_of_trained_gaussians_adds_none_unless_asked_to(folder, shares, grows, capsys):
    changes = [word for change in ("gradient_threshold=1e-9", *shares) for word in ("--set", f"densify.{change}")]
    common = ["train", str(folder / "scene"), "--from", str(folder / "in.ply"), "--iterations", "40", "--views", "2"]
    assert main([*common, *changes, "--out", str(folder / "short")]) == 0
    count = len(load_checkpoint(folder / "short" / "checkpoint.pt").training.gaussians)
    assert (count > len(MADE.truth)) == grows and count >= 0.9 * len(MADE.truth)
    assert "schedule is scaled" not in capsys.readouterr().err  # 3DGS has none of a length of its own


SAID = "the file cannot say how it was rendered"
RENDERS = {
    "none": (RenderSettings(), []),
    "mip": (RenderSettings(antialias="mip"), []),
    "mip-splatting": (RenderSettings(antialias="mip-splatting", blur=0.1), []),
    "brush": (RenderSettings(antialias="mip-plain", blur=0.1, alpha_max=0.999), ["--trained-by", "brush"]),
    "none's": (RenderSettings(antialias="mip-plain", blur=0.2), None),
}


@pytest.mark.parametrize("to", ["graphdeco", "gsplat"])
@pytest.mark.parametrize("name", RENDERS)
def test_a_checkpoint_that_was_written_and_read_back_is_the_same_scene(folder, capsys, name, to):
    render, words = RENDERS[name]
    loaded = load_scene(folder / "scene")
    split = split_scene(loaded)
    training = Training.start(MADE.truth, loaded.extent(split.train), TrainConfig(render=render))
    if name == "mip-splatting":
        training.gaussians = training.gaussians.with_filter(torch.linspace(0.01, 0.1, len(MADE.truth)))
    save_checkpoint(folder / "own.pt", training, SceneReference.to(loaded, folder / "own.pt", split, None, 1.0))
    assert convert(folder / "own.pt", folder / "out", "--to", to) == 0
    said = " ".join(capsys.readouterr().err.split())
    if words is None:
        assert "no --trained-by renders as it was (antialiasing mip-plain, blur 0.2" in said
        return
    assert " ".join(words) in said and (SAID in said) == bool(words)
    assert convert(folder / "out", folder / "back.pt", "--scene", folder / "scene", *words) == 0
    before, after = (load_checkpoint(folder / file) for file in ("own.pt", "back.pt"))
    assert after.training.config.render == render and not after.scene.centred
    images = [
        rendered(each.training.gaussians, loaded.frames[0].camera, settings=each.training.config.render).image
        for each in (before, after)
    ]
    torch.testing.assert_close(*images, rtol=0, atol=0 if to == "graphdeco" else 1e-6)
    if name == "mip-splatting" and to == "graphdeco":
        assert b"property float rot_3\nproperty float filter_3D\nend_header" in (folder / "out").read_bytes()


def test_what_a_file_says_of_its_renderer_goes_with_it(folder, capsys):
    brush = written.ply(written.columns(MADE.truth), ("Exported from Brush", "SplatRenderMode: mip"))
    (folder / "brush.ply").write_bytes(brush)
    assert convert(folder / "brush.ply", folder / "other.ply") == 0 and SAID not in capsys.readouterr().err
    found = read_splats(folder / "other.ply")
    assert (found.tool, found.antialiased) == ("brush", True)
    model = folder / "model/point_cloud/iteration_9"
    model.mkdir(parents=True)
    (model / "point_cloud.ply").write_bytes(splat_ply(MADE.truth.with_filter(torch.full((60,), 0.05))))
    (folder / "model/cfg_args").write_text("Namespace(kernel_size=0.3, resolution=-1)")
    assert convert(model / "point_cloud.ply", folder / "m.ply") == 0
    assert b"px wide" not in (folder / "m.ply").read_bytes()  # -1 is graphdeco's word for its default
    said = " ".join(capsys.readouterr().err.split())
    assert "no --trained-by renders as it was (antialiasing mip-splatting, blur 0.3" in said


@pytest.mark.parametrize("to", ["graphdeco", "gsplat"])
def test_a_file_of_ours_is_read_with_pictures_of_the_size_that_it_was_trained_on(folder, to):
    small = load_scene(folder / "scene", downscale=2)
    split = split_scene(small)
    training = Training.start(MADE.truth, small.extent(split.train), TrainConfig())
    save_checkpoint(folder / "own.pt", training, SceneReference.to(small, folder / "own.pt", split, None, 2.0))
    assert convert(folder / "own.pt", folder / "one", "--to", to) == 0
    assert convert(folder / "one", folder / "other.ply") == 0
    for name in ("one", "other.ply"):
        assert convert(folder / name, folder / f"{name}.pt", "--scene", folder / "scene") == 0
        assert set(load_checkpoint(folder / f"{name}.pt").scene.sizes) == {(12, 8)}


def test_own_depths_are_read_by_the_training_that_is_suggested(folder, tmp_path, capsys):
    train = ["train", str(folder / "scene"), "--iterations", "1", "--out"]
    assert main([*train, str(tmp_path / "run"), "--downscale", "3.6"]) == 0  # 24 x 16 px become 7 x 4
    assert convert(tmp_path / "run/checkpoint.pt", tmp_path / "depths", "--to", "depths") == 0
    words = capsys.readouterr().err.split("landscape ")[-1]
    assert "--downscale 3.6" in words
    assert main([*shlex.split(words), "--iterations", "400", "--out", str(tmp_path / "again")]) == 0
    one, other = (load_checkpoint(tmp_path / name / "checkpoint.pt").scene for name in ("run", "again"))
    assert one.train == other.train and one.sizes == other.sizes == [(7, 4)] * len(one.train)


def test_depths_of_every_view_are_those_of_its_pixels_and_train_reads_them(folder):
    said = ("--scene", folder / "scene", "--guess-views")
    assert convert(folder / "in.ply", folder / "depths", "--to", "depths", *said) == 0
    loaded = load_scene(folder / "scene", depths=folder / "depths").load()
    for view, truth in zip(loaded, MADE.scene.load(), strict=True):
        depth, alpha = render_depth(MADE.truth, truth.camera)
        assert view.depth is not None and (alpha > 0.5).any()
        assert torch.allclose(view.depth.squeeze()[alpha > 0.5], (depth / alpha)[alpha > 0.5], rtol=1e-5)
        assert (view.depth.squeeze()[alpha < 0.01] == view.depth.max()).all()
