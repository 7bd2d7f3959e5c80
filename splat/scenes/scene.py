"""A scene: posed pictures and, where the files have them, points.  `load_scene` recognises the format of a folder:

    COLMAP      cameras, images, points3D (.bin or .txt) in sparse/0, sparse or the folder itself     `colmap.py`
    LLFF        poses_bounds.npy                                                                      `llff.py`
    Blender     transforms_train.json with transforms_test.json                                       `transforms.py`
    transforms  transforms.json of instant-ngp or nerfstudio                                          `transforms.py`
    DTU         Rectified/scanN beside Calibration                                                    `dtu.py`

in this order: a COLMAP model beside poses_bounds.npy wins, because it has points.  Every image file is found, and its size
compared with that of its camera, when the scene is loaded; pixels are read when a view is asked for.
"""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr
from splat.backend.memory import free_memory
from splat.model.camera import Camera
from splat.model.untrusted import require_scene
from splat.scenes.formats.colmap import MODEL_FOLDERS, find_model, part_of_model, read_colmap
from splat.scenes.formats.dtu import is_dtu, mask_folder, read_dtu
from splat.scenes.formats.llff import POSES, read_llff
from splat.scenes.formats.transforms import BLENDER_FILES, SINGLE_FILE, read_blender, read_transforms
from splat.scenes.images import Photo, frame, image_header, require_files
from splat.scenes.layers import DEPTH_SUFFIXES, MASK_FOLDERS, MASK_SUFFIXES, find_layer
from splat.scenes.view import Frame, Photograph, Points, View

PICTURES = 0.25  # of the free memory
Kind = Literal["colmap", "llff", "blender", "transforms", "dtu", "synthetic"]


@dataclass(frozen=True, eq=False, repr=False)
class Scene(ShortRepr):
    """Frames sorted by name (Blender: in the order of its files), points if any, and the background colour.

    notes: sentences on what its files say and is not used.
    """

    name: str
    root: Path
    kind: Kind
    frames: tuple[Frame, ...]
    points: Points | None
    background: Float[Tensor, "3"]
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(frame.name for frame in self.frames)

    def select(self, names: Sequence[str]) -> list[Frame]:
        """The frames of these names, in the order asked for."""
        by_name = {frame.name: frame for frame in self.frames}
        unknown = [name for name in names if name not in by_name]
        if unknown:
            raise InputError(
                f"expected names of images of {self.root}, got {unknown[0]!r} ({len(unknown)} unknown); the scene has "
                f"{len(self.frames)} images from {self.names[0]!r} to {self.names[-1]!r}"
            )
        return [by_name[name] for name in names]

    def load(self, names: Sequence[str] | None = None) -> list[View]:
        """Read the pictures of these frames (all by default), several at a time.

        Where they take more than a share of the free memory, the last ones used stay in it, and others are read when they are.
        """
        frames = self.frames if names is None else self.select(names)
        room = int(PICTURES * free_memory(torch.device("cpu")))
        with ThreadPoolExecutor(max(1, min(len(frames), torch.get_num_threads()))) as readers:
            if sum(frame.bytes for frame in frames) <= room:
                return list(readers.map(Frame.view, frames))
            first = room // max(frame.bytes for frame in frames)
            read = lru_cache(max(first, 1))(Frame.view)
            list(readers.map(read, frames[:first]))
        return [Photograph(frame, read) for frame in frames]

    def extent(self, names: Sequence[str] | None = None) -> float:
        """`camera_extent` of these frames (all by default)."""
        return camera_extent([frame.camera for frame in (self.frames if names is None else self.select(names))])


def camera_extent(cameras: Sequence[Camera]) -> float:
    """1.1 x the largest distance of a camera from the mean of all, world units.

    Taken over the training cameras, it is 3DGS's unit for steps of positions.  InputError where all cameras are at one place.
    """
    centres = torch.stack([camera.centre for camera in cameras])
    extent = 1.1 * float((centres - centres.mean(dim=0)).norm(dim=1).max())
    if not extent > 0:
        raise InputError(
            f"expected cameras at different places, got {len(cameras)} at the same one: the scene has no scale; "
            "choose at least two views from different places"
        )
    return extent


def load_scene(
    path: str | Path,
    images: str | None = None,
    downscale: float = 1,
    background: Sequence[float] | None = None,
    masks: Path | None = None,
    depths: Path | None = None,
    points: bool = True,
) -> Scene:
    """Recognise and load the scene in a folder; pixels are read later.

    images: folder of the photographs inside the scene (default: `images`, else the largest `images_K`).
    downscale: both sides of every picture are divided by this and rounded.
    background: RGB in [0, 1] that transparent pictures are composited over and renders are drawn on; by default white
        where the pictures have an alpha channel (as 3DGS does for Blender scenes), else black.
    masks, depths: folders of `splat/scenes/layers.py`, which need not have a file for every image.  Masks by default:
        those that the scene's files name, else a folder mask or masks in the scene, else those that DTU provides.
    points: whether to read a COLMAP model's points, which take longest.

    Raises FileNotFoundError for a missing file and InputError for one that cannot be used, in one sentence.

    >>> from splat.scenes.write import write_transforms_scene
    >>> from splat import SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> folder = getfixture("tmp_path") / "scene"
    >>> write_transforms_scene(made.scene, folder)
    >>> scene = load_scene(folder)
    >>> scene.kind, scene.names
    ('transforms', ('images/view_000.png', 'images/view_001.png'))
    >>> scene.load()[0].image.shape
    torch.Size([3, 12, 16])
    """
    root = Path(path)
    require_scene(root)
    if not 1 <= downscale < float("inf"):
        raise InputError(f"expected downscale of at least 1, got {downscale}")
    found = _read(root, images, points)
    photos = _with_layers(root, found.photos, masks, depths)
    require_files([photo.path for photo in photos] + [photo.mask for photo in photos if photo.mask])
    _require_distinct(photos, root)
    if background is None:
        background = found.background
    if background is None:
        background = (1.0,) * 3 if image_header(photos[0].path)[1] else (0.0,) * 3
    colour = _colour(background)
    frames = tuple(frame(photo, downscale, colour) for photo in photos)
    return Scene(root.resolve().name, root.resolve(), found.kind, frames, found.points, colour, tuple(found.notes))


