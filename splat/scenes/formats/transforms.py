"""Scenes from `transforms*.json`: Blender (NeRF-synthetic), instant-ngp, nerfstudio.

`transform_matrix` is camera to world with the camera's axes +x right, +y up, +z backwards (OpenGL), so that the world
to camera rotation here is diag(1, -1, -1) R^T.  Intrinsics stand at the top or in the frame, which wins:

    fl_x fl_y cx cy w h          px, pixel centres at + 0.5; cx, cy default to the middle, fl_y to fl_x
    camera_angle_x, _y           fields of view, radians, where fl_x, fl_y is not given
    k1 k2 k3 p1 p2               OpenCV's radial and tangential distortion (k4 ... of a rational model are refused)
    train_filenames, test_filenames     the split; val_filenames where there is no test_filenames
    mask_path                    the image's mask (`splat/scenes/layers.py`), from the folder of the file
    camera_model, is_fisheye     PINHOLE, SIMPLE_PINHOLE, OPENCV and the like; OPENCV_FISHEYE with k1 to k4; others are refused
    ply_file_path                points; an integer list property `views` of a vertex numbers the frames that see it
    background                   (this project) the colour that the pictures were composited over

Blender scenes have two files, `transforms_train.json` and `transforms_test.json`; the frames keep their order in the
files, because the sparse-view protocols count them.  Frames of a single file are sorted by name.  Frames without an image,
which captures often list, are skipped.  Readers return notes too: sentences on that, and on keys that are not used.
"""

from collections.abc import Mapping, Sequence
from math import isfinite, pi, tan
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from torch import Tensor

from landscape.errors import InputError
from splat.model.files.ply import read_header, read_rows
from splat.model.untrusted import inside, loose_json, require_content
from splat.scenes.images import (
    PINHOLE_MODELS,
    RADIAL_MODELS,
    Photo,
    checked_lens,
    image_folder,
    image_header,
    image_named,
    require_files,
)
from splat.scenes.view import Points, Subset

BLENDER_FILES: tuple[tuple[Subset, str], ...] = (("train", "transforms_train.json"), ("test", "transforms_test.json"))
SINGLE_FILE = "transforms.json"
FISHEYE = "OPENCV_FISHEYE"
REFUSED_TERMS, OF_FISHEYES = ("k4", "k5", "k6"), ("k5", "k6", "p1", "p2")
NUMBERS = (
    "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "k1", "k2", "k3", "p1", "p2", *REFUSED_TERMS,
)  # fmt: skip
SPLIT = ("train_filenames", "test_filenames", "val_filenames")
USED = {  # the two applied_ ones by `splat/training/origin/frames.py`
    *NUMBERS, *SPLIT, "frames", "file_path", "transform_matrix", "mask_path", "ply_file_path", "background", "camera_model",
    "is_fisheye", "applied_transform", "applied_scale",
}  # fmt: skip
NO_MATTER = {"rotation", "sharpness", "colmap_im_id"}  # steps and marks of whoever made the file


def read_blender(root: Path) -> tuple[list[Photo], list[str]]:
    """Training photographs, then test photographs, named by their path (`train/r_26`); and notes."""
    photos, skipped, unused = [], [], []
    for subset, name in BLENDER_FILES:
        data = _load(root / name)
        paths = [image_named(inside(root, frame["file_path"])) for frame in data["frames"]]
        found, missing = _photos(root / name, data, paths, dict.fromkeys(map(_name, data["frames"]), subset))
        photos, skipped, unused = photos + found, skipped + missing, unused + _unused(data, name)
    return photos, [*_skipped(skipped, len(photos)), *unused]


def read_transforms(
    root: Path, path: Path, images: str | None = None, *, points: bool = True
) -> tuple[list[Photo], Points | None, list[float] | None, list[str]]:
    """Photographs sorted by name, the points of `ply_file_path` and the background, where the file has them; and notes.

    points: whether to read them.
    """
    data = _load(path)
    data["frames"].sort(key=lambda frame: frame["file_path"])
    paths = [] if images is not None else [image_named(inside(root, frame["file_path"])) for frame in data["frames"]]
    if not any(p.is_file() for p in paths) and (images is not None or not (root / "images").exists()):
        folder = image_folder(root, images)
        paths = [_in_folder(folder, frame["file_path"]) for frame in data["frames"]]
    subsets = _subsets(data, path)
    photos, skipped = _photos(path, data, paths, subsets)
    cloud = None
    if points and (named := _file(data, "ply_file_path", path)):
        cloud = read_points(inside(root, named), tuple(_name(frame) for frame in data["frames"]))
    notes = [*_skipped(skipped, len(photos)), *_unused(data, path.name)]
    if left := sorted({photo.name for photo in photos} - subsets.keys()) if subsets else []:
        notes.append(f"{len(left)} frames are in neither list of {path.name} to train and to test, such as {left[0]}")
    return photos, cloud, data.get("background"), notes


def _skipped(names: Sequence[str], there: int) -> list[str]:
    """A note on frames without an image."""
    count = f"{len(names)} of {len(names) + there} frames that the scene lists were skipped"
    first = f"because their images are missing; the first is {names[0]}" if names else ""
    return [f"{count}, {first}"] if names else []


def _unused(data: Mapping[str, Any], name: str) -> list[str]:
    """A note on what a file says beside what is read."""
    unused = {key for part in (data, *data["frames"]) for key in part} - USED - NO_MATTER
    if "test_filenames" in data and data.get("val_filenames", data["test_filenames"]) != data["test_filenames"]:
        unused.add("val_filenames")
    words = ", ".join(key if key.isprintable() else repr(key) for key in sorted(unused))
    return [f"{name} says {words}, which {'is' if len(unused) == 1 else 'are'} not used"] if unused else []


