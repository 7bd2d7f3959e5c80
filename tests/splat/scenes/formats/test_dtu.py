"""DTU: its own folders and matrices, and COLMAP models of its images."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splat.scenes.formats.dtu import decompose
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import dtu_split, split_scene
from tests.refusals import refused
from tests.splat.scenes import folders

SIZE, FOCAL, CENTRE = (16, 12), (29.0, 28.8), (8.25, 6.25)
TRAIN = (25, 22, 28, 40, 44, 48, 0, 8, 13)
TEST = (1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35, 41, 42, 43, 45, 46, 47)


def name(number: int, light: str = "3_r5000") -> str:
    return f"rect_{number + 1:03d}_{light}.png"


def pose(i: int) -> tuple[np.ndarray, np.ndarray]:
    """World to camera rotation and centre in mm: on an arc, looking at the origin."""
    angle = -0.5 + i / 49
    forward = np.array([np.sin(angle), 0.1, np.cos(angle)])
    forward /= np.linalg.norm(forward)
    right = np.cross([0, 1, 0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]), -650 * forward


def matrix(i: int) -> np.ndarray:
    """K [R | -R c], with the sign and the size that a matrix may have."""
    calibration = np.array([[FOCAL[0], 0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]])
    rotation, centre = pose(i)
    return (-1) ** i * (0.5 + i) * calibration @ np.concatenate([rotation, -(rotation @ centre)[:, None]], axis=1)


def write_dtu(root: Path, scan: str = "scan8", views: int = 49) -> Path:
    """Pictures under two lights, matrices for all scans, and masks of the test views: the left half is the object."""
    scene, calibration = root / "Rectified" / scan, root / "Calibration/cal18"
    inside = root / "submission_data/idrmasks" / scan / ("mask" if scan == "scan40" else "")
    calibration.mkdir(parents=True, exist_ok=True)
    inside.mkdir(parents=True)
    lights = [("3_r5000" if i < 49 else "3_r7000") for i in range(views)]
    folders.write_pictures(scene, tuple(name(i, light) for i, light in enumerate(lights)) + (name(0, "max"),), SIZE)
    for i in range(views):
        np.savetxt(calibration / f"pos_{i + 1:03d}.txt", matrix(i))
    for i in TEST:
        pixels = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
        pixels[:, : SIZE[0] // 2] = 255
        Image.fromarray(pixels).save(inside / f"{i:03d}.png")
    return scene


def in_left_half(scene: Scene, number: int) -> bool:
    mask = scene.load([name(number)])[0].mask
    assert mask is not None
    half = scene.frames[0].camera.width // 2
    return bool(mask[:, :half].all()) and not mask[:, half:].any()


@pytest.mark.parametrize(("scan", "views"), [("scan8", 49), ("scan40", 64)])
def test_dtu_in_its_own_folders_has_its_cameras_and_masks(tmp_path: Path, scan: str, views: int) -> None:
    scene = load_scene(write_dtu(tmp_path, scan, views))
    assert scene.kind == "dtu" and len(scene.frames) == views and scene.frames[1].name == name(1)
    for i, frame in enumerate(scene.frames):
        rotation, centre = pose(i)
        camera = frame.camera
        # numbers of up to 650 mm, rounded a few times, divided by focal lengths of 30
        np.testing.assert_allclose(camera.rotation.numpy(), rotation, atol=1e-11)
        np.testing.assert_allclose(camera.centre.numpy(), centre, atol=1e-8)
        np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (*FOCAL, *CENTRE), rtol=1e-11)
    assert [i for i in range(views) if scene.frames[i].view().mask is not None] == list(TEST)
    assert in_left_half(scene, 1) and in_left_half(load_scene(scene.root, downscale=2), 47)


@pytest.mark.parametrize("scale", [1.0, -1.0, 1e-3, -40.0])
def test_a_matrix_of_any_scale_has_one_decomposition(scale: float) -> None:
    calibration, rotation, centre = decompose(scale * matrix(4))
    np.testing.assert_allclose(rotation, pose(4)[0], atol=1e-12)
    np.testing.assert_allclose(centre, pose(4)[1], rtol=1e-12)
    assert calibration[2, 2] == 1 and np.linalg.det(rotation) == pytest.approx(1, rel=1e-12)


def test_the_views_of_dtu_are_pixelnerfs_and_regnerfs(tmp_path: Path) -> None:
    scene = load_scene(write_dtu(tmp_path, views=64))
    for n in (3, 6, 9):
        split = split_scene(scene, n)
        assert split.train == tuple(map(name, TRAIN[:n])) and split.test == tuple(map(name, TEST))
    assert split_scene(scene).train == tuple(map(name, TRAIN)) and split.protocol == "dtu"


@pytest.mark.parametrize("n", [0, 10])
def test_more_views_than_the_protocol_of_dtu_has_or_none_are_refused(n: int) -> None:
    refused(f"1 to 9 training views, .* got {n}", dtu_split, [name(i) for i in range(49)], n)


def test_a_scan_may_lack_test_views_but_no_training_view() -> None:
    names = [name(i) for i in range(49) if i not in (22, 2)]
    refused(r"without view 22 \(rect_023\)", dtu_split, names, 3)
    assert dtu_split([*names, name(22)], 3).test == tuple(map(name, (1, *TEST[2:])))


def test_a_colmap_model_of_dtus_images_follows_dtus_protocol(tmp_path: Path) -> None:
    write_dtu(tmp_path)
    images = dict(zip(folders.NAMES, map(name, (28, 22, 25))))
    model = folders.reconstruction()
    for image in model.images.values():
        image.name = images[image.name]
    folders.write_colmap(tmp_path / "scan8", model=model)
    folders.write_pictures(tmp_path / "scan8/images", tuple(images.values()))
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.eye(18, 24, dtype=np.uint8) * 255).save(tmp_path / "masks/022.png")
    scene = load_scene(tmp_path / "scan8", masks=tmp_path / "masks")
    assert scene.kind == "colmap" and split_scene(scene, 3).train == tuple(map(name, TRAIN[:3]))
    masks = [frame.view().mask for frame in scene.frames]
    assert [mask is None for mask in masks] == [False, True, True]
    assert masks[0] is not None and torch.equal(masks[0], torch.eye(18, 24) > 0)


def test_a_missing_calibration_of_dtu_is_refused_with_its_place(tmp_path: Path) -> None:
    scene = write_dtu(tmp_path)
    path = tmp_path / "Calibration/cal18/pos_003.txt"
    path.write_text("1 2 3")
    refused(r"3 x 4 matrix in .*pos_003\.txt", load_scene, scene)
    path.unlink()
    refused(r"calibration of rect_003_3_r5000\.png in .*pos_003\.txt", load_scene, scene, error=FileNotFoundError)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_a_matrix_that_is_no_cameras_is_refused(tmp_path: Path, value: float) -> None:
    scene = write_dtu(tmp_path, views=1)
    np.savetxt(tmp_path / "Calibration/cal18/pos_001.txt", value * matrix(0))
    refused(r"finite matrix of a camera in .*pos_001.txt", load_scene, scene)


def test_a_sheared_camera_is_refused(tmp_path: Path) -> None:
    scene = write_dtu(tmp_path)
    calibration = np.array([[FOCAL[0], 2.0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]])
    rotation, centre = pose(0)
    sheared = calibration @ np.concatenate([rotation, -(rotation @ centre)[:, None]], axis=1)
    np.savetxt(tmp_path / "Calibration/cal18/pos_001.txt", sheared)
    refused(r"without skew in .*pos_001\.txt, got one that shears by 0\.83 px", load_scene, scene)