def _colour(values: Sequence[float]) -> Float[Tensor, "3"]:
    three = isinstance(values, list | tuple) and len(values) == 3
    if not (three and all(isinstance(v, (int, float)) and 0 <= v <= 1 for v in values)):
        raise InputError(f"expected a background of three numbers in [0, 1], got {values!r}")
    return torch.tensor(values, dtype=torch.float32)


class _Found(NamedTuple):
    """Content of the files of a scene."""

    kind: Kind
    photos: list[Photo]
    points: Points | None = None
    background: list[float] | None = None
    notes: Sequence[str] = ()


def _read(root: Path, images: str | None, points: bool) -> _Found:
    model = find_model(root)
    if model is not None:
        photos, cloud, notes = read_colmap(root, model, images, points=points)
        return _Found("colmap", photos, cloud, notes=[*notes, *_not_read(root, model.relative_to(root).as_posix())])
    if (root / POSES).is_file():
        return _Found("llff", read_llff(root, images), notes=_not_read(root, POSES))
    if all((root / name).is_file() for _, name in BLENDER_FILES):
        if images is not None:
            raise InputError(f"expected no image folder for {root}, whose transforms files name theirs, got {images!r}")
        photos, notes = read_blender(root)
        return _Found("blender", photos, notes=[*notes, *_not_read(root, *(name for _, name in BLENDER_FILES))])
    for name in (SINGLE_FILE, BLENDER_FILES[0][1]):
        if (root / name).is_file():
            photos, cloud, background, notes = read_transforms(root, root / name, images, points=points)
            return _Found("transforms", photos, cloud, background, [*notes, *_not_read(root, name)])
    if is_dtu(root):
        return _Found("dtu", read_dtu(root))
    found = sorted(path.name for path in root.iterdir())
    instead = f"{', '.join(found[:6])}{' ...' if len(found) > 6 else ''}" if found else "an empty folder"
    raise FileNotFoundError(
        f"expected a scene with camera poses in {root}: looked for a COLMAP model (cameras and images, .bin or .txt) in "
        f"{', '.join(MODEL_FOLDERS)}, for {POSES}, {BLENDER_FILES[0][1]}, {SINGLE_FILE} and DTU's images "
        f"(rect_001_3_r5000.png); found {part_of_model(root) or instead}; make a scene of the photographs with landscape sfm"
    )


def _not_read(root: Path, *read: str) -> list[str]:
    """A note on other files with poses in the folder."""
    names = (POSES, SINGLE_FILE, *(f"transforms_{part}.json" for part in ("train", "val", "test")))
    others = [name for name in names if name not in read and (root / name).is_file()]
    return [f"the poses are those of {' and '.join(read)}; not read: {', '.join(others)}"] if others else []


def _with_layers(root: Path, photos: list[Photo], masks: Path | None, depths: Path | None) -> list[Photo]:
    """The photographs with the files beside them; a folder that was named must have some."""
    usual = [root / name for name in MASK_FOLDERS] + ([mask_folder(root)] if is_dtu(root) else [])
    inner = [each for folder in ([masks] if masks else usual) for each in (folder, folder / "mask")]
    folders = [folder for folder in inner if folder.is_dir()]
    result = []
    for photo in photos:
        names = (photo.name, photo.path.name)
        mask = next((path for folder in folders if (path := find_layer(folder, names, MASK_SUFFIXES))), None)
        if photo.mask and not masks:
            mask = photo.mask
        result.append(replace(photo, mask=mask, depth=find_layer(depths, names, DEPTH_SUFFIXES) if depths else None))
    for folder, files in ((masks, [photo.mask for photo in result]), (depths, [photo.depth for photo in result])):
        if folder and not any(files):
            raise FileNotFoundError(
                f"expected files named after the {len(photos)} images, such as {Path(photos[0].name).stem}.png, in "
                f"{folder}, {'found none' if folder.is_dir() else 'which is no folder'}; name their folder"
            )
    return result


def _require_distinct(photos: Sequence[Photo], root: Path) -> None:
    """InputError where two views have one name, or one file."""
    for of in (lambda photo: photo.name, lambda photo: str(photo.path.resolve())):
        twice = sorted(each for each, count in Counter(map(of, photos)).items() if count > 1)
        if twice:
            views = ", ".join(photo.name for photo in photos if of(photo) == twice[0])
            raise InputError(
                f"expected every image of {root} once, got {twice[0]!r} more than once ({len(twice)} such), for the views "
                f"{views}; give each view a file of its own"
            )
