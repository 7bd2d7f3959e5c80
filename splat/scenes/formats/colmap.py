"""Scenes from COLMAP models, binary or text, read with pycolmap.

A model is three files, cameras, images and points3D (.bin or .txt), in `sparse/N`, `sparse` or the scene folder itself, or
where nerfstudio puts it (`colmap/sparse/N`).  COLMAP's mapper makes a model for each part of a scene that it cannot join: of
several N the one of most images is taken.  points3D may be missing.
COLMAP's conventions are those of this package: world to camera, +x right, +y down, +z forward, pixel centres at + 0.5.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
import torch

from landscape.errors import InputError, lacks_memory
from splat.model.untrusted import inside, require_content
from splat.scenes.images import Photo, image_files, image_folder, image_named
from splat.scenes.view import Points

MODEL_FOLDERS = ("sparse/N", "sparse", ".", "colmap/sparse/N", "colmap/sparse")
MODEL_FILES = ("cameras", "images", "points3D")
SUFFIXES = (".bin", ".txt")
NUMBERS_BEFORE_NAME = 9  # of a line of images.txt: id, quaternion, translation, camera
SMALLEST_RECORD = {"cameras": 40, "images": 73, "points3D": 51}  # bytes in a binary model, after a count of 8 bytes
LISTS = {"images": (64, 24), "points3D": (43, 8)}  # bytes of a record before its list (and the name), and of an entry


def find_model(root: Path) -> Path | None:
    """The folder with the model, if there is one."""
    found = (_images_of(root, name) for name in MODEL_FOLDERS)
    return next((max(counts, key=counts.__getitem__) for counts in found if counts), None)


def part_of_model(root: Path) -> str:
    """The files of a model that lacks others, as words for a message; empty where there is none."""
    for folder in (folder for name in MODEL_FOLDERS for folder in _folders(root, name)):
        if found := [path for path in sorted(folder.iterdir()) if path.stem in MODEL_FILES and path.suffix in SUFFIXES]:
            missing = [name for name in MODEL_FILES[:2] if name not in {path.stem for path in found}]
            return f"{found[0]} without {' and '.join(missing) or 'the others of its suffix'}"
    return ""


def _folders(root: Path, name: str) -> list[Path]:
    """The folders of a name of MODEL_FOLDERS that there are, by number."""
    if not name.endswith("/N"):
        return [root / name] if (root / name).is_dir() else []
    numbered = [path for path in (root / name).parent.glob("[0-9]*") if path.name.isdecimal() and path.is_dir()]
    return sorted(numbered, key=lambda path: int(path.name))


def _images_of(root: Path, name: str) -> dict[Path, int]:
    """The number of images of each model in the folders of a name of MODEL_FOLDERS."""
    return {folder: _count(folder, suffix) for folder in _folders(root, name) if (suffix := _suffix(folder))}


def _suffix(folder: Path) -> str | None:
    """.bin or .txt of a model, None where there is none."""
    complete = (all((folder / f"{name}{suffix}").is_file() for name in MODEL_FILES[:2]) for suffix in SUFFIXES)
    return next((suffix for suffix, whole in zip(SUFFIXES, complete) if whole), None)


def _count(folder: Path, suffix: str) -> int:
    require_content(folder / f"images{suffix}")
    if suffix == ".txt":
        return len(_lines_of_images(folder / "images.txt"))
    with (folder / "images.bin").open("rb") as file:
        return int.from_bytes(file.read(8), "little")


def read_colmap(
    root: Path, model: Path, images: str | None = None, *, points: bool = True
) -> tuple[list[Photo], Points | None, list[str]]:
    """Photographs sorted by name, the model's points with their tracks unless points is False, and notes."""
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
    folder = image_folder(root, images)
    paths = _paths([image.name for image in posed], folder)
    photos = []
    for image, path in zip(posed, paths):
        rotation = torch.from_numpy(image.cam_from_world().rotation.matrix().copy())
        centre = torch.from_numpy(image.projection_center().copy())
        photos.append(Photo(image.name, path, reconstruction.cameras[image.camera_id], rotation, centre))
    notes = _notes(root, model, folder, paths, len(reconstruction.images) - len(posed))
    return photos, points_of(reconstruction, posed) if points else None, notes


