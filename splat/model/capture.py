"""The geometry of a capture, derived from its cameras.

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
from dataclasses import dataclass
from math import cos, radians

import torch
from jaxtyping import Float
from torch import Tensor

from splat.model.camera import Camera

FORWARD_FACING_ANGLE = 45.0  # degrees; LLFF captures stay within about 20, inward orbits exceed 90
LEVEL = 1e-6  # squared sine of the largest roll of a level camera


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
