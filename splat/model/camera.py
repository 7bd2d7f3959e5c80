"""A pinhole camera.

World to camera: `x_cam = R (x_world - centre)`, +x right, +y down, +z forward (OpenCV, COLMAP).  Pixels: the centre of
pixel (column i, row j) lies at (i + 0.5, j + 0.5); focal lengths and principal point are in pixels.
"""

from dataclasses import dataclass, replace
from math import isfinite

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr

ROUND_OFF = 1e-4  # of a rotation in a file, |R R^T - 1|


@dataclass(frozen=True, repr=False)
class Camera(ShortRepr):
    """rotation: world to camera, float64; centre: camera centre in world units, float64; the rest in pixels.

    InputError where the rotation is none, or a number is not finite or, but for centre and principal point, not positive.

    >>> Camera(torch.eye(3), torch.zeros(3), fx=50.0, fy=50.0, cx=16.0, cy=12.0, width=32, height=24).resized(16, 12).fx
    25.0
    """

    rotation: Float[Tensor, "3 3"]
    centre: Float[Tensor, "3"]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if fault := _fault_of_rotation(self.rotation):
            raise InputError(f"expected a rotation matrix, got one that {fault}: {self.rotation.tolist()}")
        if not (self.fx > 0 and self.fy > 0 and self.width > 0 and self.height > 0):
            raise InputError(
                f"expected positive focal lengths and image size, got {self.fx}, {self.fy}, {self.width}, {self.height}"
            )
        numbers = (*self.centre.tolist(), self.fx, self.fy, self.cx, self.cy)
        if not all(map(isfinite, numbers)):
            raise InputError(f"expected a finite centre, focal lengths and principal point, got {numbers}")

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera with its image resampled to width x height pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    @property
    def forward(self) -> Float[Tensor, "3"]:
        """The viewing direction (unit, world frame): R^T e_z."""
        return self.rotation[2]


def _fault_of_rotation(matrix: Float[Tensor, "3 3"]) -> str:
    """What keeps a matrix from being a rotation; empty where it is one."""
    square = matrix @ matrix.T
    apart = [
        float((square / scale - torch.eye(3, dtype=matrix.dtype)).abs().max()) for scale in (1, square.trace() / 3)
    ]
    if not apart[0] < ROUND_OFF:
        scaled = f"scales by {float(square.trace() / 3) ** 0.5:.6g}, " if apart[1] < ROUND_OFF else ""
        return f"{scaled}has |R R^T - 1| = {apart[0]:.1e}"
    return "mirrors: its axes are left-handed" if torch.linalg.det(matrix) < 0 else ""


def look_at(centre: Float[Tensor, "3"], target: Float[Tensor, "3"], down: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """World-to-camera rotation of a level camera at a centre that looks at a target: +x is perpendicular to `down`.

    Raises InputError where the target is the centre, or straight above or below it.
    """
    forward = (target - centre) / (target - centre).norm()
    right = torch.linalg.cross(down, forward)
    if not right.norm() > 1e-9 * down.norm():
        raise InputError(
            f"expected a target away from the centre, not along {down.tolist()} from it, got {target.tolist()}"
        )
    right = right / right.norm()
    return torch.stack([right, torch.linalg.cross(forward, right), forward])


def rotation_about(vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation by |vector| radians about a vector."""
    return torch.from_numpy(scipy.spatial.transform.Rotation.from_rotvec(vector.numpy()).as_matrix()).to(vector.dtype)


def slerp(first: Float[Tensor, "3 3"], second: Float[Tensor, "3 3"], t: float) -> Float[Tensor, "3 3"]:
    """first (first^T second)^t: the shorter geodesic on SO(3), first at 0, second at 1, any real t.

    For rotations half a turn apart, both ways are equally short; SciPy always takes the same.
    """
    vector = scipy.spatial.transform.Rotation.from_matrix((first.T @ second).numpy()).as_rotvec()
    return first @ rotation_about(t * torch.from_numpy(vector))
