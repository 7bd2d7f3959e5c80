"""Recognising a scene's format, and what a scene knows of its cameras."""

import shutil
from math import cos, pi, sin
from pathlib import Path

import pytest
import torch

from splat.model.camera import Camera, forward_facing
from splat.scenes.scene import Scene, camera_extent, load_scene
from splat.scenes.view import Frame, View
from tests.refusals import refused
from tests.splat.scenes import folders
from tests.splat.scenes.folders import NAMES


def scene_of(cameras: list[Camera]) -> Scene:
    pictures = [View(f"{i}", camera, torch.zeros(3, 2, 2)) for i, camera in enumerate(cameras)]
    frames = tuple(Frame(view.name, view.camera, lambda camera, view=view: view) for view in pictures)
    return Scene("s", Path("s"), "synthetic", frames, None, torch.zeros(3))


def camera_turned(degrees: float, centre: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    """Looks along +z, turned about the vertical axis."""
    c, s = cos(degrees * pi / 180), sin(degrees * pi / 180)
    rotation = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
    return Camera(rotation, torch.tensor(centre, dtype=torch.float64), 10.0, 10.0, 1.0, 1.0, 2, 2)


def test_a_colmap_model_wins_over_poses_bounds_and_those_over_transforms(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    assert load_scene(tmp_path).kind == "transforms"
    folders.write_llff(tmp_path)
    assert load_scene(tmp_path).kind == "llff"
    folders.write_colmap(tmp_path)
    assert load_scene(tmp_path).kind == "colmap"


def test_a_folder_without_poses_is_refused_with_what_was_looked_for(tmp_path: Path) -> None:
    folders.write_pictures(tmp_path / "images")
    with pytest.raises(FileNotFoundError, match=r"looked for a COLMAP model .* poses_bounds.npy.*; found images;"):
        load_scene(tmp_path)
    (tmp_path / "empty").mkdir()
    refused("found an empty folder", load_scene, tmp_path / "empty", error=FileNotFoundError)


def test_a_missing_folder_and_a_file_are_refused(tmp_path: Path) -> None:
    refused("none does not exist", load_scene, tmp_path / "none", error=FileNotFoundError)
    (tmp_path / "file").write_text("")
    refused("is not a folder", load_scene, tmp_path / "file", error=FileNotFoundError)


def test_missing_images_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path)
    for name in NAMES[1:]:
        (tmp_path / "images" / name).unlink()
    with pytest.raises(FileNotFoundError, match=r"expected 3 image files, 2 are missing, the first is .*b\.png"):
        load_scene(tmp_path)
    shutil.rmtree(tmp_path / "images")
    refused("found neither", load_scene, tmp_path, error=FileNotFoundError)


@pytest.mark.parametrize("downscale", [0.5, 0, float("nan"), float("inf")])
def test_a_downscale_that_does_not_reduce_is_refused(tmp_path: Path, downscale: float) -> None:
    folders.write_colmap(tmp_path)
    refused("downscale of at least 1", load_scene, tmp_path, downscale=downscale)


@pytest.mark.parametrize("background", [(1, 1), (0, 0, 2), (0, float("nan"), 0)])
def test_a_background_that_is_no_colour_is_refused(tmp_path: Path, background: tuple[float, ...]) -> None:
    folders.write_colmap(tmp_path)
    refused(r"three numbers in \[0, 1\]", load_scene, tmp_path, background=background)


def test_an_image_folder_for_a_blender_scene_is_refused(tmp_path: Path) -> None:
    folders.write_blender(tmp_path, (2,), (0,))
    refused("expected no image folder", load_scene, tmp_path, images="train")


def test_only_the_pictures_asked_for_are_read(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path)
    scene = load_scene(tmp_path)
    (tmp_path / "images/b.png").unlink()
    assert [view.name for view in scene.load(["c.png", "a.png"])] == ["c.png", "a.png"]
    refused(r"cannot read .*b\.png", scene.load)


def test_an_unknown_name_is_refused(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path)
    with pytest.raises(ValueError, match=r"got 'z.png' \(1 unknown\); the scene has 3 images from 'a.png' to 'c.png'"):
        load_scene(tmp_path).load(["a.png", "z.png"])


def test_the_extent_is_that_of_3dgs() -> None:
    cameras = [camera_turned(0, centre) for centre in ((0, 0, 0), (4, 0, 0), (0, 0, 2), (0, 2, 0))]
    # mean (1, 0.5, 0.5), farthest (4, 0, 0): sqrt(9 + 0.25 + 0.25)
    assert camera_extent(cameras) == pytest.approx(1.1 * 9.5**0.5, rel=1e-15)
    assert scene_of(cameras).extent(["0", "1"]) == pytest.approx(2.2, rel=1e-15)


def test_cameras_at_one_place_have_no_extent() -> None:
    refused("at least two views from different places", camera_extent, [camera_turned(0), camera_turned(20)])


def test_forward_facing_means_within_45_degrees_of_the_mean_direction() -> None:
    for angles, forward in (((0,), True), ((-44, 0, 44), True), ((-46, 0, 46), False), ((0, 180), False)):
        assert forward_facing([camera_turned(angle) for angle in angles]) is forward


def test_the_real_scenes_face_forward_and_all_round(fern: Path, lego: Path) -> None:
    both = [forward_facing([frame.camera for frame in load_scene(folder).frames]) for folder in (fern, lego)]
    assert both == [True, False]
