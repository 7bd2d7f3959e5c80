"""Scenes from photographs, of a place whose cameras are known."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from landscape.results import Progress
from splat.scenes.scene import load_scene
from splat.scenes.sfm.sfm import Mapped, _by_camera, _models, scene_from_photos
from tests.refusals import refused
from tests.splat.scenes import textured
from tests.splat.scenes.textured import DISTANCE, FOCAL


def write_photos(folder: Path, names: list[str], mirrored: bool = False) -> None:
    """Photographs of the place, or of its mirror image in other colours, which is another place."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, view in zip(names, textured.views(len(names))):
        pixels = view.image.permute(1, 2, 0).numpy()
        pixels = 1 - pixels[:, ::-1] if mirrored else pixels
        Image.fromarray((pixels * 255).round().astype(np.uint8)).save(folder / name)


def write_blank(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("RGB", (textured.WIDTH, textured.HEIGHT), (90, 100, 110)).save(folder / name)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Mapped, list[tuple[str, Any, int]]]:
    """A scene of five photographs and one that shows nothing, and the progress that was said."""
    root, progress = tmp_path_factory.mktemp("sfm"), []
    write_photos(root / "photos", ["a b.png", "c.png", "d.png", "e.png", "f.png"])
    write_blank(root / "photos", ["wall.png"])

    @contextmanager
    def stage(name: str) -> Iterator[Progress]:
        yield lambda done, most, _: progress.append((name, done, most))
        progress.append((name, "ended", 0))

    mapped = scene_from_photos(root / "photos", root / "out" / "scene", stage)
    return root / "out" / "scene", mapped, progress


def test_the_cameras_of_photographs_are_found_up_to_a_similarity(made) -> None:
    frames = load_scene(made[0]).frames
    assert [frame.name for frame in frames] == ["a b.png", "c.png", "d.png", "e.png", "f.png"]
    truth = textured.cameras(5)
    mine, known = (np.stack([f.centre.numpy() for f in cameras]) for cameras in ([f.camera for f in frames], truth))
    moved, wanted = mine - mine.mean(axis=0), known - known.mean(axis=0)
    left, _, right = np.linalg.svd(moved.T @ wanted)
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    scale = np.linalg.norm(wanted) / np.linalg.norm(moved)
    # the place of a camera whose angles err by a pixel
    assert np.linalg.norm(scale * moved @ turn - wanted, axis=1).max() < DISTANCE / FOCAL
    for before, after, first, second in zip(frames, frames[1:], truth, truth[1:]):
        found = before.camera.rotation @ after.camera.rotation.T
        turned = found @ (first.rotation @ second.rotation.T).T  # free of the similarity
        assert np.arccos((float(turned.trace()) - 1) / 2) < 2 / FOCAL  # a pixel for either
    edge = 2 / (textured.WIDTH / 2)  # moves a pixel at the edge by 2 px, which the distortion can all but undo
    focal_lengths = {frame.camera.fx for frame in frames}
    assert len(focal_lengths) == 1 and focal_lengths.pop() == pytest.approx(FOCAL, rel=edge)


def test_what_became_of_the_photographs_is_told(made) -> None:
    scene, mapped, progress = made
    points = load_scene(scene).points
    assert points is not None and mapped.points == len(points) > 100
    assert (mapped.placed, mapped.left_out, mapped.models) == (5, ("wall.png",), (5,))
    assert 0 < mapped.error < 1
    for stage, last in (("finding features", 6), ("matching", 6), ("placing", 5), ("undistorting", None)):
        *counts, ended = [done for said, done, _ in progress if said == stage]
        assert counts == sorted(counts) and counts[-1:] == [last] * bool(last) and ended == "ended"
    assert sorted(path.name for path in scene.iterdir()) == ["images", "sparse"]
    assert [path.name for path in scene.parent.iterdir()] == ["scene"]  # the folder that it grew in is gone


