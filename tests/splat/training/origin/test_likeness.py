"""A file that looks clearly more like its scene in another reading is refused, and that is named; a right one never is."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splat.model.files.quantised import turned
from splat.model.files.splat_ply import splat_ply
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.render.render import render
from splat.scenes.scene import load_scene
from splat.scenes.view import View
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import open_checkpoint
from splat.training.origin.frames import gsplat_frames
from splat.training.origin.options import Foreign
from tests.refusals import refused
from tests.splat.training.origin.test_frames import MADE, carried

TRUE = MADE.truth.select(torch.arange(len(MADE.truth)), 3)
TRUE.sh[:, 1:] += 0.2 * torch.randn(TRUE.sh[:, 1:].shape, generator=torch.Generator().manual_seed(0))
PLAIN = TRUE.select(torch.arange(len(TRUE)), 0)  # whose colours a turned world does not change
BACK = torch.tensor([1.0, -1.0, -1.0, -1.0])


def photographed(gaussians: Gaussians, folder: Path) -> Path:
    """A scene whose photographs are those of Gaussians."""
    frames = [
        replace(frame, picture=lambda camera, name=frame.name: View(name, camera, render(gaussians, camera).image))
        for frame in MADE.scene.frames
    ]
    write_transforms_scene(replace(MADE.scene, frames=tuple(frames)), folder)
    return folder


@pytest.fixture
def folder(tmp_path) -> Path:
    photographed(TRUE, tmp_path / "scene")
    return tmp_path


def opened(folder: Path, gaussians: Gaussians, trained_by: str = "splat-landscape", scene: str = "scene"):
    path = folder / "a.ply"
    path.write_bytes(splat_ply(gaussians))
    return open_checkpoint(path, Foreign(scene=folder / scene, trained_by=trained_by, guess_views=True), path)


def with_(**attributes: torch.Tensor) -> Gaussians:
    return Gaussians.pack(TRUE.attributes | attributes)


def by_bands(sh: torch.Tensor) -> torch.Tensor:
    """What is read of a file whose f_rest were written band by band."""
    return torch.cat([sh[:, :1], sh[:, 1:].reshape(len(sh), 3, -1).transpose(1, 2)], dim=1)


MISTAKEN = {
    "quaternions w, x, y, z, got x, y, z, w": with_(quats=TRUE.quats.roll(-1, 1)),
    "got their inverses": with_(quats=TRUE.quats * BACK),
    "axes right, down, front, got right, up, back": turned(TRUE),
    "colours red, green, blue, got blue, green, red": with_(sh=TRUE.sh.flip(-1)),
    "SH coefficients, got colours": with_(sh=torch.cat([TRUE.sh[:, :1] * Y00 + 0.5, TRUE.sh[:, 1:]], dim=1)),
    "f_rest .*, got band by band": with_(sh=by_bands(TRUE.sh)),
    "logits of opacities, got opacities": with_(opacity_logits=TRUE.opacity_logits.sigmoid()),
    "logarithms of scales, got scales": with_(log_scales=TRUE.log_scales.exp()),
}


@pytest.mark.parametrize("fault", MISTAKEN)
def test_another_writers_convention_is_refused_and_named(folder, fault):
    refused(f"expected .*{fault}.*write the file with", opened, folder, MISTAKEN[fault])


@pytest.mark.parametrize("gaussians", [TRUE, PLAIN], ids=["degree 3", "degree 0"])
def test_a_right_file_is_read_as_it_is(folder, gaussians):
    assert torch.equal(opened(folder, gaussians).training.gaussians.flat, gaussians.flat)


def test_quaternions_that_decide_nothing_are_not_refused(folder):
    """As at a training's start, whose Gaussians are round."""
    g = with_(log_scales=TRUE.log_scales.mean(dim=1, keepdim=True).expand(-1, 3), quats=TRUE.quats.roll(1, 1))
    photographed(g, folder / "round")
    assert opened(folder, g, scene="round").origin


BIG = np.eye(3, 4) * 1000.0  # the world of nerfstudio's file


@pytest.mark.parametrize(
    ("trained_by", "right"), [("graphdeco", "gsplat"), ("gsplat", "gsplat-raw"), ("graphdeco", "nerfstudio")]
)
def test_the_world_of_another_preset_is_named(folder, trained_by, right):
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(3, 4).tolist(), "scale": 1000}))
    worlds = {"gsplat": gsplat_frames(load_scene(folder / "scene"))[2], "gsplat-raw": np.eye(3, 4), "nerfstudio": BIG}
    g = carried(PLAIN, worlds[right])
    refused(f"got that of {right}: .*take --trained-by {right}$", opened, folder, g, trained_by)
    assert opened(folder, g, right).origin


def test_scales_that_cannot_be_drawn_as_logarithms_are_named_too(folder):
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(3, 4).tolist(), "scale": 1000}))
    g = carried(PLAIN, BIG)
    g.log_scales.exp_()
    refused("got scales: .* against no picture on small", opened, folder, g, "nerfstudio")
