"""`landscape map`: its files hold the fields of every Gaussian, and its pictures the same over the training views."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from msgspec import structs
from PIL import Image

from analysis.commands.cli import main
from analysis.commands.map.pictures import composited
from analysis.records.quantities import Shade
from analysis.records.run_files import read_map
from figures.maps import show_scaled
from splat.curvature.fields import FIELDS, scene_fields
from splat.curvature.objective import SceneObjective
from splat.model.files.read import read_splats
from splat.model.files.splat_ply import splat_ply
from splat.model.harmonics import Y00
from splat.scenes.scene import load_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from tests.splat.held_scenes import two_views
from tests.splat.random_scenes import random_gaussians
from tests.splat.render.test_sight import weights

MADE = synthetic_scene(SyntheticSettings(gaussians=80, views=4, width=24, height=16))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Gaussians with the scene that they were trained on, and their map."""
    folder = tmp_path_factory.mktemp("mapped")
    write_transforms_scene(MADE.scene, folder / "scene")
    unseen = MADE.truth.select(torch.tensor([*range(len(MADE.truth)), 0]))
    unseen.means[-1] = torch.tensor([0.0, 0.0, -50.0])
    (folder / "in.ply").write_bytes(splat_ply(unseen, tool="splat-landscape"))
    assert mapped(folder, "--draw", "0", "--draw", "view_003.png") == 0
    return folder


def read_table(path: Path) -> dict[str, np.ndarray]:
    names, *rows = csv.reader(path.open())
    return dict(zip(names, np.array(rows, float).T, strict=True))


def mapped(folder: Path, *words: str) -> int:
    return main(["map", str(folder / "in.ply"), "--scene", str(folder / "scene"), "--views", "all", *words])


def test_the_files_hold_every_field_of_every_gaussian(folder):
    written = read_splats(folder / "map" / "fields.ply")
    assert torch.equal(written.gaussians.flat, read_splats(folder / "in.ply").gaussians.flat)
    assert [*written.extra] == [*FIELDS]
    views = load_scene(folder / "scene").load([f"images/view_00{i}.png" for i in (1, 2, 3)])
    objective = SceneObjective(MADE.truth, views)
    fields, _ = scene_fields(objective)
    for name, column in fields.items():
        found = written.extra[name]
        assert np.isnan(found[-1]), name
        assert found[:-1][objective.mask.numpy()] == pytest.approx(column.numpy(), rel=1e-4, abs=1e-30), name
    top, largest = read_table(folder / "map" / "top.csv"), written.extra["largest"]
    first = int(np.nanargmax(largest))
    assert top["gaussian"][0] == first and np.all(np.diff(top["largest"]) <= 0)
    assert top["sigma_0"][0] == pytest.approx(written.gaussians.log_scales[first].exp().max().item(), rel=1e-5)


def test_a_splat_has_the_colour_of_its_value_and_none_is_grey(folder):
    shade = read_map(folder / "map").shades["largest"]
    written = read_splats(folder / "map" / "largest.ply").gaussians
    values = read_splats(folder / "map" / "fields.ply").extra["largest"]
    assert written.sh_degree == 0 and written.sh[-1].abs().max() < 0.01
    assert np.allclose(0.5 + Y00 * written.sh[:, 0].numpy(), shade.colours_of(values), atol=1e-6)


def test_pictures_are_drawn_of_the_views_that_were_asked_for(folder):
    record = read_map(folder / "map")
    assert [panel.file for panel in record.panels] == ["view-000", "view-002"] and not record.notes[3:]
    for panel in record.panels:
        with np.load(folder / "map" / f"{panel.file}.npz") as maps:
            assert maps["photograph"].shape == (16, 24, 3) and maps["largest"].shape == maps["error"].shape == (16, 24)
        assert Image.open(folder / "map" / f"{panel.file}.png").width > 800


