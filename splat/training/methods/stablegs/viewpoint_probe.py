"""Viewpoint-space probes of StableGS (Sec. 3.4, Eqs. (17)-(19)): one composite pose near each training view.

R_m      rotation from world to camera, x_cam = R_m (x_world - t_m)
t_m      camera centre, world units
e_z      viewing direction in the camera's frame

interpolation   n the nearest other training view, one t ~ U(t_min, t_max) for both:
                R = Slerp(R_m, R_n, t) = R_m (R_m^T R_n)^t,   c = (1 - t) t_m + t t_n;   without it R = R_m, c = t_m
parallax        c += delta p,   delta ~ N(0, (parallax_sigma r)^2), r the cameras' mean distance from their centroid;
                p = R_m^T (cos phi, sin phi, 0), phi ~ U(0, 2 pi): perpendicular to the viewing direction R_m^T e_z
                (in the paper's `R e_z`, R is camera to world)
shell           in a 360 capture, in place of interpolation and parallax: c = target + orbit u, u ~ Uniform(S^2), R looks at
                the target, level.  As in the paper this is the whole sphere: where an object is seen from above only, more
                than half of it lies below all cameras
edge rotation   R <- exp(theta R R_m^T n) R,   theta ~ N(0, theta_sigma^2), n = (n_x, n_y, 0) the axis in view m's camera
                frame, from its occlusion edges.  Equal to R exp(theta R_m^T n), the paper's formula with n in world axes
axis            "normal" (the paper's): across the edges; a rotation about it moves the image along them.  "tangent": along
                the edges; a rotation about it moves the image across them.  Rotation alone makes no parallax

Randomness: every pose takes the same seven numbers from the generator, in the same order, whatever modes are on.  So switching
one mode does not change the draws of the others, and ablations differ in nothing else.

The dominant occlusion edge of a depth map (StableGS, Eq. (16)).

depth           sum of weight times z over sum of weight, along +z of the camera: the mean depth D, world units
gradient        Sobel, world units per pixel, (d/dx, d/dy): +x right, +y down
pixels in use   those whose 3 x 3 neighbourhood is covered everywhere (alpha at least COVERED): at the border to empty
                space there is no second surface whose order could be wrong, and the mean depth of faint pixels is noise
edges           the share STRONGEST of the pixels in use with the largest gradient, if it is above FLAT
structure       S = sum over edges of grad D grad D^T, with eigenvalues a >= b; its first eigenvector is the normal
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atan2, ceil, cos, pi, radians, sin
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera, CaptureGeometry, look_at, rotation_about, slerp
from splat.model.typed import NonNegative, Settings

Position = Annotated[float, Meta(ge=-1, le=2)]
COVERED = 0.5
STRONGEST = 0.05
FLAT = 1e-4  # relative gradient of depth, per pixel: above round-off of compositing hundreds of splats in float32


@dataclass(frozen=True)
class ViewpointSettings(Settings):
    """Modes and magnitudes of the probes.

    edge_rotation, interpolation, parallax: whether each mode is on (in a 360 capture, parallax switches the shell).
    capture: "forward", "360" (with the shell), or "auto", decided by the cameras.
    t_min, t_max: range of the interpolation: 0 the view, 1 its neighbour; it extrapolates below 0 and above 1.
    theta_sigma: of the edge rotation, degrees.  parallax_sigma: in units of the cameras' mean distance from their centroid.
    axis: of the edge rotation, the edges' normal or tangent.
    """

    edge_rotation: bool = True
    interpolation: bool = True
    parallax: bool = True
    capture: Literal["auto", "forward", "360"] = "auto"
    t_min: Position = -0.2
    t_max: Position = 1.2
    theta_sigma: Annotated[float, Meta(ge=0, le=60)] = 2.0
    parallax_sigma: NonNegative = 0.1
    axis: Literal["normal", "tangent"] = "normal"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.t_min > self.t_max:
            raise InputError(
                f"expected t_min <= t_max (0 is the view, 1 its neighbour), got {self.t_min} and {self.t_max}"
            )


def composite_pose(
    cameras: Sequence[Camera],
    m: int,
    normal: Float[Tensor, "2"],
    geometry: CaptureGeometry,
    settings: ViewpointSettings = ViewpointSettings(),
    *,
    generator: torch.Generator,
) -> Camera:
    """The probe of training view m: a camera with its intrinsics and size, at the pose of Eqs. (17)-(19).

    normal: of view m's edges, in its pixels, from `dominant_edge`; zero, for no edge rotation, where it has none.
    geometry: `capture_geometry(cameras)`.  A single camera has no neighbour and radius 0: only edge rotation moves it.
    InputError where a 360 capture is asked for but the cameras have no common target.
    """
    view = cameras[m]
    t, phi = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    gauss = torch.randn(5, generator=generator, dtype=torch.float64)
    theta, delta = gauss[:2].tolist()
    surrounding = geometry.surrounding if settings.capture == "auto" else settings.capture == "360"
    if settings.parallax and surrounding:
        rotation, centre = _on_shell(geometry, gauss[2:])
    else:
        rotation, centre = view.rotation, view.centre
        neighbour = nearest_camera(cameras, m) if settings.interpolation else None
        if neighbour is not None:
            t = settings.t_min + (settings.t_max - settings.t_min) * t
            rotation = slerp(rotation, cameras[neighbour].rotation, t)
            centre = (1 - t) * centre + t * cameras[neighbour].centre
        if settings.parallax:
            sideways = torch.tensor([cos(2 * pi * phi), sin(2 * pi * phi), 0], dtype=rotation.dtype) @ view.rotation
            centre = centre + delta * settings.parallax_sigma * geometry.radius * sideways
    if settings.edge_rotation:
        angle = theta * radians(settings.theta_sigma)
        axis = rotation @ view.rotation.T @ edge_axis(normal, view, settings.axis)
        rotation = rotation_about(angle * axis) @ rotation
    return replace(view, rotation=rotation, centre=centre)


def nearest_camera(cameras: Sequence[Camera], m: int) -> int | None:
    """Index of the other camera with the smallest angle between its optical axis and m's; of equal ones, the nearest.

    None for a single camera.
    """
    axis, centre = cameras[m].forward, cameras[m].centre

    def distance(n: int) -> tuple[float, float]:
        # the chord is accurate where the cosine is not; rounded, so that ties are ties despite round-off
        return round(float((cameras[n].forward - axis).norm()), 9), float((cameras[n].centre - centre).norm())

    return min((n for n in range(len(cameras)) if n != m % len(cameras)), key=distance, default=None)


def edge_axis(
    normal: Float[Tensor, "2"], camera: Camera, axis: Literal["normal", "tangent"] = "normal"
) -> Float[Tensor, "3"]:
    """Unit axis (x, y, 0) in the camera's frame of an edge's normal in pixels, or of its tangent; zero stays zero.

    A gradient per pixel, times the focal length, is a gradient per unit of x / z.
    """
    x, y = float(normal[0]) * camera.fx, float(normal[1]) * camera.fy
    lifted = (x, y, 0.0) if axis == "normal" else (-y, x, 0.0)
    return torch.nn.functional.normalize(torch.tensor(lifted, dtype=camera.rotation.dtype), dim=0)


def _on_shell(geometry: CaptureGeometry, gauss: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Rotation and centre on the sphere about the target, in the direction of an isotropic Gaussian draw."""
    if geometry.target is None or geometry.orbit is None:
        raise InputError(
            "expected cameras that look at a common place for a 360 capture, got parallel or diverging ones; "
            "use capture 'forward'"
        )
    centre = geometry.target + geometry.orbit * gauss / gauss.norm()
    return look_at(centre, geometry.target, geometry.down), centre


