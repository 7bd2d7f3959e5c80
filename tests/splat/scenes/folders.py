"""Small scene folders in every format, all of the same three cameras and six points, written without the source.

Poses are held as camera-to-world columns (right, down, forward) and centres, and turned into each format by hand.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

SIZE = (24, 18)
FOCAL, CENTRE = (30.0, 31.0), (12.5, 8.75)
ROUND_OFF = 1e-12  # of a few float64 operations on numbers of order 1
NAMES = ("a.png", "b.png", "c.png")
XYZ = np.array([[0.1, 0.2, 0.0], [-0.4, 0.1, 0.3], [0.3, -0.3, 0.5], [0, 0, -0.2], [0.5, 0.2, 0.1], [-0.2, -0.2, 0.2]])
RGB = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 102, 153], [10, 20, 30], [200, 100, 0]], dtype=np.uint8)
SEEN = ((0, 1, 2), (0, 1), (1, 2), (0, 2), (2,), (0, 1, 2))  # images that see each point


@dataclass(frozen=True)
class Pose:
    right: np.ndarray
    down: np.ndarray
    forward: np.ndarray
    centre: np.ndarray

    @property
    def world_to_camera(self) -> np.ndarray:
        return np.stack([self.right, self.down, self.forward])


def poses() -> list[Pose]:
    """Three cameras 3 units away that look near the origin, each rolled a little differently."""
    result = []
    for place, roll in ((-0.6, 0.1), (0.05, -0.2), (0.7, 0.3)):
        centre = np.array([place, -0.3 * place, -3.0])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([np.sin(roll), np.cos(roll), 0], forward)
        right = right / np.linalg.norm(right)
        result.append(Pose(right, np.cross(forward, right), forward, centre))
    return result


def write_pictures(folder: Path, names: tuple[str, ...] = NAMES, size: tuple[int, int] = SIZE, channels=3) -> None:
    """Pictures of noise, a different one for each name."""
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(0)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(random.integers(0, 256, (size[1], size[0], channels), dtype=np.uint8)).save(folder / name)


def reconstruction(model: str = "PINHOLE", params: tuple[float, ...] = (*FOCAL, *CENTRE)) -> pycolmap.Reconstruction:
    """The COLMAP model of the three cameras; 2-D observations are exact for PINHOLE."""
    result = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model=model, width=SIZE[0], height=SIZE[1], params=list(params))
    result.add_camera_with_trivial_rig(camera)
    slots = {}
    for i, (name, pose) in enumerate(zip(NAMES, poses())):
        mine = [p for p, images in enumerate(SEEN) if i in images]
        local = (XYZ[mine] - pose.centre) @ pose.world_to_camera.T
        pixels = local[:, :2] / local[:, 2:] * FOCAL + CENTRE
        slots.update({(p, i): slot for slot, p in enumerate(mine)})
        image = pycolmap.Image(name, pixels, 1, i + 1)
        rigid = np.concatenate([pose.world_to_camera, -(pose.world_to_camera @ pose.centre)[:, None]], axis=1)
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rigid))
    for p, images in enumerate(SEEN):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, slots[p, i]) for i in images])
        result.add_point3D(XYZ[p], track, RGB[p])
    return result


def write_colmap(folder: Path, text=False, at="sparse/0", model: pycolmap.Reconstruction | None = None) -> None:
    (folder / at).mkdir(parents=True)
    model = model or reconstruction()
    (model.write_text if text else model.write_binary)(folder / at)
    write_pictures(folder / "images")


def write_llff(folder: Path) -> None:
    """LLFF knows one focal length and a central principal point."""
    rows = []
    for pose in poses():
        size_and_focal = np.array([SIZE[1], SIZE[0], FOCAL[0]])
        matrix = np.stack([pose.down, pose.right, -pose.forward, pose.centre, size_and_focal], axis=1)
        rows.append(np.concatenate([matrix.ravel(), [2.0, 4.5]]))
    write_pictures(folder / "images")
    np.save(folder / "poses_bounds.npy", np.stack(rows))


def opengl(pose: Pose) -> list[list[float]]:
    """Camera to world with the axes right, up, backwards."""
    matrix = np.eye(4)
    matrix[:3] = np.stack([pose.right, -pose.down, -pose.forward, pose.centre], axis=1)
    return matrix.tolist()


def transforms(**top: object) -> dict[str, object]:
    """The content of a transforms.json with intrinsics; further entries at the top."""
    frames = [{"file_path": f"images/{name}", "transform_matrix": opengl(p)} for name, p in zip(NAMES, poses())]
    intrinsics = {"fl_x": FOCAL[0], "fl_y": FOCAL[1], "cx": CENTRE[0], "cy": CENTRE[1], "w": SIZE[0], "h": SIZE[1]}
    return {**intrinsics, **top, "frames": frames}


def write_transforms(folder: Path, **top: object) -> None:
    write_pictures(folder / "images")
    (folder / "transforms.json").write_text(json.dumps(transforms(**top)))


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object], **top: object) -> None:
    """A transforms scene whose file is changed."""
    write_transforms(folder, **top)
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))


def write_blender(folder: Path, train: tuple[int, ...], test: tuple[int, ...], channels: int = 4) -> None:
    """transforms_train.json and transforms_test.json with files r_ID.png; the poses repeat."""
    for subset, numbers in (("train", train), ("test", test)):
        names = tuple(f"{subset}/r_{k}.png" for k in numbers)
        write_pictures(folder, names, channels=channels)
        turns = [opengl(pose) for pose in poses()] * len(names)
        frames = [{"file_path": f"./{name[:-4]}", "transform_matrix": turn} for name, turn in zip(names, turns)]
        (folder / f"transforms_{subset}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))


def require_poses(scene: Any) -> None:
    """The cameras of a loaded scene stand and look as they were written."""
    for frame, pose in zip(scene.frames, poses(), strict=True):
        np.testing.assert_allclose(frame.camera.rotation.numpy(), pose.world_to_camera, atol=ROUND_OFF)
        np.testing.assert_allclose(frame.camera.centre.numpy(), pose.centre, atol=ROUND_OFF)


def intrinsics(scene: Any) -> list[tuple[float, ...]]:
    return [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in (frame.camera for frame in scene.frames)]