def _notes(root: Path, model: Path, folder: Path, paths: Sequence[Path], without_pose: int) -> list[str]:
    """Sentences on what of the model and of the photographs is not used."""
    notes, name = [], model.relative_to(root).as_posix()
    counts = _images_of(root, re.sub(r"\d+$", "N", name))
    if len(counts) > 1:
        others = ", ".join(f"{other.relative_to(root)} of {n}" for other, n in counts.items() if other != model)
        notes.append(
            f"of several COLMAP models the one of most images is taken, {name} of {counts[model]}; not {others}"
        )
    if not (model / f"points3D{_suffix(model)}").is_file():
        notes.append(f"the COLMAP model {name} has no points3D{_suffix(model)}: the scene is without points")
    if without_pose:
        notes.append(f"{without_pose} images of the COLMAP model {name} have no pose and are left out")
    if unposed := sorted({*image_files(folder)} - {*paths}):
        notes.append(
            f"{len(unposed)} photographs in {folder.name} have no pose in the COLMAP model {name} and are left out; the first "
            f"is {unposed[0].name}"
        )
    return notes


def _reconstruction(model: Path) -> pycolmap.Reconstruction:
    """The model of its files.

    Rigs and frames, which newer versions of COLMAP write beside them, say nothing more: every image has its pose.  COLMAP
    believes the counts in these files, and takes the first word of a name in a text for the name.
    """
    suffix = _suffix(model) or ""
    lines = _lines_of_images(model / "images.txt") if suffix == ".txt" else []
    with TemporaryDirectory() as alone:
        for name in MODEL_FILES:
            there, copy = model / f"{name}{suffix}", Path(alone, f"{name}{suffix}")
            if not there.is_file():
                copy.write_bytes(bytes(8) if suffix == ".bin" else b"")  # no points
            elif suffix == ".bin":
                copy.symlink_to(there.resolve())
            elif name != "images":
                copy.write_text(_text(there), encoding="utf-8")
        if suffix == ".txt":
            rows = (f"{' '.join(words[:NUMBERS_BEFORE_NAME])} {i}\n{seen}\n" for i, (words, seen) in enumerate(lines))
            Path(alone, "images.txt").write_text("".join(rows), encoding="utf-8")
        found = pycolmap.Reconstruction(alone)
    for image in found.images.values():
        name = lines[int(image.name)][0][-1] if lines else image.name
        image.name = name.replace("\\", "/")
    return found


def _lines_of_images(path: Path) -> list[tuple[list[str], str]]:
    """Each image in images.txt: its words, the name as the last, and the line of its observations, which may be missing."""
    lines, found = iter(_text(path).splitlines()), []
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split(maxsplit=NUMBERS_BEFORE_NAME)
        if len(words) <= NUMBERS_BEFORE_NAME:
            raise InputError(
                f"expected an id, a pose, a camera and a name in each line of an image in {path}, got {line[:80]!r}; export "
                "the model again"
            )
        found.append(([*words[:-1], words[-1].strip()], next(lines, "")))
    return found


def _text(path: Path) -> str:
    """The content, with lines that end as here, without a mark of its byte order."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"expected a text of COLMAP, cannot read {path}: {error}; export the model again") from error


def _require_plausible_counts(model: Path) -> None:
    """InputError where a binary file promises more than it has.

    COLMAP would allocate the promised memory, read beyond the end, or abort the process.
    """
    for name, record in SMALLEST_RECORD.items():
        require_content(model / f"{name}.txt")
        require_content(path := model / f"{name}.bin")
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
    nested = [image_named(inside(folder, name)) for name in names]
    if any(path.is_file() for path in nested):
        return nested
    files = image_files(folder)
    if len(files) == len(names) and all(re.fullmatch(r"image\d+", path.stem) for path in files):
        return files
    by_stem = {path.stem: path for path in files}
    return [by_stem.get(Path(name).stem) or inside(folder, name) for name in names]


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
