"""Scenes from `transforms*.json`: Blender (NeRF-synthetic), instant-ngp, nerfstudio.

`transform_matrix` is camera to world with the camera's axes +x right, +y up, +z backwards (OpenGL), so that the world
to camera rotation here is diag(1, -1, -1) R^T.  Intrinsics stand at the top or in the frame, which wins:

    fl_x fl_y cx cy w h          px, pixel centres at + 0.5; cx, cy default to the middle, fl_y to fl_x
    camera_angle_x               horizontal field of view, radians, where fl_x is not given
    k1 k2 k3 p1 p2               OpenCV's radial and tangential distortion (k4 ... of a rational model are refused)
    mask_path                    the image's mask (`splat/scenes/layers.py`), from the folder of the file
    camera_model, is_fisheye     PINHOLE, SIMPLE_PINHOLE, OPENCV and the like; OPENCV_FISHEYE with k1 to k4; others are refused
    ply_file_path                points; an integer list property `views` of a vertex numbers the frames that see it
    background                   (this project) the colour that the pictures were composited over

Blender scenes have two files, `transforms_train.json` and `transforms_test.json`; the frames keep their order in the
files, because the sparse-view protocols count them.  Frames of a single file are sorted by name.  Frames without an image,
which captures often list, are skipped.
"""

from collections.abc import Mapping
from math import isfinite, pi, tan
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from torch import Tensor

from landscape.errors import InputError
from splat.model.files.ply import read_header, read_rows
from splat.model.untrusted import inside, loose_json
from splat.scenes.images import (
    PINHOLE_MODELS,
    RADIAL_MODELS,
    Photo,
    checked_lens,
    image_folder,
    image_header,
    require_files,
)
from splat.scenes.view import Points, Subset

BLENDER_FILES: tuple[tuple[Subset, str], ...] = (("train", "transforms_train.json"), ("test", "transforms_test.json"))
SINGLE_FILE = "transforms.json"
FISHEYE = "OPENCV_FISHEYE"
REFUSED_TERMS = ("k4", "k5", "k6")
NUMBERS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "k1", "k2", "k3", "p1", "p2", *REFUSED_TERMS)


def read_blender(root: Path, strict: bool = False) -> tuple[list[Photo], list[str]]:
    """Training photographs, then test photographs, named by their path (`train/r_26`); and the frames skipped."""
    photos, skipped = [], []
    for subset, name in BLENDER_FILES:
        data = _load(root / name)
        paths = [_image_path(root, frame["file_path"]) for frame in data["frames"]]
        found, missing = _photos(root / name, data, paths, subset, strict)
        photos, skipped = photos + found, skipped + missing
    return photos, skipped


def read_transforms(
    root: Path, path: Path, images: str | None = None, strict: bool = False
) -> tuple[list[Photo], Points | None, list[float] | None, list[str]]:
    """Photographs sorted by name, the points of `ply_file_path` and the background, where the file has them; and the
    frames skipped."""
    data = _load(path)
    data["frames"].sort(key=lambda frame: frame["file_path"])
    paths = [] if images is not None else [_image_path(root, frame["file_path"]) for frame in data["frames"]]
    if not any(p.is_file() for p in paths) and (images is not None or not (root / "images").exists()):
        folder = image_folder(root, images)
        paths = [_in_folder(folder, frame["file_path"]) for frame in data["frames"]]
    photos, skipped = _photos(path, data, paths, None, strict)
    points = None
    if cloud := _file(data, "ply_file_path", path):
        points = read_points(inside(root, cloud), tuple(_name(frame) for frame in data["frames"]))
    return photos, points, data.get("background"), skipped


def _load(path: Path) -> dict[str, Any]:
    try:
        data = loose_json(path.read_text(encoding="utf-8"), parse_int=float)  # of which the largest is infinite
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"expected a JSON file with frames, cannot read {path}: {error}") from error
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"expected a non-empty list 'frames' in {path}; every frame is an image with its pose")
    for i, frame in enumerate(frames):
        if not (isinstance(frame, dict) and "transform_matrix" in frame and isinstance(frame.get("file_path"), str)):
            raise InputError(f"expected 'file_path' and 'transform_matrix' in frame {i} of {path}")
    return data


def _image_path(folder: Path, file_path: str) -> Path:
    """The file itself or, as Blender's exporter leaves the suffix away, the file with a suffix."""
    path = inside(folder, file_path)
    candidates = [path] + [path.with_name(path.name + suffix) for suffix in (".png", ".jpg", ".jpeg")]
    return next((candidate for candidate in candidates if candidate.is_file()), path)


def _in_folder(folder: Path, file_path: str) -> Path:
    """The file in another folder of the images: by its path below the folder that the file names, else by its name."""
    nested = Path(*Path(file_path).parts[1:]) if len(Path(file_path).parts) > 1 else Path(file_path)
    found = _image_path(folder, str(nested))
    return found if found.is_file() else _image_path(folder, Path(file_path).name)


def _name(frame: Mapping[str, Any]) -> str:
    return Path(frame["file_path"]).as_posix()


