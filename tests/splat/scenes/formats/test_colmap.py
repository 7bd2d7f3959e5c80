"""COLMAP models: written by pycolmap, binary and text, and the real fern."""

import re
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from splat.scenes.formats.colmap import SMALLEST_RECORD, find_model
from splat.scenes.scene import load_scene
from splat.scenes.view import pixel_coordinates
from tests.refusals import refused
from tests.splat.scenes import folders
from tests.splat.scenes.folders import CENTRE, FOCAL, NAMES, RGB, SEEN, SIZE, XYZ, intrinsics, require_poses


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
@pytest.mark.parametrize("at", ["sparse/0", "sparse", ".", "colmap/sparse/0", "sparse/3"])
def test_colmap_cameras_points_and_tracks_come_back(tmp_path: Path, text: bool, at: str) -> None:
    folders.write_colmap(tmp_path / "s", text, at)
    scene = load_scene(tmp_path / "s")
    assert scene.kind == "colmap" and scene.names == NAMES and scene.points is not None
    require_poses(scene)
    assert intrinsics(scene) == [(*FOCAL, *CENTRE, *SIZE)] * 3
    order = np.lexsort(scene.points.xyz.numpy().T)
    wanted = np.lexsort(XYZ.T)
    np.testing.assert_array_equal(scene.points.xyz.numpy()[order], XYZ[wanted])
    np.testing.assert_array_equal((scene.points.rgb.numpy()[order] * 255).round(), RGB[wanted])
    seen = [sorted(scene.points.observations[scene.points.observations[:, 0] == p, 1].tolist()) for p in order]  # type: ignore[index]
    assert seen == [list(SEEN[p]) for p in wanted]


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
@pytest.mark.parametrize("parent", ["sparse", "colmap/sparse"])
def test_of_several_models_that_of_most_images_is_taken_and_said(tmp_path: Path, parent: str, text: bool) -> None:
    for number, left_out in (("0", (1, 2)), ("2", ()), ("10", (3,))):
        model = folders.reconstruction()
        for frame in left_out:
            model.deregister_frame(frame)
        folders.write_colmap(tmp_path, text, f"{parent}/{number}", model)
    assert find_model(tmp_path) == tmp_path / parent / "2"
    scene = load_scene(tmp_path)
    assert scene.names == NAMES
    assert f"{parent}/2 of 3; not {parent}/0 of " in scene.notes[0] and f", {parent}/10 of " in scene.notes[0]
    shutil.rmtree(tmp_path / parent / "2")
    folders.write_colmap(tmp_path, text, f"{parent}/11")
    assert find_model(tmp_path) == tmp_path / parent / "11"  # not by the first digit


@pytest.mark.parametrize("there", [True, False])
def test_names_that_lead_out_of_the_folder_of_images_are_refused(tmp_path: Path, there: bool) -> None:
    folders.write_colmap(tmp_path / "s", text=True, at=".")
    (tmp_path / "s/images" / NAMES[0]).rename(tmp_path / "s" / NAMES[0])
    images = tmp_path / "s/images.txt"
    images.write_text(images.read_text().replace(NAMES[0], f"../{NAMES[0]}"))
    if not there:  # where no file has its own name, others are looked for by their stem
        for name in NAMES[1:]:
            (tmp_path / "s/images" / name).rename(tmp_path / "s/images" / f"_{name}")
    refused("which leads out of it", load_scene, tmp_path / "s")


def test_without_its_points_a_colmap_scene_is_the_same_else(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path / "s", False, ".")
    scene = load_scene(tmp_path / "s", points=False)
    assert scene.points is None and scene.names == NAMES
    require_poses(scene)


def test_a_colmap_model_from_before_rigs_loads_the_same(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path)
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "sparse/0" / name).unlink()
    require_poses(load_scene(tmp_path))


