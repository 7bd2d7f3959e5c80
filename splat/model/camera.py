"""A pinhole camera.

World to camera: `x_cam = R (x_world - centre)`, +x right, +y down, +z forward (OpenCV, COLMAP).  Pixels: the centre of
pixel (column i, row j) lies at (i + 0.5, j + 0.5); focal lengths and principal point are in pixels.

The geometry of a capture, derived from its cameras.

common target   c, the point nearest to all optical axes in the least-squares sense:
                sum_i (1 - f_i f_i^T) (c - t_i) = 0,   t_i a camera's centre, f_i its viewing direction
forward facing  all viewing directions lie within 45 degrees of their mean.  Any two are then less than 90 degrees apart, so
                that the straight way between two cameras at distance r from their target stays farther than
                r cos 45 = 0.7 r from the target
surrounding     not forward facing, and with a common target in front of every camera: a 360 capture.  Cameras that look
                outwards from one place (a panorama) are neither
down            the mean of the cameras' down axes, with its components along their right axes removed.  The right axes of
                level cameras are horizontal, so down is exact for them, however unevenly they stand about the scene
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, isfinite, radians

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr

ROUND_OFF = 1e-4  # of a rotation in a file, |R R^T - 1|
FORWARD_FACING_ANGLE = 45.0  # degrees; LLFF captures stay within about 20, inward orbits exceed 90
LEVEL = 1e-6  # squared sine of the largest roll of a level camera


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
    one = torch.eye(3, dtype=matrix.dtype)
    apart = [float((square / scale - one).abs().max()) for scale in (1, square.trace() / 3)]
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


@dataclass(frozen=True, eq=False)
class CaptureGeometry:
    """Sizes and directions of a set of cameras; world units, world frame.

    radius: the cameras' mean distance from their centroid (0 for a single camera).  target: their common target, None
    where there is none; orbit: the cameras' mean distance from it.  down: unit.
    """

    radius: float
    target: Float[Tensor, "3"] | None
    orbit: float | None
    down: Float[Tensor, "3"]
    surrounding: bool


def capture_geometry(cameras: Sequence[Camera]) -> CaptureGeometry:
    """The geometry of at least one camera."""
    if not cameras:
        raise ValueError("expected at least one camera, got none")
    centres = torch.stack([camera.centre for camera in cameras])
    target = common_target(cameras)
    return CaptureGeometry(
        radius=float((centres - centres.mean(dim=0)).norm(dim=1).mean()),
        target=target,
        orbit=None if target is None else float((centres - target).norm(dim=1).mean()),
        down=_down(cameras),
        surrounding=target is not None and not forward_facing(cameras),
    )


def common_target(cameras: Sequence[Camera]) -> Float[Tensor, "3"] | None:
    """The point nearest to all optical axes; None where they are parallel or it lies behind a camera."""
    axes = torch.stack([camera.forward for camera in cameras])
    centres = torch.stack([camera.centre for camera in cameras])
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]  # projects the optical axis out
    normal = across.sum(dim=0)
    if float(torch.linalg.eigvalsh(normal)[0]) > 1e-6 * len(cameras):
        target = torch.linalg.solve(normal, (across @ centres[:, :, None]).sum(dim=0)[:, 0])
        if bool((((target - centres) * axes).sum(dim=1) > 0).all()):
            return target
    return None


def forward_facing(cameras: Sequence[Camera]) -> bool:
    """Whether all viewing directions lie within 45 degrees of their mean."""
    directions = torch.stack([camera.forward for camera in cameras])
    mean = directions.mean(dim=0)
    return bool((directions @ mean > cos(radians(FORWARD_FACING_ANGLE)) * mean.norm()).all())


def _down(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """(A + LEVEL)^-1 times the mean down axis, normalised; A: the second moment of the right axes."""
    right = torch.stack([camera.rotation[0] for camera in cameras])
    mean = torch.stack([camera.rotation[1] for camera in cameras]).mean(dim=0)
    moment = right.T @ right / len(cameras)
    down = torch.linalg.solve(moment + LEVEL * torch.eye(3, dtype=right.dtype), mean)
    length = down.norm()
    return down / length if length > 0 else cameras[0].rotation[1]  # cameras whose down axes cancel have no common one
