"""transforms*.json: written by hand, and the real lego."""

import json
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from landscape.errors import InputError
from splat.scenes.formats.transforms import read_points
from splat.scenes.scene import load_scene
from splat.scenes.splits import Split, split_scene, usual_views
from splat.scenes.view import pixel_coordinates
from tests.refusals import refused
from tests.splat.scenes import folders
from tests.splat.scenes.folders import CENTRE, FOCAL, NAMES, SIZE, intrinsics, poses, require_poses, rewrite


def test_transforms_cameras_come_back_sorted_by_name(tmp_path: Path) -> None:
    rewrite(tmp_path, lambda content: content["frames"].reverse())
    scene = load_scene(tmp_path)
    assert scene.kind == "transforms" and scene.names == tuple(f"images/{name}" for name in NAMES)
    require_poses(scene)
    assert intrinsics(scene) == [(*FOCAL, *CENTRE, *SIZE)] * 3
    assert scene.background.tolist() == [0, 0, 0] and scene.load()[0].alpha is None


@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path"])
@pytest.mark.parametrize("up", ["..", "images/../..", "absolute"])
def test_names_that_lead_out_of_the_scenes_folder_are_refused(tmp_path: Path, key: str, up: str) -> None:
    scene = tmp_path / "scene"
    folders.write_transforms(scene)
    (scene / "images" / NAMES[0]).rename(tmp_path / NAMES[0])
    name = str(tmp_path / NAMES[0]) if up == "absolute" else f"{up}/{NAMES[0]}"
    content = json.loads((scene / "transforms.json").read_text())
    (content if key == "ply_file_path" else content["frames"][1])[key] = name
    (scene / "transforms.json").write_text(json.dumps(content))
    refused("which leads out of it", load_scene, scene)
    if key == "file_path":
        (scene / "images" / "b").symlink_to(tmp_path / NAMES[0])  # which whoever unpacked the scene has made
        content["frames"][1][key] = "images/b"
        (scene / "transforms.json").write_text(json.dumps(content))
        assert load_scene(scene).names == ("images/b", f"images/{NAMES[2]}")


def test_intrinsics_of_a_frame_win_over_those_at_the_top(tmp_path: Path) -> None:
    rewrite(tmp_path, lambda content: content["frames"][1].update(fl_x=99.0, cy=3.0))
    cameras = [frame.camera for frame in load_scene(tmp_path).frames]
    assert [camera.fx for camera in cameras] == [FOCAL[0], 99.0, FOCAL[0]]
    assert [camera.cy for camera in cameras] == [CENTRE[1], 3.0, CENTRE[1]]