def test_a_run_folder_is_mapped_like_the_file_it_was_made_of(folder, capsys):
    run = str(folder / "run" / "checkpoint.pt")
    words = [str(folder / "in.ply"), run, "--scene", str(folder / "scene"), "--views", "all"]
    assert main(["convert", *words]) == 0 and main(["map", str(folder / "run"), "--draw", "0"]) == 0
    said = capsys.readouterr().out  # every file by its name or its pattern, once
    assert "pictures: fragility-NNN.png, view-NNN.png; splats" in said
    assert "of each Gaussian by itself, largest curv" in said
    found, before = (read_map(path / "map") for path in (folder / "run", folder))
    assert (found.fragility, found.shades, found.sentences) == (before.fragility, before.shades, before.sentences)


def test_a_field_is_composited_with_the_weights_of_the_splats():
    gaussians = random_gaussians(30, seed=2, logit=0.0, spread=0.6)
    objective = SceneObjective(gaussians, two_views())
    shares = torch.linspace(0, 1, 5 * len(objective.active), dtype=torch.float64).view(5, -1)
    shares[0, ::5], shares[3, 1::2] = torch.nan, torch.nan
    camera = objective.views[0].camera
    w, _ = weights(objective.active, camera, objective.settings)
    fields = torch.from_numpy(composited(objective, camera, shares.T))
    for share, found in zip(shares, fields, strict=True):
        known = share.isfinite()
        total = w[known].sum(dim=0)
        mean = (w[known] * share[known, None, None]).sum(dim=0) / total
        assert torch.equal(found.isnan(), total <= 0.02) and not found.isnan().all()
        assert torch.allclose(found[~found.isnan()], mean[~found.isnan()], atol=1e-10)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--field", "larges"], "did you mean largest?"),
        (["--field", "e1"], "run landscape probe first"),
        (["--draw", "7"], "0 to 2 or a name"),
    ],
    ids=str,
)
def test_what_cannot_be_drawn_is_refused_and_nothing_is_written(folder, words, said, capsys):
    assert mapped(folder, *words, "--out", str(folder / "other")) == 2
    assert said in capsys.readouterr().err and not (folder / "other").exists()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_scale_with_both_signs_has_0_in_its_middle(sign):
    values = sign * np.array([-1e-3, -1e-4, 0.0, 1e-4, 20.0])
    shade = Shade.of("x", "", "", "signed", values, np.ones(5), (0.0, 100.0))
    assert shade.diverges and shade.share(np.array(0.0)) == 0.5
    assert float(shade.share(values)[4]) == (1 + sign) / 2
    bar = show_scaled(Figure().subplots(), np.zeros((4, 6), np.uint8), shade, "", "")
    low, high = bar.ax.get_xlim()
    ticks = [tick for tick in bar.get_ticks() if low <= tick <= high]
    assert low == -high and 0.0 in ticks and len(ticks) > 2 and np.isfinite(ticks).all()


def test_the_distance_to_a_swap_is_drawn_from_far_to_near_and_bright():
    shade = Shade(name="order_gap", words="", unit="px", scale="log", low=-1.0, high=1.0)
    axes = Figure().subplots()
    bar = show_scaled(axes, np.zeros((4, 6), np.uint8), shade, "", "")
    assert bar.ax.get_xlim() == pytest.approx((10.0, 0.1))
    near, far = (np.array(bar.cmap(bar.norm(value))[:3]) for value in (0.1, 10.0))
    first = np.asarray(axes.images[0].get_array())[0, 0] / 255
    assert far.sum() < near.sum() and near == pytest.approx(first, abs=1 / 255)
    assert "to left" in shade.legend and shade.legend.index("≥ 10<") < shade.legend.index("≤ 0.10<")  # others beyond
    assert not set("≥≤") & set(structs.replace(shade, name="one_view").legend)


def test_the_share_in_one_view_has_the_scale_of_what_its_title_says(folder):
    shade = read_map(folder / "map").shades["one_view"]
    assert (shade.low, shade.high) == (1 / 3, 1.0)
