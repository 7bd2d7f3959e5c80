"""EWA projection and SH colour of one Gaussian, and their adjoints: formulas for floats, vectors and dual numbers.

The values are those of `reference.py`, with the 2 x 2 covariance of a splat as a product of two rows:

    (x, y, z) = R (mean - centre)             the mean in the camera's frame; in the image (fx x / z + cx, fy y / z + cy)
    u, v      = x / z, y / z                  clamped to a little beyond the image, in the covariance alone
    m0 m1 m2                                  the Gaussian's axes in the camera's frame, as long as its scales
    r1        = fx / z (row_x - u row_z)      rows over the three axes: row_x = (m0.x, m1.x, m2.x), ...
    r2        = fy / z (row_y - v row_z)
    Sigma     = [[r1.r1, r1.r2], [r1.r2, r2.r2]] + blur 1,   conic Q = Sigma^-1 = [[a, b], [b, c]]

A bar marks an adjoint: the derivative of some scalar in the barred quantity.  Applied to dual numbers, `geometry` gives its
Jacobian, and `geometry_adjoint` the Hessian of `adjoint . geometry`; likewise for SH.  3 x 3 matrices are tuples of three rows;
rows and points are tuples.

A splat may be larger than the image by many orders of magnitude, and a needle is so along one direction only.  Two measures
keep the digits of both:

- r1 and r2 are computed times `shrink` = 1 / max(1, size of the splat in px), so that their fourth powers, in the determinant,
  stay in the range of float32.  The blur becomes beta = blur shrink^2, and the conic is shrink^2 times that of these rows.
- The adjoint needs the rows of Q (r1; r2), of a length of 1 / s for a needle of length s.  Summed as a r1 + b r2 they would be
  differences of numbers of size s.  With n = r1 x r2 and det = n.n + beta (r1.r1 + r2.r2) + beta^2, nothing cancels in

      q1 = (beta r1 + r2 x n) / det,   q2 = (beta r2 + n x r1) / det
"""

from typing import Any, NamedTuple

import numpy as np

from splat.backend.cpu.dual import exp, select, sqrt, value_of
from splat.backend.cpu.jit import formula
from splat.model.camera import Camera
from splat.model.harmonics import Y00, Y1, Y2A, Y2B, Y2C, Y3A, Y3B, Y3C, Y3D
from splat.model.settings import Antialias, RenderSettings

GEOMETRY = 10  # mean 3, log-scales 3, quaternion 4
SYMMETRIC = GEOMETRY * (GEOMETRY + 1) // 2


class ProjectionJacobian(NamedTuple):
    """The derivatives of a view's splats, one row for each Gaussian at index (m,); arrays or tensors.

    jacobian (5, 10): QU, QV, QUU, QUV, QVV (`whitening.py`) in mean, log-scales, quaternion; logit_slope: Q0 in the opacity
    logit; opacity_slope (10,): Q0 in the geometry, of length 0 where nothing is antialiased.  harmonic (16,) and slope (16, 3),
    of the harmonics in the mean; visible (3,): 1 where the colour is not clamped at 0; colour_slope (3, 3): of the colour in
    the mean, without that clamp.
    Second order, with the adjoint of the splat: curvature (55,), lower triangle of the geometry's (10, 10); logit_curvature;
    opacity_curvature: of logit and geometry, as long as opacity_slope; colour_bar (3,): adjoint of the colour before its clamp.
    """

    index: Any
    jacobian: Any
    curvature: Any
    harmonic: Any
    slope: Any
    colour_bar: Any
    visible: Any
    colour_slope: Any
    logit_slope: Any
    logit_curvature: Any
    opacity_slope: Any
    opacity_curvature: Any


def row_shapes(*, antialiased: bool) -> tuple[tuple[int, ...], ...]:
    """Shapes of a Gaussian's row in each field but index."""
    opacity = (GEOMETRY if antialiased else 0,)
    return (5, GEOMETRY), (SYMMETRIC,), (16,), (16, 3), (3,), (3,), (3, 3), (), (), opacity, opacity


class Lens(NamedTuple):
    """A camera as the kernels read it: rotation (9,) world to camera, row by row; centre (3,); pixels; thresholds.

    floor, epsilon: of the antialiased opacities' factor (`antialias.py`); a floor of 1 switches it off.
    """

    rotation: np.ndarray
    centre: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    limit_x: float
    limit_y: float
    blur: float
    floor: float
    epsilon: float
    near: float


