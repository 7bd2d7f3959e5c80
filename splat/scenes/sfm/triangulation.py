"""Points triangulated from some views with known poses, so that a training starts from nothing of the views held out.

    features     SIFT with affine shapes and pooling over scales, in the photographs before they are reduced
    matches      of every pair of views
    points       triangulated with COLMAP's thresholds (reprojection error 4 px, angle 1.5 degrees), poses and lenses fixed

as FSGS and CoR-GS make them (their `tools/colmap_llff.py`, before dense stereo), with two differences.  Points that only two
views see are kept, because three views have hardly any others.  Matching is not guided by epipolar geometry a second time,
because nothing refutes the wrong matches that it adds where only two views see a point.
"""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.scenes.formats.colmap import points_of
from splat.scenes.view import Frame, Points
from splat.scenes.write import bytes_of, png

SEED = 0  # of RANSAC: the same views give the same points


def triangulated_points(frames: Sequence[Frame]) -> Points:
    """The points that at least two of these views show.  InputError where there are fewer than two views, or no point."""
    if len(frames) < 2:
        raise InputError(f"expected at least 2 views to triangulate from, got {len(frames)}; start from random points")
    with tempfile.TemporaryDirectory() as folder, quiet():
        database, pictures, output = (Path(folder) / name for name in ("database.db", "images", "output"))
        pictures.mkdir()
        output.mkdir()
        posed = pycolmap.Reconstruction()
        for number, frame in enumerate(frames, start=1):  # one photograph at a time is in memory
            view = frame.whole_view()
            name = _add(posed, view.camera, number)
            (pictures / name).write_bytes(png(bytes_of(view.image)))
        _write_database(posed, database)
        features = pycolmap.FeatureExtractionOptions()
        features.use_gpu = False
        features.sift.estimate_affine_shape = True
        features.sift.domain_size_pooling = True
        pycolmap.extract_features(database, pictures, extraction_options=features)
        pycolmap.match_exhaustive(database, matching_options=matching(), verification_options=verification())
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = SEED
        options.triangulation.ignore_two_view_tracks = False
        model = pycolmap.triangulate_points(posed, database, pictures, output, options=options)
    points = points_of(model, _in_order(model))
    if points is None:
        raise InputError(
            f"expected places that two of the {len(frames)} training views show, found none that match; "
            "start from dense or random points, or choose views that overlap more"
        )
    return Points(points.xyz, points.rgb, points.observations, tuple(frame.name for frame in frames))


def matching() -> pycolmap.FeatureMatchingOptions:
    """Matching on the CPU, so that machines with and without a GPU give the same points."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    return options


def verification() -> pycolmap.TwoViewGeometryOptions:
    """RANSAC from a fixed seed."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


@contextmanager
def quiet() -> Iterator[None]:
    """Silence COLMAP's log, but for errors that end the process."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _add(model: pycolmap.Reconstruction, camera: Camera, number: int) -> str:
    """Give the model an image without points, and its camera, both of this number; returns the image's name."""
    model.add_camera_with_trivial_rig(_lens(camera, number))
    rotation, centre = camera.rotation.numpy(), camera.centre.numpy()
    pose = pycolmap.Rigid3d(np.concatenate([rotation, -(rotation @ centre)[:, None]], axis=1))
    name = f"{number:06d}.png"
    model.add_image_with_trivial_frame(pycolmap.Image(name, np.zeros((0, 2)), number, number), pose)
    return name


def _lens(camera: Camera, camera_id: int) -> pycolmap.Camera:
    size, params = {"width": camera.width, "height": camera.height}, [camera.fx, camera.fy, camera.cx, camera.cy]
    lens = pycolmap.Camera(camera_id=camera_id, model="PINHOLE", **size, params=params)
    lens.has_prior_focal_length = True  # known, so that pairs are verified with essential matrices
    return lens


def _write_database(model: pycolmap.Reconstruction, path: Path) -> None:
    """Write cameras and images under the ids of the model, by which `triangulate_points` finds them."""
    with closing(pycolmap.Database.open(path)) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            database.write_frame(frame, use_frame_id=True)
        for image in _in_order(model):
            database.write_image(image, use_image_id=True)


def _in_order(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [model.images[i] for i in sorted(model.images)]
