"""poses_bounds.npy: written by hand, and the real fern against its COLMAP model."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from splat.scenes.scene import load_scene
from tests.refusals import refused
from tests.splat.scenes import folders
from tests.splat.scenes.folders import FOCAL, NAMES, SIZE, intrinsics, require_poses


def test_llff_cameras_and_depth_ranges_come_back(tmp_path: Path) -> None:
    folders.write_llff(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.kind == "llff" and scene.names == NAMES and scene.points is None
    require_poses(scene)
    assert intrinsics(scene) == [(FOCAL[0], FOCAL[0], SIZE[0] / 2, SIZE[1] / 2, *SIZE)] * 3
    assert [frame.depth_range for frame in scene.frames] == [(2.0, 4.5)] * 3


def test_llff_files_that_are_no_arrays_of_poses_or_hold_objects_are_refused(tmp_path: Path) -> None:
    folders.write_pictures(tmp_path / "images")
    path = tmp_path / "poses_bounds.npy"
    for rows in (np.zeros((3, 15)), np.full((3, 17), np.nan), np.zeros(17)):
        np.save(path, rows)
        refused("finite rows of 17 numbers", load_scene, tmp_path)
    np.save(path, np.array([{}], dtype=object), allow_pickle=True)
    refused("cannot read it", load_scene, tmp_path)
    np.save(path, np.zeros((3, 17), dtype=complex))
    refused("cannot read it: an array of complex128", load_scene, tmp_path)
    np.save(path, np.zeros((3, 17)))
    whole = path.read_bytes()
    cut, large = whole.replace(b"(3, 17)", b"(3, 17 "), whole.replace(b"(3,", b"(10**15,")
    for damaged in (cut, large, b"PK\x03\x04" + whole, b"not an array"):
        path.write_bytes(damaged)
        refused("cannot read it", load_scene, tmp_path)


SIDE = "'b.png' cannot be: expected at least 1 px a side"
BOUNDS = slice(15, None)


@pytest.mark.parametrize(
    ("columns", "value", "words"),
    [
        (4, 0.0, SIDE),
        (9, -24.0, SIDE),
        (9, 1e300, SIDE),
        (BOUNDS, (4.5, 2.0), "got 4.5 and 2 for 'b.png'"),
        (BOUNDS, (-1.0, 4.5), "got -1 and 4.5 for 'b.png'"),
        (BOUNDS, (0.0, 4.5), "got 0 and 4.5 for 'b.png'"),
        (BOUNDS, (2.0, 2.0), "got 2 and 2 for 'b.png'"),
    ],
)
def test_llff_sizes_and_depth_ranges_that_cannot_be_are_refused(tmp_path: Path, columns, value, words: str) -> None:
    folders.write_llff(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    rows[1, columns] = value
    np.save(tmp_path / "poses_bounds.npy", rows)
    start = "" if words == SIDE else f"expected 0 < nearest < farthest depth .* {tmp_path}/poses_bounds.npy, "
    refused(start + words, load_scene, tmp_path)


def test_llff_needs_an_image_for_each_pose(tmp_path: Path) -> None:
    folders.write_llff(tmp_path)
    (tmp_path / "images/b.png").unlink()
    refused(r"each of the 3 poses .* got 2", load_scene, tmp_path)


def test_fern_has_the_same_cameras_in_both_of_its_formats(fern: Path, tmp_path: Path) -> None:
    """Up to a similarity, which a model may choose freely: angles between viewing directions, ratios of distances."""
    shutil.copy(fern / "poses_bounds.npy", tmp_path)
    (tmp_path / "images_8").symlink_to(fern / "images_8")
    llff, colmap = load_scene(tmp_path), load_scene(fern)
    assert (llff.kind, colmap.kind) == ("llff", "colmap") and llff.names == colmap.names
    for mine, theirs in zip(llff.frames, colmap.frames):
        assert mine.camera.fx == pytest.approx(theirs.camera.fx, rel=1e-4)
    relative, distances = [], []
    for scene in (llff, colmap):
        rotations = torch.stack([frame.camera.rotation for frame in scene.frames])
        centres = torch.stack([frame.camera.centre for frame in scene.frames])
        relative.append(rotations @ rotations[0].T)
        distances.append(torch.cdist(centres, centres) / torch.cdist(centres, centres).max())
        assert all(frame.camera.rotation.det() > 0 for frame in scene.frames)
    torch.testing.assert_close(relative[0], relative[1], atol=1e-4, rtol=0)
    torch.testing.assert_close(distances[0], distances[1], atol=1e-4, rtol=0)
