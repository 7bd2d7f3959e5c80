"""Scenes of DTU (Jensen et al. 2014).

    Rectified/scanN/rect_III_L_rX.png       III the view from 001, L the light (0 to 6, or max), X 5000, or 7000 from view 50
    Calibration/cal18/pos_III.txt           the 3 x 4 matrix P = K [R | -R c] of view III, px and mm, for all scans
    submission_data/idrmasks/scanN/         object masks of the test views, 000.png for view 001, in some scans in mask/

Light 3 is used, as in pixelNeRF and RegNeRF (`internal/datasets.py`).  Sparse-view 3DGS (DNGaussian, CoR-GS) runs COLMAP on
these images instead; such a scene is read as any COLMAP model, and keeps the names of the images, and so the numbers
(`dtu_number` in `splat/scenes/layers.py`).
"""

from pathlib import Path

import numpy as np
import pycolmap
import scipy
import torch

from landscape.errors import InputError
from splat.model.untrusted import read_text
from splat.scenes.images import Photo, image_header

LIGHT = 3
CALIBRATION = Path("Calibration", "cal18")
MASKS = Path("submission_data", "idrmasks")
LARGEST_SKEW = 0.5  # px that the skew of K may move a pixel at the edge; it is round-off of the files, and dropped


def is_dtu(root: Path) -> bool:
    """Whether a folder is one of `Rectified`."""
    return bool(_image_files(root))


def mask_folder(root: Path) -> Path:
    """Folder of the masks of a scan, beside `Rectified`."""
    return root.resolve().parents[1] / MASKS / root.resolve().name


def _image_files(root: Path) -> list[Path]:
    return sorted(root.glob(f"rect_[0-9][0-9][0-9]_{LIGHT}_r[0-9]*.png"))


def read_dtu(root: Path) -> list[Photo]:
    """The photographs of a scan, in order."""
    folder = root.resolve().parents[1] / CALIBRATION
    photos = []
    for path in _image_files(root):
        position = folder / f"pos_{path.name.split('_')[1]}.txt"
        if not position.is_file():
            raise FileNotFoundError(
                f"expected DTU's calibration of {path.name} in {position}, found no such file; unpack SampleSet's "
                "Calibration beside Rectified, or use a COLMAP model of the scan"
            )
        try:
            matrix = np.loadtxt(read_text(position).splitlines(), dtype=np.float64).reshape(3, 4)
        except ValueError as error:
            raise InputError(f"expected a 3 x 4 matrix in {position}, cannot read it: {error}") from error
        if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix[:, :3]) < 3:
            raise InputError(f"expected a finite matrix of a camera in {position}, got {matrix.tolist()}")
        calibration, rotation, centre = decompose(matrix)
        size = image_header(path)[0]
        skew = abs(calibration[0, 1]) * size[1] / calibration[1, 1]
        if not skew < LARGEST_SKEW:
            raise InputError(f"expected a camera without skew in {position}, got one that shears by {skew:.2g} px")
        fx, fy, cx, cy = calibration[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        lens = pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=[fx, fy, cx, cy])
        photos.append(Photo(path.name, path, lens, torch.from_numpy(rotation), torch.from_numpy(centre)))
    return photos


def decompose(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K (upper triangular, positive diagonal, K_33 = 1), R (a rotation) and c of a matrix s K [R | -R c], any s."""
    calibration, rotation = scipy.linalg.rq(matrix[:, :3])
    signs = np.sign(np.diag(calibration))
    calibration, rotation = calibration * signs, signs[:, None] * rotation
    if np.linalg.det(rotation) < 0:  # s < 0
        rotation = -rotation
    return calibration / calibration[2, 2], rotation, -np.linalg.solve(matrix[:, :3], matrix[:, 3])
