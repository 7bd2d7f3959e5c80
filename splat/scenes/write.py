"""Write a scene as `transforms.json`, PNG pictures and a PLY file of points, the format that `transforms.py` reads."""

import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from splat.model.camera import Camera
from splat.model.files.ply import ply_bytes
from splat.model.untrusted import replacing
from splat.scenes.formats.transforms import SINGLE_FILE
from splat.scenes.scene import Scene
from splat.scenes.view import Frame, Points

POINTS_FILE = "points.ply"
COLOURS = ("red", "green", "blue")


def bytes_of(image: Float[Tensor, "3 h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture in 8 bits a colour."""
    return (image.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()


def png(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Content of a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", compress_level=2)  # 3% larger than at 6, in 40% of the time
    return buffer.getvalue()


@contextmanager
def finished_folder(folder: Path) -> Iterator[Path]:
    """A new folder that becomes `folder` when the block ends, and is removed if it fails.  FileExistsError if there is one."""
    if folder.exists():
        raise FileExistsError(f"expected a folder that does not exist yet, got {folder}; remove it or choose another")
    with replacing(folder, folder=True) as building:
        yield building


def write_transforms_scene(scene: Scene, folder: Path) -> None:
    """Write a scene so that `load_scene` finds it again, in a folder that appears when it is complete.

    Pictures are rounded to 8 bits and keep their background; an alpha channel is not written.  Cameras keep every
    digit.  FileExistsError if the folder exists already.
    """
    with finished_folder(Path(folder)) as building:
        _write_into(scene, building)


def _write_into(scene: Scene, folder: Path) -> None:
    files = {_file(frame): frame for frame in scene.frames}
    content = {"camera_model": "PINHOLE", "background": scene.background.tolist()}
    if scene.points is not None:
        content["ply_file_path"] = POINTS_FILE
        _write_points(scene.points, tuple(files[file].name for file in sorted(files)), folder / POINTS_FILE)
    for file, frame in files.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(png(bytes_of(frame.view().image)))
    entries = [{"file_path": file, **_camera(frame.camera)} for file, frame in files.items()]
    (folder / SINGLE_FILE).write_text(json.dumps({**content, "frames": entries}, indent=1), encoding="utf-8")


def _file(frame: Frame) -> str:
    """The path of a frame's picture: images/NAME.png."""
    name = frame.name.removeprefix("images/")
    return f"images/{name}" if name.lower().endswith(".png") else f"images/{name}.png"


def _camera(camera: Camera) -> dict[str, Any]:
    """Intrinsics (px), and the pose: camera to world, with the axes right, up, backwards (OpenGL)."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = camera.rotation.T * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    pose[:3, 3] = camera.centre
    pixels = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return {**pixels, "w": camera.width, "h": camera.height, "transform_matrix": pose.tolist()}


def _write_points(points: Points, names: tuple[str, ...], path: Path) -> None:
    """Write x y z, red green blue and, where tracks are known, the list `views` of the frames that see the point."""
    rows = np.empty(len(points), [(axis, "f8") for axis in "xyz"] + [(colour, "u1") for colour in COLOURS])
    for i, (axis, colour) in enumerate(zip("xyz", COLOURS)):
        rows[axis] = points.xyz[:, i].numpy()
        rows[colour] = (points.rgb[:, i] * 255).round().to(torch.uint8).numpy()
    lists = {}
    if points.observations is not None:
        place = {name: i for i, name in enumerate(names)}
        seen: list[list[int]] = [[] for _ in range(len(points))]
        for point, image in points.observations.tolist():
            if points.names[image] in place:
                seen[point].append(place[points.names[image]])
        lists["views"] = [np.array(sorted(views), dtype=np.int32) for views in seen]
    path.write_bytes(ply_bytes(rows, lists=lists))
