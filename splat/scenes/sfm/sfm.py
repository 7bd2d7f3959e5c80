"""A scene from photographs: structure from motion with pycolmap.

    features     SIFT in every photograph
    cameras      one for all photographs of one size and, where the files say it, one make and focal length: SIMPLE_RADIAL,
                 a focal length and one term of distortion, which few photographs suffice for
    matches      every pair of photographs
    mapping      incremental; of several models the one with the most photographs is kept
    images       undistorted to PINHOLE

The scene is a folder with `images` and `sparse/0`, as the tools of 3DGS expect it, which appears when it is complete.
"""

import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path

import pycolmap
from PIL import ExifTags

from landscape.errors import InputError
from landscape.results import Progress
from splat.scenes.images import IMAGE_SUFFIXES, image_files, image_header, image_pixels
from splat.scenes.layers import opened_image
from splat.scenes.scene import load_scene
from splat.scenes.sfm.triangulation import SEED, matching, quiet, verification
from splat.scenes.write import finished_folder

Stage = Callable[[str], AbstractContextManager[Progress]]  # of a name, round the stage; its progress counts photographs
FEWEST = 3  # two to train on and one to test
CAMERA, UNIT = "SIMPLE_RADIAL", "photographs"


@dataclass(frozen=True)
class Mapped:
    """The result of structure from motion.

    placed: photographs in the kept model.  left_out: names of the others.  models: numbers of photographs in the kept model,
    and in each other one with photographs that it lacks.  points: in the kept model.  error: mean reprojection error, px.
    """

    placed: int
    left_out: tuple[str, ...]
    models: tuple[int, ...]
    points: int
    error: float


def scene_from_photos(photos: Path, out: Path, stage: Stage = lambda _: nullcontext(lambda *_: None)) -> Mapped:
    """Make the scene `out`, which must not exist yet, of the image files in a folder.

    ValueError where the photographs are too few or make no model; nothing is left behind then.
    """
    files = _photographs(photos)
    with finished_folder(out) as scene:
        with tempfile.TemporaryDirectory(dir=scene.parent, prefix=f".{out.name}-") as work, quiet():
            models = _models(files, Path(work), stage)
            with stage("undistorting"):
                _write_images(models[0], photos, Path(work), scene)
        load_scene(scene)
    placed, *others = ({model.images[i].name for i in model.reg_image_ids()} for model in models)
    return Mapped(
        placed=len(placed),
        left_out=tuple(path.name for path in files if path.name not in placed),
        models=(len(placed), *(len(other) for other in others if other - placed)),
        points=models[0].num_points3D(),
        error=models[0].compute_mean_reprojection_error(),
    )


def _photographs(folder: Path) -> list[Path]:
    """The image files, each read once to see that it is whole."""
    if not folder.is_dir():
        raise FileNotFoundError(
            f"expected a folder of photographs, {folder} {'is not a folder' if folder.exists() else 'does not exist'}; "
            "name the one that holds them"
        )
    files = image_files(folder)
    if len(files) < FEWEST:
        raise InputError(
            f"expected at least {FEWEST} photographs ({', '.join(IMAGE_SUFFIXES)}) in {folder}, got {len(files)}; "
            "take more, or name the folder that holds them"
        )
    for path in files:
        image_header(path)
        image_pixels(path)  # COLMAP takes what it can of a file that was cut off, and leaves the rest grey
    return files


def _models(files: Sequence[Path], work: Path, stage: Stage) -> list[pycolmap.Reconstruction]:
    """The reconstructed models, the one with the most photographs first."""
    database, photos, models = work / "database.db", work / "photos", work / "models"
    photos.mkdir()
    models.mkdir()
    own_names = {f"{i:06d}{path.suffix}": path.name for i, path in enumerate(files)}
    for path, name in zip(files, own_names):  # the list of pairs that COLMAP reads has no names with spaces
        (photos / name).symlink_to(path.resolve())
    names = list(own_names)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = CAMERA
    pycolmap.Database.open(database).close()
    for group in _by_camera(files):
        group_names = [names[i] for i in group]
        pycolmap.import_images(database, photos, pycolmap.CameraMode.SINGLE, group_names, reader)
    features = pycolmap.FeatureExtractionOptions()
    features.use_gpu = False
    together = os.cpu_count() or 1
    with stage("finding features") as report:
        for i in range(0, len(names), together):
            pycolmap.extract_features(database, photos, names[i : i + together], extraction_options=features)
            report(min(i + together, len(names)), len(names), UNIT)
    with stage("matching") as report:
        _match(database, names, work / "pairs.txt", report)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    placed = iter(range(3, len(names) + 1))  # a model begins with a pair; a later one begins again
    with stage("placing") as report:
        found = pycolmap.incremental_mapping(
            database,
            photos,
            models,
            options,
            initial_image_pair_callback=lambda: report(2, len(names), UNIT),
            next_image_callback=lambda: report(next(placed, len(names)), len(names), UNIT),
        )
    if not found:
        raise InputError(_why_there_is_no_model(database, len(names)))
    for model in found.values():
        for image in model.images.values():
            image.name = own_names[image.name]
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _by_camera(files: Sequence[Path]) -> list[list[int]]:
    """The indices of photographs that may share a camera, in groups."""
    groups: dict[tuple, list[int]] = {}
    for i, path in enumerate(files):
        with opened_image(path) as file:
            exif = file.getexif()
            focal = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLength)
            key = file.size, exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), focal
        groups.setdefault(key, []).append(i)
    return list(groups.values())


def _match(database: Path, names: Sequence[str], pairs: Path, report: Progress) -> None:
    """Match every photograph with all before it; one call each, so that progress shows and Ctrl-C is heard."""
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = pairs
    for i, name in enumerate(names[1:], start=1):
        pairs.write_text("".join(f"{earlier} {name}\n" for earlier in names[:i]), encoding="utf-8")
        pycolmap.match_image_pairs(
            database, matching_options=matching(), pairing_options=options, verification_options=verification()
        )
        report(i + 1, len(names), UNIT)


def _why_there_is_no_model(path: Path, photos: int) -> str:
    with closing(pycolmap.Database.open(path)) as database:
        features = database.num_keypoints() / photos
        pairs = sum(inliers > 0 for inliers in database.read_two_view_geometry_num_inliers()[1])
    return (
        f"expected photographs of one scene from different places, could not place any: of {photos} photographs with "
        f"{features:.0f} features each, {pairs} of {photos * (photos - 1) // 2} pairs match; take sharp photographs that "
        "overlap by more than half, walking round the scene rather than turning on the spot"
    )


def _write_images(model: pycolmap.Reconstruction, photos: Path, work: Path, scene: Path) -> None:
    """Pinhole images and their model."""
    (work / "kept").mkdir()
    model.write_binary(work / "kept")
    pycolmap.undistort_images(work / "undistorted", work / "kept", photos)
    (scene / "sparse").mkdir(parents=True)
    (work / "undistorted/sparse").rename(scene / "sparse/0")
    (work / "undistorted/images").rename(scene / "images")