A, Z, NUMBER, LIST = "images/a.png", "images/z.png", "expected a finite number, got", "expected a list of file paths"
ANGLE = "expected camera_angle_x above 0 and below pi, got"
SMALL = "'images/a.png' cannot be: expected at least 1 px a side"
FAR = [[1, 0, 0, 10**400], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRROR, TWICE = (np.diag([scale, abs(scale), abs(scale), 1.0]).tolist() for scale in (-1.0, 2.0))
SHEARED = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
ROTATION = "image 'images/a.png' cannot be: expected a rotation matrix, got one that"


@pytest.mark.parametrize(
    ("change", "message"),  # change: of keys at the top, or of frames by their number; ... takes a key away
    [
        ({"fl_x": ...}, "expected fl_x or camera_angle_x"),
        ({"fl_x": ..., "camera_angle_x": 0}, f"{ANGLE} 0.0"),
        ({"fl_x": ..., "camera_angle_x": 5e-324}, f"{ANGLE} 5e-324"),
        ({"fl_y": ..., "camera_angle_y": 4.0}, r"camera_angle_y above 0 and below pi, got 4\.0"),
        ({"fl_x": None}, f"{NUMBER} fl_x = None for 'images/a.png'"),
        ({"fl_x": True}, f"{NUMBER} fl_x = True"),
        ({"cx": nan}, f"{NUMBER} cx = nan"),
        ({"w": inf}, f"{NUMBER} w = inf"),
        ({"h": 10**400}, f"{NUMBER} h = inf"),
        ({"fl_x": -3.0}, "camera of image 'images/a.png' cannot be: expected positive focal lengths"),
        ({"w": 0}, SMALL),
        ({"h": -18}, SMALL),
        ({"w": 1e30}, "'images/a.png' cannot be: .* got 1e\\+30 x 18 px"),
        ({"background": "white"}, "three numbers in"),
        ({"background": 1}, "three numbers in"),
        ({"ply_file_path": "none.ply"}, "cannot read .*none.ply"),
        ({"ply_file_path": 5}, "expected the name of a file, got ply_file_path = 5"),
        ({"frames": []}, "non-empty list 'frames'"),
        ({1: {"mask_path": ["a.png"]}}, "expected the name of a file, got mask_path"),
        ({1: {"file_path": A}}, "'images/a.png' more than once"),
        (
            {i: {"file_path": f"{i}.png"} for i in range(3)},
            "3 image files, 3 are missing, the first is .*0.png.*--images",
        ),
        ({1: {"transform_matrix": ...}}, "in frame 1"),
        ({1: {"transform_matrix": [[1, 2], [3, 4]]}}, "4 x 4 transform_matrix for 'images/b.png'"),
        ({2: {"transform_matrix": FAR}}, "finite 4 x 4 transform_matrix"),
        ({0: {"transform_matrix": MIRROR}}, f"{ROTATION} mirrors: its axes are left-handed"),
        ({0: {"transform_matrix": TWICE}}, f"{ROTATION} scales by 2, has"),
        ({0: {"transform_matrix": SHEARED}}, rf"{ROTATION} has \|R R\^T - 1\| = 1\.0e-01"),
        (
            {"camera_model": "EQUIRECTANGULAR"},
            "camera_model EQUIRECTANGULAR for 'images/a.png' in .*undistort the photog",
        ),
        ({"k1": 0.1, "k4": 0.2}, "got k4 for 'images/a.png' in .*undistort the photographs"),
        ({2: {"camera_model": "OPENCV", "k4": 0.01}}, "got k4 for 'images/c.png'"),
        ({2: {"camera_model": "OPENCV_FISHEYE", "p1": 0.01}}, "got p1 for 'images/c.png'"),
        ({2: {"camera_model": "OPENCV_FISHEYE", "k5": 0.01}}, "got k5 for 'images/c.png'"),
        ({"train_filenames": [Z], "test_filenames": [A]}, "got 'images/z.png'"),
        ({"train_filenames": [A], "test_filenames": [A]}, "which is in train_filenames too"),
        ({"test_filenames": [A]}, "got train_filenames = None"),
        ({"train_filenames": A}, LIST),
        ({"train_filenames": [A], "test_filenames": [1]}, LIST),
    ],
)
def test_bad_transforms_are_refused_in_one_sentence(tmp_path: Path, change: dict, message: str) -> None:
    def damage(content: dict[str, Any]) -> None:
        for key, value in change.items():
            place, values = (content["frames"][key], value) if isinstance(key, int) else (content, {key: value})
            place.update(values)
            for each in [each for each in values if values[each] is ...]:
                del place[each]

    rewrite(tmp_path, damage)
    error = FileNotFoundError if "missing" in message else InputError
    refused(message, load_scene, tmp_path, error=error)


def test_frames_without_an_image_are_skipped_and_counted(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path, ply_file_path="points.ply")
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    lists = "property list uchar int views\nend_header\n0 0 0 2 0 1\n1 1 1 2 1 2\n"  # of the frames that are listed
    (tmp_path / "points.ply").write_text(header + lists)
    (tmp_path / "images" / NAMES[0]).unlink()
    scene = load_scene(tmp_path)
    assert scene.names == tuple(f"images/{name}" for name in NAMES[1:])
    (note,) = scene.notes
    assert note.startswith("1 of 3 frames that the scene lists were skipped") and note.endswith("first is images/a.png")
    assert scene.points is not None and scene.points.sightings(scene.frames).tolist() == [1, 2]


def test_a_blender_scene_skips_frames_of_both_files(tmp_path: Path) -> None:
    folders.write_blender(tmp_path, train=(2, 26), test=(0, 8))
    for name in ("train/r_2.png", "test/r_8.png"):
        (tmp_path / name).unlink()
    scene = load_scene(tmp_path)
    assert scene.names == ("train/r_26", "test/r_0")
    assert [note[:6] for note in scene.notes] == ["2 of 4"] and scene.notes[0].endswith("the first is train/r_2")
    (tmp_path / "test/r_0.png").unlink()
    words = "2 image files, 2 are missing, the first is .*transforms_test.json says"
    refused(words, load_scene, tmp_path, error=FileNotFoundError)


@pytest.mark.parametrize("text", ["{", 100_000 * "["])
def test_a_transforms_file_that_is_no_json_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    refused("expected a JSON file with frames", load_scene, tmp_path)


@pytest.mark.parametrize("key", ["ply_file_path", "mask_path"])
def test_null_names_no_file(tmp_path: Path, key: str) -> None:
    rewrite(tmp_path, lambda content: (content.update({key: None}), content["frames"][0].update({key: None})))
    assert load_scene(tmp_path).names == tuple(f"images/{name}" for name in folders.NAMES)


@pytest.mark.parametrize(
    "header", [f"element vertex {10**12}\nproperty float x", "element vertex 1\nproperty int views"]
)
def test_points_that_promise_what_cannot_be_are_refused(tmp_path: Path, header: str) -> None:
    coordinates = "".join(f"property float {axis}\n" for axis in "xyz" if f"float {axis}" not in header)
    (tmp_path / "p.ply").write_text(f"ply\nformat ascii 1.0\n{header}\n{coordinates}end_header\n0 0 0 0\n")
    refused("expected a PLY file of points, cannot read", read_points, tmp_path / "p.ply", ("a",))


def test_blender_cameras_have_the_focal_length_of_their_angle_of_view(tmp_path: Path) -> None:
    folders.write_blender(tmp_path, (2, 16, 26), (0, 8, 16))
    scene = load_scene(tmp_path)
    assert scene.kind == "blender"
    assert scene.names == ("train/r_2", "train/r_16", "train/r_26", "test/r_0", "test/r_8", "test/r_16")
    assert [frame.subset for frame in scene.frames] == ["train"] * 3 + ["test"] * 3
    camera = scene.frames[0].camera
    assert 2 * np.arctan(camera.width / 2 / camera.fx) == pytest.approx(0.7, abs=folders.ROUND_OFF)
    assert (camera.fy, camera.cx, camera.cy) == (camera.fx, SIZE[0] / 2, SIZE[1] / 2)
    np.testing.assert_allclose(camera.rotation.numpy(), poses()[0].world_to_camera, atol=folders.ROUND_OFF)


def test_lego_stands_where_all_its_cameras_look(lego: Path) -> None:
    scene = load_scene(lego, downscale=8)
    assert scene.kind == "blender" and scene.background.tolist() == [1, 1, 1]
    views = scene.load(scene.names[::5])
    for view in views:
        pixel, depth = pixel_coordinates(view.camera, torch.zeros(1, 3, dtype=torch.float64))
        assert view.alpha is not None and depth > 0
        assert (pixel[0] - torch.tensor([50.0, 50.0])).abs().max() < 5
        corner = view.image[:, 0, 0]
        assert view.alpha[0, 0] == 0 and corner.tolist() == [1, 1, 1]
    assert all(view.alpha[45:55, 45:55].mean() > 0.3 for view in views if view.alpha is not None)


def test_both_angles_of_view_give_their_focal_lengths(tmp_path: Path) -> None:
    def angles(content: dict[str, Any]) -> None:
        for key, side in zip("xy", SIZE):
            content[f"camera_angle_{key}"] = 2 * np.arctan(side / 2 / content.pop(f"fl_{key}"))

    rewrite(tmp_path / "s", angles)
    camera = load_scene(tmp_path / "s").frames[0].camera
    assert (camera.fx, camera.fy) == pytest.approx(FOCAL, rel=folders.ROUND_OFF)
    rewrite(tmp_path / "wide", lambda content: (content.pop("fl_y"), content.update(camera_angle_y=4.0)))
    refused(r"camera_angle_y above 0 and below pi, got 4\.0", load_scene, tmp_path / "wide")


def test_a_key_that_is_not_used_is_said_and_others_are_not(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path / "plain", applied_scale=1.0, k1=0.0)
    assert load_scene(tmp_path / "plain").notes == ()

    def keys(content: dict[str, Any]) -> None:
        content.update(orientation_override="none", aabb_scale=16)
        content["frames"][1].update(depth_file_path="depth/b.png", sharpness=9.5, colmap_im_id=2)

    rewrite(tmp_path / "s", keys)
    said = "transforms.json says aabb_scale, depth_file_path, orientation_override, which are not used"
    assert load_scene(tmp_path / "s").notes == (said,)


def test_the_split_of_a_file_is_taken_whole_or_in_part(tmp_path: Path) -> None:
    a, b, c = (f"images/{name}" for name in NAMES)
    lists = {"train_filenames": [c, f"./{a}"], "val_filenames": [b.replace("/", "\\")]}
    rewrite(tmp_path / "s", lambda content: content.update(lists))
    scene = load_scene(tmp_path / "s")
    assert split_scene(scene) == Split((a, c), (b,), "named") and usual_views(scene) == 2 and scene.notes == ()
    assert split_scene(scene, 1).train == (a,)
    rewrite(tmp_path / "part", lambda found: found.update(train_filenames=[a], test_filenames=[b], val_filenames=[c]))
    assert split_scene(load_scene(tmp_path / "part")).test == (b,)
    words = ["transforms.json says val_filenames, which is not used", "1 frames are in neither list", f"such as {c}"]
    assert all(part in " ".join(load_scene(tmp_path / "part").notes) for part in words)


def test_files_from_windows_and_without_suffix_are_found(tmp_path: Path) -> None:
    def names(content: dict[str, Any]) -> None:
        for i, frame in enumerate(content["frames"]):
            frame["file_path"] = ["images\\a.png", "images/b", "images/c.jpg"][i]
            frame["mask_path"] = "more\\m.png"

    rewrite(tmp_path / "s", names)
    (tmp_path / "s/images/b.png").rename(tmp_path / "s/images/b.TIF")
    folders.write_pictures(tmp_path / "s/more", ("m.png",))
    content = (tmp_path / "s/transforms.json").read_bytes()
    (tmp_path / "s/transforms.json").write_bytes(b"\xef\xbb\xbf" + content)  # as Windows marks UTF-8
    scene = load_scene(tmp_path / "s")
    assert scene.names == ("images/a.png", "images/b", "images/c.jpg")
    assert [frame.path.name for frame in scene.frames if frame.path] == ["a.png", "b.TIF", "c.png"]
    assert all("mask" in frame.layers for frame in scene.frames)
