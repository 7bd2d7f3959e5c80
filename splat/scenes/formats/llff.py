"""Scenes from LLFF's `poses_bounds.npy`: one row of 17 numbers for each image, in the order of the sorted file names.

The first 15 are a 3 x 5 matrix [R | t | h w f]: the columns of R are the camera's axes in the world, in the order
[down, right, backwards]; t is the camera's centre; h, w (px) and f (px) are those of the image that the poses were
computed from, principal point in the middle.  The last two are the nearest and the farthest depth of the content.
"""

from pathlib import Path

import numpy as np
import torch

from landscape.errors import InputError
from splat.model.untrusted import read_array, require_content
from splat.scenes.images import Photo, checked_lens, image_files, image_folder

POSES = "poses_bounds.npy"


def read_llff(root: Path, images: str | None = None) -> list[Photo]:
    """Photographs sorted by name, with the depth range of each."""
    require_content(path := root / POSES)
    try:
        with path.open("rb") as stream:
            rows = read_array(stream).astype(np.float64)
    except (ValueError, OSError) as error:
        raise InputError(
            f"expected an array in {path}, cannot read it: {error}; make it again with LLFF's imgs2poses"
        ) from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise InputError(f"expected finite rows of 17 numbers in {path}, got shape {rows.shape}; see LLFF's imgs2poses")
    folder = image_folder(root, images)
    files = image_files(folder)
    if len(files) != len(rows):
        raise InputError(
            f"expected one image for each of the {len(rows)} poses in {path}, got {len(files)} in {folder}; "
            "restore the images that the poses were computed from, or name their folder with --images"
        )
    for file, (near, far) in zip(files, rows[:, 15:]):
        if not 0 < near < far:
            raise InputError(
                f"expected 0 < nearest < farthest depth at the end of each row of {path}, got {near:g} and {far:g} for "
                f"{file.name!r}; make it again with LLFF's imgs2poses"
            )
    return [_photo(path, row) for path, row in zip(files, rows)]


def _photo(path: Path, row: np.ndarray) -> Photo:
    matrix = row[:15].reshape(3, 5)
    down, right, backwards, centre, (height, width, focal) = matrix.T
    lens = checked_lens("SIMPLE_PINHOLE", (width, height), [focal, width / 2, height / 2], path.name)
    rotation = torch.from_numpy(np.stack([right, down, -backwards]))
    depth_range = (float(row[15]), float(row[16]))
    return Photo(path.name, path, lens, rotation, torch.from_numpy(centre.copy()), depth_range=depth_range)