def _photos(
    path: Path, data: dict[str, Any], paths: list[Path], subset: Subset | None, strict: bool
) -> tuple[list[Photo], list[str]]:
    """The frames that have an image, and the names of the others; strict, or where none has one: refuses."""
    if not any(image.is_file() for image in paths):
        require_files(paths, f"where {path} says" if subset else "or name another folder of images with --images")
    if strict:
        require_files(paths, "or leave out --strict-frames")
    shared = {key: value for key, value in data.items() if key != "frames"}
    photos, skipped = [], []
    for frame, image in zip(data["frames"], paths):
        name = _name(frame)
        if not image.is_file():
            skipped.append(name)
            continue
        rotation, centre = _pose(frame["transform_matrix"], name, path)
        lens = _lens({**shared, **frame}, image_header(image)[0], name, path)
        mask = _file(frame, "mask_path", path)
        photos.append(
            Photo(name, image, lens, rotation, centre, subset, mask=inside(path.parent, mask) if mask else None)
        )
    return photos, skipped


def _file(values: Mapping[str, Any], key: str, path: Path) -> str | None:
    """The name of a file, where there is one."""
    name = values.get(key)
    if name is not None and not isinstance(name, str):
        raise InputError(f"expected the name of a file, got {key} = {name!r} in {path}")
    return name


def _pose(matrix: Any, name: str, path: Path) -> tuple[Tensor, Tensor]:
    """World to camera rotation and camera centre of an OpenGL camera-to-world matrix."""
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise InputError(f"expected a finite 4 x 4 transform_matrix for {name!r} in {path}, got {matrix!r}")
    rotation = np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3].T
    return torch.from_numpy(rotation), torch.from_numpy(pose[:3, 3].copy())


def _lens(values: Mapping[str, Any], size: tuple[int, int], name: str, path: Path) -> pycolmap.Camera:
    """The pycolmap camera of one frame's intrinsics."""
    wrong = [key for key in NUMBERS if key in values and not (isinstance(values[key], float) and isfinite(values[key]))]
    if wrong:
        raise InputError(f"expected a finite number, got {wrong[0]} = {values[wrong[0]]!r} for {name!r} in {path}")
    model = str(values.get("camera_model", "OPENCV"))
    fisheye = bool(values.get("is_fisheye")) or model == FISHEYE
    if not fisheye and model not in PINHOLE_MODELS + RADIAL_MODELS:
        raise InputError(
            f"expected pinhole images, {FISHEYE}, or radial and tangential distortion, got camera_model {model} for {name!r} "
            f"in {path}: a pinhole renderer cannot draw it; undistort the photographs to pinhole images first"
        )
    rational = [key for key in REFUSED_TERMS if values.get(key) and not (fisheye and key == "k4")]
    if rational:
        raise InputError(
            f"expected at most k1, k2, k3, p1 and p2, got {', '.join(rational)} for {name!r} in {path}, whose meaning "
            "differs between tools; undistort the photographs to pinhole images first"
        )
    width, height = int(values.get("w", size[0])), int(values.get("h", size[1]))
    fx = _focal(values, width, name, path)
    fy = float(values.get("fl_y", fx))
    centre = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    if fisheye:
        terms = [float(values.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4")]
        return checked_lens(FISHEYE, (width, height), [fx, fy, *centre, *terms], name)
    k1, k2, p1, p2, k3 = (float(values.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2", "k3"))
    if not any((k1, k2, p1, p2, k3)):
        return checked_lens("PINHOLE", (width, height), [fx, fy, *centre], name)
    return checked_lens("FULL_OPENCV", (width, height), [fx, fy, *centre, k1, k2, p1, p2, k3, 0, 0, 0], name)


def _focal(values: Mapping[str, Any], width: int, name: str, path: Path) -> float:
    if "fl_x" in values:
        return float(values["fl_x"])
    if "camera_angle_x" in values:
        angle = float(values["camera_angle_x"])
        if not (0 < angle < pi and tan(angle / 2) > 0):  # half the least number there is, is 0
            raise InputError(f"expected camera_angle_x above 0 and below pi, got {angle} for {name!r} in {path}")
        return width / (2 * tan(angle / 2))
    raise InputError(f"expected fl_x or camera_angle_x for {name!r} in {path}, got neither; add the focal length in px")


def read_points(path: Path, names: tuple[str, ...]) -> Points:
    """Points of a PLY file: x y z, red green blue (grey where there are none), and `views` if it is there."""
    try:
        content = path.read_bytes()
        vertex = read_rows(content, read_header(content))
        if missing := {*"xyz"} - {*vertex.names}:
            raise InputError(f"its points have no {', '.join(sorted(missing))}")
        if "views" in vertex.names:
            raise InputError("its property 'views' is a single number, not a list")
        xyz = np.stack([vertex.numbers[axis].astype(np.float64) for axis in "xyz"], axis=1)
        rgb = np.full(xyz.shape, 0.5, dtype=np.float32)
        if {"red", "green", "blue"} <= {*vertex.names}:
            rgb = _colours(np.stack([vertex.numbers[c] for c in ("red", "green", "blue")], axis=1))
        observations = None
        if seen := vertex.lists.get("views"):
            point = np.repeat(np.arange(len(seen)), [len(views) for views in seen])
            observations = torch.from_numpy(np.stack([point, np.concatenate(seen).astype(np.int64)], axis=1))
    except (OSError, InputError) as error:
        raise InputError(f"expected a PLY file of points, cannot read {path}: {error}; restore or remove it") from error
    return Points(torch.from_numpy(xyz), torch.from_numpy(rgb), observations, names)


def _colours(values: np.ndarray) -> np.ndarray:
    """Colours in [0, 1]: real numbers up to 1 are so already; others, and whole numbers, count to 255."""
    if not ((values >= 0) & (values <= 255)).all():
        raise InputError("its colours are not between 0 and 255")
    shares = values.dtype.kind == "f" and (values <= 1).all()
    return values.astype(np.float32) / np.float32(1 if shares else 255)