FACTORS: dict[Antialias, tuple[float, float]] = {
    "none": (1.0, 0.0), "mip": (2.5e-5, 0.0), "mip-plain": (1e-30, 0.0), "mip-splatting": (0.0, 1e-6),
}  # fmt: skip  # floor and epsilon


def lens_of(camera: Camera, settings: RenderSettings) -> Lens:
    """The camera as the kernels read it."""
    rotation, centre = (part.double().reshape(-1).numpy().copy() for part in (camera.rotation, camera.centre))
    pinhole = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    limit_x = settings.fov_clamp * camera.width / (2 * camera.fx)
    limit_y = settings.fov_clamp * camera.height / (2 * camera.fy)
    thresholds = (float(settings.blur), *FACTORS[settings.antialias], float(settings.near))
    return Lens(rotation, centre, *pinhole, limit_x, limit_y, *thresholds)


@formula
def dot(x, y):
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@formula
def plus(x, y):
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


@formula
def scaled(x, factor):
    return x[0] * factor, x[1] * factor, x[2] * factor


@formula
def cross(x, y):
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@formula
def to_camera(lens, x):
    """R x."""
    r = lens.rotation
    return (
        r[0] * x[0] + r[1] * x[1] + r[2] * x[2],
        r[3] * x[0] + r[4] * x[1] + r[5] * x[2],
        r[6] * x[0] + r[7] * x[1] + r[8] * x[2],
    )


@formula
def to_world(lens, x):
    """R^T x."""
    r = lens.rotation
    return (
        r[0] * x[0] + r[3] * x[1] + r[6] * x[2],
        r[1] * x[0] + r[4] * x[1] + r[7] * x[2],
        r[2] * x[0] + r[5] * x[1] + r[8] * x[2],
    )


@formula
def offset_from(lens, mean):
    return mean[0] - lens.centre[0], mean[1] - lens.centre[1], mean[2] - lens.centre[2]


@formula
def clamped(x, limit):
    """x clamped to [-limit, limit]; duals lose their tangent where the clamp holds."""
    below = select(value_of(x) < -limit, x * 0.0 - limit, x)
    return select(value_of(x) > limit, x * 0.0 + limit, below)


@formula
def columns_of_rotation(unit):
    """The three columns of the rotation of a unit quaternion w x y z: the axes of the Gaussian."""
    w, x, y, z = unit
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@formula
def scales_of(log_scales):
    return exp(log_scales[0]), exp(log_scales[1]), exp(log_scales[2])


@formula
def projected_axes(lens, mean, scales, quat):
    """Quantities that `geometry` and its adjoint share; scales: standard deviations.

    (x, y, z), 1 / z, (u, v), the unit quaternion, 1 / |quat|, the scales, (m0, m1, m2), shrink, and r1, r2 times shrink.
    """
    x, y, z = to_camera(lens, offset_from(lens, mean))
    depth = 1.0 / z
    u, v = clamped(x * depth, lens.limit_x), clamped(y * depth, lens.limit_y)
    inverse_norm = 1.0 / sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    unit = quat[0] * inverse_norm, quat[1] * inverse_norm, quat[2] * inverse_norm, quat[3] * inverse_norm
    c0, c1, c2 = columns_of_rotation(unit)
    m0 = scaled(to_camera(lens, c0), scales[0])
    m1 = scaled(to_camera(lens, c1), scales[1])
    m2 = scaled(to_camera(lens, c2), scales[2])
    longest = max(value_of(scales[0]), max(value_of(scales[1]), value_of(scales[2])))
    shrink = 1.0 / max(1.0, longest * max(lens.fx, lens.fy) * value_of(depth))
    gain_x, gain_y = (shrink * lens.fx) * depth, (shrink * lens.fy) * depth
    r1 = (gain_x * (m0[0] - u * m0[2]), gain_x * (m1[0] - u * m1[2]), gain_x * (m2[0] - u * m2[2]))
    r2 = (gain_y * (m0[1] - v * m0[2]), gain_y * (m1[1] - v * m1[2]), gain_y * (m2[1] - v * m2[2]))
    return (x, y, z), depth, (u, v), unit, inverse_norm, scales, (m0, m1, m2), shrink, r1, r2


@formula
def conic_of(r1, r2, blur, shrink):
    """The conic a, b, c; and q1, q2 of the shrunken rows, with their own Q."""
    beta = blur * shrink * shrink
    xx, xy, yy = dot(r1, r1), dot(r1, r2), dot(r2, r2)
    normal = cross(r1, r2)
    inverse = 1.0 / (dot(normal, normal) + beta * (xx + yy) + beta * beta)
    full = inverse * (shrink * shrink)
    q1 = scaled(plus(scaled(r1, beta), cross(r2, normal)), inverse)
    q2 = scaled(plus(scaled(r2, beta), cross(normal, r1)), inverse)
    return ((yy + beta) * full, -(xy * full), (xx + beta) * full), q1, q2