def test_a_track_that_meets_an_image_twice_counts_it_once(tmp_path: Path) -> None:
    model = folders.reconstruction()
    image = pycolmap.Image("0.png", np.array([[1.0, 1.0], [2.0, 1.0]]), 1, 4)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    track = pycolmap.Track([pycolmap.TrackElement(4, 0), pycolmap.TrackElement(4, 1)])
    model.add_point3D(np.array([9.0, 9.0, 9.0]), track, RGB[0])
    folders.write_colmap(tmp_path, model=model)
    folders.write_pictures(tmp_path / "images", ("0.png",))
    scene = load_scene(tmp_path)
    assert scene.points is not None and scene.names == ("0.png", *NAMES)  # by name, not by number
    last = int((scene.points.xyz[:, 0] == 9).nonzero())
    assert scene.points.sightings(scene.frames)[last] == 1


def test_images_without_pose_are_left_out_and_models_without_any_refused(tmp_path: Path) -> None:
    model = folders.reconstruction()
    model.deregister_frame(3)
    folders.write_colmap(tmp_path / "two", model=model)
    assert load_scene(tmp_path / "two").names == NAMES[:2]
    model.deregister_frame(1)
    model.deregister_frame(2)
    folders.write_colmap(tmp_path / "none", model=model)
    refused("expected images with poses", load_scene, tmp_path / "none")


JPEG = ("a.jpg", "b.jpg", "c.jpg")


@pytest.mark.parametrize("renamed", [("image000.png", "image001.png", "image002.png"), JPEG, (*JPEG, "0.jpg")])
def test_renamed_images_of_a_colmap_model_are_found(tmp_path: Path, renamed: tuple[str, ...]) -> None:
    folders.write_colmap(tmp_path)
    shutil.rmtree(tmp_path / "images")
    folders.write_pictures(tmp_path / "images_2", renamed, (12, 9))
    scene = load_scene(tmp_path)
    assert scene.names == NAMES
    half = [value / 2 for value in (*FOCAL, *CENTRE)]
    assert intrinsics(scene) == [(*half, 12, 9)] * 3
    first = np.array(Image.open(tmp_path / "images_2" / renamed[0])) / 255
    np.testing.assert_allclose(scene.load(["a.png"])[0].image.permute(1, 2, 0).numpy(), first, atol=1e-7)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_damaged_colmap_file_is_refused_before_it_can_end_the_process(tmp_path: Path, name: str) -> None:
    folders.write_colmap(tmp_path)
    path = tmp_path / f"sparse/0/{name}.bin"
    whole, contents = path.read_bytes(), [b"no COLMAP file at all"]
    contents.append((2).to_bytes(8, "little") + bytes(2 * SMALLEST_RECORD[name] - 1))
    if name != "cameras":
        contents.append(whole[:-1])
        place = 8 + 64 + len("a.png") + 1 if name == "images" else 8 + 43  # of the number of entries in a list
        assert 0 < int.from_bytes(whole[place : place + 8], "little") < 10
        contents.append(whole[: place + 6] + b"\1" + whole[place + 7 :])  # 2^48 more
    for content in contents:
        path.write_bytes(content)
        refused(f"{name}.bin promises", load_scene, tmp_path)


def test_a_camera_without_pixels_or_a_pinhole_and_a_name_that_is_no_text_are_refused(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path / "none", text=True)
    path = tmp_path / "none/sparse/0/cameras.txt"
    path.write_text(path.read_text().replace("PINHOLE 24 18", "PINHOLE 0 18"))
    refused(r"'a\.png' at the 0 x 18 px of its camera", load_scene, tmp_path / "none")
    folders.write_colmap(tmp_path / "name")
    path = tmp_path / "name/sparse/0/images.bin"
    path.write_bytes(path.read_bytes().replace(b"b.png", b"\x80.png"))
    refused("expected a COLMAP model, cannot read", load_scene, tmp_path / "name")
    folders.write_colmap(tmp_path / "lens", model=folders.reconstruction("EUCM", (*FOCAL, *CENTRE, 0.5, 1.0)))
    refused(r"EUCM for image 'a.png'.*colmap image_undistorter --image_path", load_scene, tmp_path / "lens")