@torch.no_grad()
def dominant_edge(depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "2"]:
    """Unit normal (x, y) of the strongest depth edges, across them in the image.

    depth (not divided by alpha), alpha: of `splat.render.render.render(..., depth=True)`.  The result is detached from
    autograd.  The sign of the normal is arbitrary: x >= 0.  Without edges it is 0.
    """
    gradient, relative = _gradients(depth, alpha)
    steep = relative > FLAT
    if not bool(steep.any()):
        return depth.new_zeros(2)
    length = gradient.norm(dim=1)
    threshold = length.kthvalue(len(length) - ceil(STRONGEST * len(length)) + 1).values
    x, y = gradient[steep & (length >= threshold)].double().unbind(-1)
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    angle = atan2(2 * xy, xx - yy) / 2  # of the first eigenvector of [[xx, xy], [xy, yy]], in [-90, 90] degrees
    return depth.new_tensor([cos(angle), sin(angle)])


def _gradients(
    depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
    """Gradient of the mean depth at the pixels in use, and its length relative to the depth."""
    if min(depth.shape) < 3:
        return depth.new_zeros(0, 2), depth.new_zeros(0)
    mean = depth / alpha.clamp_min(COVERED)
    faintest = -torch.nn.functional.max_pool2d(-alpha[None], 3, stride=1)[0]
    use = faintest >= COVERED
    gradient = _sobel(mean)[:, use].T
    return gradient, gradient.norm(dim=1) / mean[1:-1, 1:-1][use]


def _sobel(x: Float[Tensor, "h w"]) -> Float[Tensor, "2 h-2 w-2"]:
    """d/dx and d/dy, exact on a plane; by slices, since convolutions on a GPU round to 10 bits (TF32), far above FLAT."""
    across, down = x[:, 2:] - x[:, :-2], x[2:] - x[:-2]
    dx = across[:-2] + 2 * across[1:-1] + across[2:]
    dy = down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]
    return torch.stack([dx, dy]) / 8