@formula
def geometry(lens, mean, log_scales, quat):
    """Mean x, y (px) and conic a, b, c."""
    (x, y, _z), depth, _uv, _unit, _inverse, _scales, _axes, shrink, r1, r2 = projected_axes(
        lens, mean, scales_of(log_scales), quat
    )
    (a, b, c), _q1, _q2 = conic_of(r1, r2, lens.blur, shrink)
    return lens.fx * x * depth + lens.cx, lens.fy * y * depth + lens.cy, a, b, c


@formula
def geometry_adjoint(lens, mean, log_scales, quat, bar):
    """The adjoints of mean, log_scales and quat (ten numbers), given those of mean x, y and conic a, b, c (five)."""
    shared = projected_axes(lens, mean, scales_of(log_scales), quat)
    conic, q1, q2 = conic_of(shared[8], shared[9], lens.blur, shared[7])
    return axes_adjoint(lens, shared, rows_adjoint(conic, q1, q2, bar), bar)


@formula
def rows_adjoint(conic, q1, q2, bar):
    """The adjoints of the shrunken rows r1 and r2, given those of the conic, bar[2:5]."""
    # d conic = -Q dSigma Q, so the adjoint of (r1; r2) is -2 Q G Q (r1; r2) with G = [[a_bar, b_bar / 2], [b_bar / 2, c_bar]];
    # that of the shrunken rows is the same with their q1, q2: what they lack cancels
    a, b, c = conic
    half = 0.5 * bar[3]
    p, q, s, t = a * bar[2] + b * half, a * half + b * bar[4], b * bar[2] + c * half, b * half + c * bar[4]
    return plus(scaled(q1, -2.0 * p), scaled(q2, -2.0 * q)), plus(scaled(q1, -2.0 * s), scaled(q2, -2.0 * t))


@formula
def axes_adjoint(lens, shared, rows_bar, bar):
    """The adjoints of mean, log-scales and quat, given those of the rows, and of the mean in the image, bar[:2]."""
    (x, y, _z), depth, (u, v), unit, inverse_norm, scales, (m0, m1, m2), shrink, r1, r2 = shared
    r1_bar, r2_bar = rows_bar
    # r1 = fx / z (row_x - u row_z), r2 = fy / z (row_y - v row_z), the rows those of the axes m
    along_x, along_y = scaled(r1_bar, (shrink * lens.fx) * depth), scaled(r2_bar, (shrink * lens.fy) * depth)
    row_z = (m0[2], m1[2], m2[2])
    u_bar, v_bar = -dot(along_x, row_z), -dot(along_y, row_z)
    u_bar = select(abs(value_of(x * depth)) > lens.limit_x, u_bar * 0.0, u_bar)
    v_bar = select(abs(value_of(y * depth)) > lens.limit_y, v_bar * 0.0, v_bar)
    x_bar, y_bar = (lens.fx * bar[0] + u_bar) * depth, (lens.fy * bar[1] + v_bar) * depth
    z_bar = -((dot(r1_bar, r1) + dot(r2_bar, r2)) * depth) - (x * x_bar + y * y_bar) * depth
    mean_bar = to_world(lens, (x_bar, y_bar, z_bar))
    n0 = (along_x[0], along_y[0], -(u * along_x[0] + v * along_y[0]))
    n1 = (along_x[1], along_y[1], -(u * along_x[1] + v * along_y[1]))
    n2 = (along_x[2], along_y[2], -(u * along_x[2] + v * along_y[2]))
    log_scales_bar = (dot(n0, m0), dot(n1, m1), dot(n2, m2))
    c0 = scaled(to_world(lens, n0), scales[0])
    c1 = scaled(to_world(lens, n1), scales[1])
    c2 = scaled(to_world(lens, n2), scales[2])
    return mean_bar, log_scales_bar, quaternion_adjoint(unit, inverse_norm, c0, c1, c2)


