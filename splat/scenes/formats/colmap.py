"""Scenes from COLMAP models, binary or text, read with pycolmap.

A model is three files, cameras, images and points3D (.bin or .txt), in `sparse/0`, `sparse` or the scene folder itself, where
nerfstudio puts it (`colmap/sparse/0`), or in the `sparse/N` of most images: COLMAP's mapper makes a model for each part of a
scene that it cannot join.
COLMAP's conventions are those of this package: world to camera, +x right, +y down, +z forward, pixel centres at + 0.5.
"""

import re
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
import torch

from landscape.errors import InputError, lacks_memory
from splat.model.untrusted import inside
from splat.scenes.images import IMAGE_SUFFIXES, Photo, image_files, image_folder
from splat.scenes.view import Points

MODEL_FOLDERS = ("sparse/0", "sparse", ".", "colmap/sparse/0", "colmap/sparse")
MODEL_FILES = ("cameras", "images", "points3D")
SMALLEST_RECORD = {"cameras": 40, "images": 73, "points3D": 51}  # bytes in a binary model, after a count of 8 bytes
LISTS = {"images": (64, 24), "points3D": (43, 8)}  # bytes of a record before its list (and the name), and of an entry


def find_model(root: Path) -> Path | None:
    """The folder with the model's three files, if there is one."""
    for folder in (root / name for name in MODEL_FOLDERS):
        if _is_model(folder):
            return folder
    numbered = [folder for folder in sorted(root.glob("sparse/[1-9]*")) if _is_model(folder)]
    sizes = [max(path.stat().st_size for path in folder.glob("images.*")) for folder in numbered]
    return numbered[sizes.index(max(sizes))] if numbered else None


def _is_model(folder: Path) -> bool:
    return any(all((folder / (name + suffix)).is_file() for name in MODEL_FILES) for suffix in (".bin", ".txt"))


def read_colmap(
    root: Path, model: Path, images: str | None = None, *, points: bool = True
) -> tuple[list[Photo], Points | None]:
    """Photographs sorted by name, and the model's points with their tracks unless points is False."""
    _require_plausible_counts(model)
    try:
        reconstruction = _reconstruction(model)
        registered = (reconstruction.images[i] for i in reconstruction.reg_image_ids())
        posed = sorted(registered, key=lambda image: image.name)  # which may be no text
    except (ValueError, RuntimeError, IndexError) as error:
        if lacks_memory(error):
            raise
        raise InputError(
            f"expected a COLMAP model, cannot read the one in {model}: {error}; export it again"
        ) from error
    if not posed:
        raise InputError(
            f"expected images with poses in the COLMAP model {model}, got none among {len(reconstruction.images)}; "
            "run `colmap mapper` to compute them"
        )
    paths = _paths([image.name for image in posed], image_folder(root, images))
    photos = []
    for image, path in zip(posed, paths):
        rotation = torch.from_numpy(image.cam_from_world().rotation.matrix().copy())
        centre = torch.from_numpy(image.projection_center().copy())
        photos.append(Photo(image.name, path, reconstruction.cameras[image.camera_id], rotation, centre))
    return photos, points_of(reconstruction, posed) if points else None


def _reconstruction(model: Path) -> pycolmap.Reconstruction:
    """The model of its three files.

    Rigs and frames, which newer versions of COLMAP write beside them, say nothing more: every image has its pose.  COLMAP
    believes the counts in these files.
    """
    with TemporaryDirectory() as alone:
        for file in (model / (name + suffix) for name in MODEL_FILES for suffix in (".bin", ".txt")):
            if file.is_file():
                (Path(alone) / file.name).symlink_to(file.resolve())
        return pycolmap.Reconstruction(alone)


def _require_plausible_counts(model: Path) -> None:
    """InputError where a binary file promises more than it has.

    COLMAP would allocate the promised memory, read beyond the end, or abort the process.
    """
    for name, record in SMALLEST_RECORD.items():
        path = model / f"{name}.bin"
        content = path.read_bytes() if path.is_file() else bytes(8)
        count = int.from_bytes(content[:8], "little")
        if len(content) < 8 + count * record or (name in LISTS and not _lists_fit(content, count, name)):
            raise InputError(
                f"expected a COLMAP model, {path} promises {count} {name} with more in them than its {len(content)} bytes; "
                "it is cut short or no COLMAP file: export the model again"
            )


def _lists_fit(content: bytes, count: int, name: str) -> bool:
    """Whether the observations of so many images, or the tracks of so many points, end within the file."""
    before, entry = LISTS[name]
    end = 8
    for _ in range(count):
        start = end + before
        if name == "images":
            start = content.find(b"\0", start) + 1 or len(content)  # its name ends there
        end = start + 8 + entry * int.from_bytes(content[start : start + 8], "little")
        if end > len(content):
            return False
    return True


def _paths(names: list[str], folder: Path) -> list[Path]:
    """The file of every image.

    LLFF's down-sampled folders rename the photographs to image000.png, image001.png ... in the order of their names,
    and other tools change the suffix (IMG_1.JPG to IMG_1.png); both count where no file has the model's own name.
    """
    if any((folder / name).is_file() for name in names):
        return [inside(folder, name) for name in names]
    nested = [_with_suffix(inside(folder, name)) for name in names]
    if any(path.is_file() for path in nested):
        return nested
    files = image_files(folder)
    if len(files) == len(names) and all(re.fullmatch(r"image\d+", path.stem) for path in files):
        return files
    by_stem = {path.stem: path for path in files}
    return [by_stem.get(Path(name).stem) or inside(folder, name) for name in names]


def _with_suffix(path: Path) -> Path:
    """The file under another suffix of images, where there is one."""
    others = (path.with_suffix(case(suffix)) for suffix in IMAGE_SUFFIXES for case in (str, str.upper))
    return next((other for other in others if other.is_file()), path)


def points_of(reconstruction: pycolmap.Reconstruction, posed: list[pycolmap.Image]) -> Points | None:
    """The model's points with the images among `posed` that see them; None where it has none."""
    points = list(reconstruction.points3D.values())
    if not points:
        return None
    index = {image.image_id: i for i, image in enumerate(posed)}
    seen = [(i, index[e.image_id]) for i, p in enumerate(points) for e in p.track.elements if e.image_id in index]
    # a track may meet one image twice; the rows are unique
    observations = np.unique(np.array(seen, dtype=np.int64).reshape(-1, 2), axis=0)
    xyz = torch.from_numpy(np.array([point.xyz for point in points], dtype=np.float64))
    rgb = torch.from_numpy(np.array([point.color for point in points], dtype=np.float32) / 255)
    return Points(xyz, rgb, torch.from_numpy(observations), tuple(image.name for image in posed))
