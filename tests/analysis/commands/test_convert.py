"""`landscape convert`: what is written is read back to the last bit, and our own of another's file is a checkpoint like any."""

from pathlib import Path

import numpy as np
import pytest
import torch

from analysis.commands.cli import main
from analysis.records.records import read_record
from splat.model.files.read import read_splats
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from tests.splat.model.files import written

MADE = synthetic_scene(SyntheticSettings(gaussians=60, views=5, width=24, height=16))


@pytest.fixture
def folder(tmp_path) -> Path:
    write_transforms_scene(MADE.scene, tmp_path / "scene")
    extra = {"weight": np.arange(len(MADE.truth)) / 7}
    (tmp_path / "in.ply").write_bytes(
        written.ply({**written.columns(MADE.truth), **extra}, ("trained by splat-landscape",))
    )
    return tmp_path


def convert(*words: object) -> int:
    return main(["convert", *map(str, words)])


def test_round_trips_through_every_format_are_exact(folder):
    scene = ("--scene", folder / "scene")
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
    assert loaded.scene.find(folder / "run" / "checkpoint.pt") == folder / "scene"


def test_nothing_is_overwritten_and_our_own_needs_a_scene(folder, capsys):
    assert convert(folder / "in.ply", folder / "in.ply") == 2
    assert "expected a new file" in capsys.readouterr().err
    assert convert(folder / "in.ply", folder / "own.pt") == 2
    assert "--scene" in capsys.readouterr().err and not (folder / "own.pt").exists()


def test_a_ply_is_probed_and_its_record_says_what_was_assumed(folder):
    common = [str(folder / "in.ply"), "--scene", str(folder / "scene"), "--max-views", "2"]
    quick = ["--quick", "--seconds", "inf", "--slice-points", "5"]
    assert main(["probe", *common, *quick, "--out", str(folder / "probe")]) == 0
    record = read_record(folder / "probe").data
    assert record.provenance.origin["trained_by"] == "splat-landscape" and len(record.provenance.views) == 2
    assert any("trained by splat-landscape (the file)" in note for note in record.notes)
    assert (record.counts.views, record.counts.views_of) == (2, 4)
    ends, traces = record.eigenvalues, record.traces.values()
    assert all(each.views_error > 0 for each in (record.objective, ends.max, ends.second, ends.min, *traces))
    assert ends.max.without_one[0] < ends.max.value < ends.max.without_one[1]
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
