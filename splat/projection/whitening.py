"""Coordinates of a splat's tangents and adjoints in which needles and discs keep their digits in single precision.

A splat is nine numbers: mean x, y (px); conic a, b, c (px^-2); opacity o; colour (3).  Its conic Q = [[a, b], [b, c]] is
factored into W^T W = log2(e) / 2 Q,

    W = [[along, 0], [across shear, across]],  shear = b / c,  across^2 = log2(e) / 2 c,  along^2 = log2(e) / 2 (a - b^2 / c)

and an offset d (px) from the mean has the whitened coordinates (u, v) = W d: log2 alpha = log2 o - u^2 - v^2, where nothing
cancels.  In plain coordinates a change of a needle's length is a small difference of changes of a, b and c, which are larger by
the squared ratio of its axes; so is an adjoint.  Projection and rasteriser therefore exchange derivatives of q = ln alpha:

    tangent   the coefficients of q' = Q0 + QU u + QV v + QUU u^2 + QUV u v + QVV v^2, and the colour's tangent
    adjoint   the sums S, Su, Sv, ... over pixels of dL/dq times 1, u, v, u^2, u v, v^2 (moments), and the colour's adjoint

Both are linear in the plain ones at a fixed W.  Splats and plain derivatives are in double precision.

    `whitened`, `plain`                   five numbers, tangents of mean and conic: mean' -> W mean', Q' -> W^-T Q' W^-1; back
    `whitened_adjoint`, `plain_adjoint`   their adjoints: the transposes of `plain` and `whitened`
    `coefficients`, `plain_tangent`       six numbers: plain tangent of mean, conic and opacity -> coefficients; back
    `moments_of`, `plain_gradient`        plain adjoint of mean, conic and opacity -> moments; back
"""

from math import log

from splat.backend.cpu.dual import sqrt
from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import select

LOG2_E = 1 / log(2)
ROUND = 2 / LOG2_E  # W^-T Q W^-1 is this times the identity
LEAST_RATIO = 2.0**-50  # of a - b^2 / c to a: a smaller difference is round-off
Q0, QU, QV, QUU, QUV, QVV = range(6)


@formula
def whitening(splat):
    """along, across and shear of W; the identity where a splat is not drawn."""
    a, b, c = splat[2], splat[3], splat[4]
    drawn = c > 0
    shear = select(drawn, b / c, 0.0)
    along = sqrt(LOG2_E / 2 * max(a - b * shear, LEAST_RATIO * a))
    return select(drawn, along, 1.0), select(drawn, sqrt(LOG2_E / 2 * c), 1.0), shear


@formula
def cancellation(W):
    """a c / (a c - b^2): about how many times the terms of a whitened tangent can exceed their sum."""
    along, across, shear = W
    return 1 + (shear * across / along) ** 2


@formula
def whitened(W, y):
    along, across, shear = W
    uu, uv = y[2] - shear * (2 * y[3] - shear * y[4]), y[3] - shear * y[4]
    u, v = along * y[0], across * (shear * y[0] + y[1])
    return u, v, uu / (along * along), uv / (along * across), y[4] / (across * across)


@formula
def plain(W, y):
    along, across, shear = W
    x, c = y[0] / along, across * across * y[4]
    b = along * across * y[3] + shear * c
    return x, y[1] / across - shear * x, along * along * y[2] + shear * (2 * b - shear * c), b, c


@formula
def whitened_adjoint(W, y):
    along, across, shear = W
    uv, vv = y[3] + 2 * shear * y[2], y[4] + shear * (y[3] + shear * y[2])
    u, v = (y[0] - shear * y[1]) / along, y[1] / across
    return u, v, along * along * y[2], along * across * uv, across * across * vv


@formula
def plain_adjoint(W, y):
    along, across, shear = W
    y_bar, a, uv = across * y[1], y[2] / (along * along), y[3] / (along * across)
    return (
        along * y[0] + shear * y_bar,
        y_bar,
        a,
        uv - 2 * shear * a,
        y[4] / (across * across) - shear * (uv - shear * a),
    )


@formula
def ratio(x, opacity):
    """x / opacity, 0 where nothing is drawn."""
    return select(opacity > 0, x / opacity, 0.0)


@formula
def geometry_coefficients(W, y):
    """QU, QV, QUU, QUV, QVV of a plain tangent of mean and conic."""
    u, v, uu, uv, vv = whitened(W, y)
    return ROUND * u, ROUND * v, -0.5 * uu, -uv, -0.5 * vv


@formula
def coefficients(W, opacity, y):
    u, v, uu, uv, vv = geometry_coefficients(W, y)
    return ratio(y[5], opacity), u, v, uu, uv, vv


@formula
def plain_tangent(W, opacity, q):
    x, y, a, b, c = plain(W, (q[QU] / ROUND, q[QV] / ROUND, -2.0 * q[QUU], -q[QUV], -2.0 * q[QVV]))
    return x, y, a, b, c, opacity * q[Q0]


@formula
def moments_of(W, opacity, bar):
    u, v, uu, uv, vv = whitened_adjoint(W, bar)
    return opacity * bar[5], u / ROUND, v / ROUND, -2.0 * uu, -uv, -2.0 * vv


@formula
def plain_gradient(W, opacity, moments):
    S, Su, Sv, Suu, Suv, Svv = moments
    x, y, a, b, c = plain_adjoint(W, (ROUND * Su, ROUND * Sv, -0.5 * Suu, -Suv, -0.5 * Svv))
    return x, y, a, b, c, ratio(S, opacity)


COEFFICIENTS, PLAIN_TANGENT, MOMENTS, PLAIN_GRADIENT = range(4)


@formula
def converted(way, splat, numbers):
    """Six numbers of a splat in other coordinates; way: COEFFICIENTS, ..., what they become."""
    W, opacity = whitening(splat), splat[5]
    if way == COEFFICIENTS:
        return coefficients(W, opacity, numbers)
    if way == PLAIN_TANGENT:
        return plain_tangent(W, opacity, numbers)
    if way == MOMENTS:
        return moments_of(W, opacity, numbers)
    return plain_gradient(W, opacity, numbers)


@formula
def put(out, numbers):
    """Write a tuple of numbers to the first places of an array."""
    for j in range(len(numbers)):
        out[j] = numbers[j]