@formula
def quaternion_adjoint(unit, inverse_norm, c0, c1, c2):
    """The adjoint of the stored quaternion, given those of the columns of its rotation matrix."""
    w, x, y, z = unit
    w_bar = 2.0 * (z * (c0[1] - c1[0]) + y * (c2[0] - c0[2]) + x * (c1[2] - c2[1]))
    x_bar = 2.0 * (y * (c0[1] + c1[0]) + z * (c0[2] + c2[0]) + w * (c1[2] - c2[1]) - 2.0 * x * (c1[1] + c2[2]))
    y_bar = 2.0 * (x * (c0[1] + c1[0]) + z * (c1[2] + c2[1]) + w * (c2[0] - c0[2]) - 2.0 * y * (c0[0] + c2[2]))
    z_bar = 2.0 * (x * (c0[2] + c2[0]) + y * (c1[2] + c2[1]) + w * (c0[1] - c1[0]) - 2.0 * z * (c0[0] + c1[1]))
    radial = w * w_bar + x * x_bar + y * y_bar + z * z_bar  # the normalisation removes it
    return (
        (w_bar - radial * w) * inverse_norm,
        (x_bar - radial * x) * inverse_norm,
        (y_bar - radial * y) * inverse_norm,
        (z_bar - radial * z) * inverse_norm,
    )


# --- spherical harmonics ----------------------------------------------------------------------------------------------


@formula
def direction_of(lens, mean):
    """The unit direction from the camera to the mean, and 1 / distance."""
    offset = offset_from(lens, mean)
    inverse = 1.0 / sqrt(dot(offset, offset))
    return scaled(offset, inverse), inverse


@formula
def basis(direction):
    """The sixteen harmonics (`harmonics.py`); lower degrees use the first ones."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    return (
        x * 0.0 + Y00,
        -Y1 * y,
        Y1 * z,
        -Y1 * x,
        Y2A * (x * y),
        -Y2A * (y * z),
        Y2B * (2.0 * zz - xx - yy),
        -Y2A * (x * z),
        Y2C * (xx - yy),
        -Y3A * (y * (3.0 * xx - yy)),
        Y3B * (x * y * z),
        -Y3C * (y * (4.0 * zz - xx - yy)),
        Y3D * (z * (2.0 * zz - 3.0 * xx - 3.0 * yy)),
        -Y3C * (x * (4.0 * zz - xx - yy)),
        (Y3B / 2) * (z * (xx - yy)),
        -Y3A * (x * (xx - 3.0 * yy)),
    )


@formula
def direction_adjoint(direction, weight, bands):
    """The gradient in the direction of sum_k weight[k] Y_k, over the first `bands` harmonics."""
    x, y, z = direction
    gx, gy, gz = x * 0.0, y * 0.0, z * 0.0
    if bands > 1:
        gx, gy, gz = gx - Y1 * weight[3], gy - Y1 * weight[1], gz + Y1 * weight[2]
    if bands > 4:
        b4, b5, b6 = Y2A * weight[4], Y2A * weight[5], 2 * Y2B * weight[6]
        b7, b8 = Y2A * weight[7], 2 * Y2C * weight[8]
        gx += b4 * y - b6 * x - b7 * z + b8 * x
        gy += b4 * x - b5 * z - b6 * y - b8 * y
        gz += 2.0 * b6 * z - b5 * y - b7 * x
    if bands > 9:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        b9, b10, b11, b12 = Y3A * weight[9], Y3B * weight[10], Y3C * weight[11], Y3D * weight[12]
        b13, b14, b15 = Y3C * weight[13], Y3B / 2 * weight[14], Y3A * weight[15]
        gx += b10 * yz + b14 * 2.0 * xz - b9 * 6.0 * xy + b11 * 2.0 * xy - b12 * 6.0 * xz
        gx -= b13 * (4.0 * zz - 3.0 * xx - yy) + b15 * (3.0 * xx - 3.0 * yy)
        gy += b10 * xz - b14 * 2.0 * yz - b9 * (3.0 * xx - 3.0 * yy) - b12 * 6.0 * yz
        gy += b13 * 2.0 * xy + b15 * 6.0 * xy - b11 * (4.0 * zz - xx - 3.0 * yy)
        gz += b10 * xy + b14 * (xx - yy) - b11 * 8.0 * yz - b13 * 8.0 * xz + b12 * (6.0 * zz - 3.0 * xx - 3.0 * yy)
    return gx, gy, gz


@formula
def colour_adjoint(lens, mean, weight, bands):
    """The gradient in the mean of sum_k weight[k] Y_k(direction of mean)."""
    direction, inverse = direction_of(lens, mean)
    bar = direction_adjoint(direction, weight, bands)
    radial = dot(bar, direction)
    return (
        (bar[0] - radial * direction[0]) * inverse,
        (bar[1] - radial * direction[1]) * inverse,
        (bar[2] - radial * direction[2]) * inverse,
    )