def test_every_photograph_has_the_camera_of_its_own(tmp_path: Path) -> None:
    model = folders.reconstruction()
    other = pycolmap.Camera(camera_id=2, model="SIMPLE_RADIAL", width=48, height=36, params=[50.0, 24.0, 18.0, 0.05])
    model.add_camera_with_trivial_rig(other)
    folders.write_colmap(tmp_path, model=model, text=True)
    path = tmp_path / "sparse/0/images.txt"
    path.write_text("".join(re.sub(r" 1 b\.png", " 2 b.png", line) for line in path.read_text().splitlines(True)))
    folders.write_pictures(tmp_path / "images", ("b.png",), (48, 36))
    scene = load_scene(tmp_path)
    assert [frame.camera.fx for frame in scene.frames] == pytest.approx([FOCAL[0], 50.0, FOCAL[0]])
    for view in scene.load():
        assert view.image.shape[1:] == (view.camera.height, view.camera.width)


def test_nested_photographs_are_found_in_other_folders_and_under_other_suffixes(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path, text=True)
    path = tmp_path / "sparse/0/images.txt"
    path.write_text(re.sub(r" ([abc])\.png", r" left/\1.jpg", path.read_text()))
    for name in ("a.png", "b.PNG", "c.png"):
        folders.write_pictures(tmp_path / "images_2" / "left", (name,), (12, 9))
    scene = load_scene(tmp_path, images="images_2")
    assert scene.names == ("left/a.jpg", "left/b.jpg", "left/c.jpg") and scene.frames[0].camera.width == 12
    assert [frame.path.name for frame in scene.frames if frame.path] == ["a.png", "b.PNG", "c.png"]


def test_the_points_of_fern_fall_where_colmap_projects_and_observes_them(fern: Path) -> None:
    model = pycolmap.Reconstruction(fern / "sparse/0")
    errors = []
    for frame in load_scene(fern).frames:
        image = model.find_image_with_name(frame.name)
        assert image is not None
        slots = [slot for slot in image.points2D if slot.has_point3D()]
        xyz = np.array([model.points3D[slot.point3D_id].xyz for slot in slots])
        pixels, depth = pixel_coordinates(frame.camera, torch.from_numpy(xyz))
        assert bool((depth > 0).all())
        colmap = np.array([image.project_point(point) for point in xyz[:50]])
        np.testing.assert_allclose(pixels[:50].numpy(), colmap, atol=1e-9)
        errors.append(np.linalg.norm(pixels.numpy() - [slot.xy for slot in slots], axis=1))
    assert np.concatenate(errors).mean() < 1.5


def test_points_of_fern_have_the_photographs_colour_at_their_pixels(fern: Path) -> None:
    scene = load_scene(fern)
    points = scene.points
    assert points is not None and points.observations is not None

    def difference(shift: tuple[float, float]) -> float:
        total = []
        for i, view in enumerate(views):
            seen = points.observations[points.observations[:, 1] == i, 0]  # type: ignore[index]
            pixels = pixel_coordinates(view.camera, points.xyz[seen])[0] + torch.tensor(shift)
            grid = pixels / torch.tensor([view.camera.width, view.camera.height]) * 2 - 1
            colours = torch.nn.functional.grid_sample(view.image[None], grid[None, None].float(), align_corners=False)
            total.append((colours[0, :, 0].T - points.rgb[seen]).abs())
        return float(torch.cat(total).mean())

    views = scene.load()
    here = difference((0, 0))
    assert all(difference(shift) > here for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)))


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
def test_a_model_without_points_is_read_and_one_without_cameras_named(tmp_path: Path, text: bool) -> None:
    folders.write_colmap(tmp_path, text)
    suffix = ".txt" if text else ".bin"
    (tmp_path / f"sparse/0/points3D{suffix}").unlink()
    scene = load_scene(tmp_path)
    said = f"the COLMAP model sparse/0 has no points3D{suffix}: the scene is without points"
    assert scene.points is None and scene.notes == (said,)
    require_poses(scene)
    (tmp_path / f"sparse/0/cameras{suffix}").rename(tmp_path / "elsewhere")
    refused(rf"found .*sparse/0/images\{suffix} without cameras", load_scene, tmp_path, error=FileNotFoundError)