def test_of_several_models_the_largest_is_kept(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", [f"{i}.png" for i in range(4)], mirrored=True)
    write_photos(tmp_path / "photos", [f"{i}.png" for i in range(4, 9)])
    mapped = scene_from_photos(tmp_path / "photos", tmp_path / "scene")
    assert mapped.models == (5, 4) and mapped.left_out == ("0.png", "1.png", "2.png", "3.png")
    assert load_scene(tmp_path / "scene").names == tuple(f"{i}.png" for i in range(4, 9))


def test_a_model_within_the_kept_one_is_none_that_it_fell_apart_into(tmp_path: Path, monkeypatch) -> None:
    write_photos(tmp_path / "photos", [f"{i}.png" for i in range(5)])

    def with_a_part(*given) -> list[pycolmap.Reconstruction]:
        (whole,) = _models(*given)
        part = copy.deepcopy(whole)
        part.deregister_frame(part.reg_frame_ids()[0])
        return [whole, part]

    monkeypatch.setattr("splat.scenes.sfm.sfm._models", with_a_part)
    assert scene_from_photos(tmp_path / "photos", tmp_path / "scene").models == (5,)


def test_photographs_that_make_no_model_leave_nothing_behind(tmp_path: Path) -> None:
    write_blank(tmp_path / "photos", ["a.png", "b.png", "c.png"])
    with pytest.raises(ValueError, match=r"of 3 photographs with 0 features each, 0 of 3 pairs match; take sharp"):
        scene_from_photos(tmp_path / "photos", tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_stopping_leaves_nothing_behind(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", ["a.png", "b.png", "c.png", "d.png"])

    def stop(done: int, *_: object) -> None:
        if done == 3:
            raise KeyboardInterrupt

    quiet = {"placing": stop}
    with pytest.raises(KeyboardInterrupt):
        scene_from_photos(
            tmp_path / "photos", tmp_path / "scene", lambda name: nullcontext(quiet.get(name, lambda *_: None))
        )
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_folders_that_cannot_be_photographs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nothing does not exist"):
        scene_from_photos(tmp_path / "nothing", tmp_path / "scene")
    write_blank(tmp_path / "few", ["a.png", "b.jpg"])
    (tmp_path / "few" / "notes.txt").write_text("")
    refused(r"at least 3 photographs .* got 2; take more", scene_from_photos, tmp_path / "few", tmp_path / "scene")
    (tmp_path / "few" / "c.png").write_text("")
    refused(r"cannot read .*c\.png", scene_from_photos, tmp_path / "few", tmp_path / "scene")
    for name in ("c.png", "c.jpg"):
        write_photos(tmp_path / "few", [name])
        whole = (tmp_path / "few" / name).read_bytes()
        (tmp_path / "few" / name).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ValueError, match=rf"cannot read .*c\{name[1:]}: image file is truncated.*; replace"):
            scene_from_photos(tmp_path / "few", tmp_path / "scene")
        write_blank(tmp_path / "few", [name])
    (tmp_path / "scene").mkdir()
    with pytest.raises(FileExistsError, match="remove it or choose another"):
        scene_from_photos(tmp_path / "few", tmp_path / "scene")
    assert not list((tmp_path / "scene").iterdir())


def test_photographs_of_one_size_and_lens_share_a_camera(tmp_path: Path) -> None:
    paths = []
    for i, (size, focal) in enumerate([((8, 6), 24), ((6, 8), 24), ((8, 6), 24), ((8, 6), 50), ((8, 6), None)]):
        image, exif = Image.new("RGB", size), Image.Exif()
        if focal:
            exif[ExifTags.Base.Make] = "maker"
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = float(focal)
        image.save(tmp_path / f"{i}.jpg", exif=exif)
        paths.append(tmp_path / f"{i}.jpg")
    assert _by_camera(paths) == [[0, 2], [1], [3], [4]]