def _subsets(data: Mapping[str, Any], path: Path) -> dict[str, Subset]:
    """The part of each frame that the lists of the file name; empty without such lists."""
    known, found = {_name(frame) for frame in data["frames"]}, {}
    held_out = "val_filenames" if "test_filenames" not in data else "test_filenames"
    parts: tuple[tuple[str, Subset], ...] = (("train_filenames", "train"), (held_out, "test"))
    for key, subset in parts if any(key in data for key in SPLIT) else ():
        names = data.get(key)
        if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
            raise InputError(f"expected a list of file paths of frames, got {key} = {names!r} in {path}"[:300])
        for name in map(_posix, names):
            if name not in known or name in found:
                problem = f"{name!r}, which is in {found[name]}_filenames too" if name in found else f"{name!r}"
                raise InputError(f"expected each of {key} to be one frame of {path} and in one list, got {problem}")
        found |= dict.fromkeys(map(_posix, names), subset)
    return found


def _load(path: Path) -> dict[str, Any]:
    require_content(path)
    try:
        data = loose_json(path.read_text(encoding="utf-8-sig"), parse_int=float)  # the largest become infinite
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"expected a JSON file with frames, cannot read {path}: {error}") from error
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"expected a non-empty list 'frames' in {path}; every frame is an image with its pose")
    for i, frame in enumerate(frames):
        if not (isinstance(frame, dict) and "transform_matrix" in frame and isinstance(frame.get("file_path"), str)):
            raise InputError(f"expected 'file_path' and 'transform_matrix' in frame {i} of {path}")
        frame["file_path"] = frame["file_path"].replace("\\", "/")  # as Windows writes it
    return data


def _in_folder(folder: Path, file_path: str) -> Path:
    """The file in another folder of the images: by its path below the folder that the file names, else by its name."""
    nested = Path(*Path(file_path).parts[1:]) if len(Path(file_path).parts) > 1 else Path(file_path)
    found = image_named(inside(folder, str(nested)))
    return found if found.is_file() else image_named(inside(folder, Path(file_path).name))


def _name(frame: Mapping[str, Any]) -> str:
    return _posix(frame["file_path"])


def _posix(path: str) -> str:
    return Path(path.replace("\\", "/")).as_posix()


def _photos(
    path: Path, data: dict[str, Any], paths: list[Path], subsets: Mapping[str, Subset]
) -> tuple[list[Photo], list[str]]:
    """The frames that have an image, and the names of the others; refuses where none has one."""
    if not any(image.is_file() for image in paths):
        require_files(paths, f"where {path} says, or name another folder of images with --images")
    shared = {key: value for key, value in data.items() if key != "frames"}
    photos, skipped = [], []
    for frame, image in zip(data["frames"], paths):
        name = _name(frame)
        if not image.is_file():
            skipped.append(name)
            continue
        rotation, centre = _pose(frame["transform_matrix"], name, path)
        lens = _lens({**shared, **frame}, image_header(image)[0], name, path)
        named = _file(frame, "mask_path", path)
        mask = inside(path.parent, named) if named else None
        photos.append(Photo(name, image, lens, rotation, centre, subsets.get(name), mask=mask))
    return photos, skipped


def _file(values: Mapping[str, Any], key: str, path: Path) -> str | None:
    """The name of a file, where there is one."""
    name = values.get(key)
    if name is not None and not isinstance(name, str):
        raise InputError(f"expected the name of a file, got {key} = {name!r} in {path}")
    return name and name.replace("\\", "/")


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
    refused = [key for key in (OF_FISHEYES if fisheye else REFUSED_TERMS) if values.get(key)]
    if refused:
        known = "k1, k2, k3 and k4 of a fisheye" if fisheye else "k1, k2, k3, p1 and p2"
        raise InputError(
            f"expected at most {known}, got {', '.join(refused)} for {name!r} in {path}, whose meaning differs between tools; "
            "undistort the photographs to pinhole images first"
        )
    width, height = int(values.get("w", size[0])), int(values.get("h", size[1]))
    fx, fy = (_focal(values, axis, side, name, path) for axis, side in (("x", width), ("y", height)))
    if fx is None:
        raise InputError(
            f"expected fl_x or camera_angle_x for {name!r} in {path}, got neither; add the focal length in px"
        )
    fy = fx if fy is None else fy
    centre = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    if fisheye:
        terms = [float(values.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4")]
        return checked_lens(FISHEYE, (width, height), [fx, fy, *centre, *terms], name)
    k1, k2, p1, p2, k3 = (float(values.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2", "k3"))
    if not any((k1, k2, p1, p2, k3)):
        return checked_lens("PINHOLE", (width, height), [fx, fy, *centre], name)
    return checked_lens("FULL_OPENCV", (width, height), [fx, fy, *centre, k1, k2, p1, p2, k3, 0, 0, 0], name)


def _focal(values: Mapping[str, Any], axis: str, side: int, name: str, path: Path) -> float | None:
    """Focal length along x or y, px, also from the field of view; None where the file has neither."""
    if (given := values.get(f"fl_{axis}")) is not None:
        return float(given)
    if (angle := values.get(f"camera_angle_{axis}")) is None:
        return None
    if not (0 < angle < pi and tan(angle / 2) > 0):  # half the least number there is, is 0
        raise InputError(f"expected camera_angle_{axis} above 0 and below pi, got {angle} for {name!r} in {path}")
    return side / (2 * tan(angle / 2))


def read_points(path: Path, names: tuple[str, ...]) -> Points:
    """Points of a PLY file: x y z, red green blue (grey where there are none), and `views` if it is there."""
    require_content(path)
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