def test_a_text_model_from_another_system_is_read(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path, text=True)
    for name in ("cameras", "images", "points3D"):
        path = tmp_path / f"sparse/0/{name}.txt"
        text = path.read_text().replace("b.png", "my photo (b).png").replace("c.png", "left\\c.png").rstrip("\n")
        path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    (tmp_path / "images/b.png").rename(tmp_path / "images/my photo (b).png")
    (tmp_path / "images/left").mkdir()
    (tmp_path / "images/c.png").rename(tmp_path / "images/left/c.png")
    scene = load_scene(tmp_path)
    assert scene.names == ("a.png", "left/c.png", "my photo (b).png")
    assert scene.points is not None and len(scene.points) == len(XYZ)
    centres = {frame.name: frame.camera.centre.numpy() for frame in scene.frames}
    for name, pose in zip(("a.png", "my photo (b).png", "left/c.png"), folders.poses()):
        np.testing.assert_allclose(centres[name], pose.centre, atol=folders.ROUND_OFF)


@pytest.mark.parametrize("end", ["", "\n", "\n\n\n"])
def test_an_image_that_sees_nothing_may_be_the_last_line(tmp_path: Path, end: str) -> None:
    folders.write_colmap(tmp_path, text=True)
    (tmp_path / "sparse/0/points3D.txt").write_text("")
    lines = [line for line in (tmp_path / "sparse/0/images.txt").read_text().splitlines() if not line.startswith("#")]
    (tmp_path / "sparse/0/images.txt").write_text("\n\n".join(lines[::2]) + end)
    require_poses(load_scene(tmp_path))
    (tmp_path / "sparse/0/images.txt").write_text("1 0.5 0.5")
    refused(r"in each line of an image in .*images\.txt, got '1 0\.5 0\.5'", load_scene, tmp_path)


def test_photographs_without_a_pose_are_counted_and_hidden_files_are_none(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path)
    for name in NAMES:
        (tmp_path / "images" / f"._{name}").write_bytes(b"\0\5\x16\7")
    assert load_scene(tmp_path).notes == ()
    folders.write_pictures(tmp_path / "images", ("d.png", "e.JPG"))
    (note,) = load_scene(tmp_path).notes
    assert note.startswith("2 photographs in images have no pose") and note.endswith("the first is d.png")


def test_files_with_other_poses_are_said(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path)
    for name in ("transforms.json", "poses_bounds.npy"):
        (tmp_path / name).touch()
    (note,) = load_scene(tmp_path).notes
    assert note == "the poses are those of sparse/0; not read: poses_bounds.npy, transforms.json"


@pytest.mark.parametrize("second", ["right/a.png", "a.PNG", "a.jpg"])
def test_two_views_of_one_file_are_refused(tmp_path: Path, second: str) -> None:
    folders.write_colmap(tmp_path, text=True)
    images = tmp_path / "sparse/0/images.txt"
    first, third = ("left/a.png", "left/c.png") if "/" in second else ("a.tif", "c.tif")
    images.write_text(images.read_text().replace("a.png", first).replace("b.png", second).replace("c.png", third))
    views = ", ".join(sorted([first, second]))
    refused(rf"a\.png' more than once \(1 such\), for the views {views}; give each", load_scene, tmp_path)
