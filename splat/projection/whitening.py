"""Coordinates in which a splat is round, so that single precision treats needles and discs alike.

A conic Q = [[a, b], [b, c]] is factored into W^T W = log2(e) / 2 Q,

    W = [[along, 0], [across shear, across]],  shear = b / c,  across^2 = log2(e) / 2 c,  along^2 = log2(e) / 2 (a - b^2 / c)

and an offset d from the mean has the whitened coordinates (u, v) = W d: log2 alpha = log2 o - u^2 - v^2, and nothing
cancels.  In plain coordinates a change of a needle's length is a difference of changes of a, b and c that are larger by the
squared ratio of its axes, and so is an adjoint.  Therefore what is summed over pixels or stored in single precision is
whitened; splats, tangents and adjoints in plain coordinates, between the stages, are in double precision.

The formulas take and give five numbers, of the mean x, y and the conic a, b, c, or whitened; W stands still:

    tangents    mean' -> W mean';  Q' -> W^-T Q' W^-1      `whitened`, and back `plain`
    adjoints    by the transposes                          `whitened_adjoint` (of plain ones), and back `plain_adjoint`
"""

from math import log, sqrt

from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import select

LOG2_E = 1 / log(2)
ROUND = 2 / LOG2_E  # the conic in whitened coordinates is this times the identity
LEAST_RATIO = 2.0**-50  # of a - b^2 / c to a: beneath it, the difference is round-off


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
    """a c / (a c - b^2): how many times smaller than its terms a whitened tangent, and the conic's, may be."""
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
def put(out, numbers):
    """Write a tuple of numbers to the first places of an array."""
    for j in range(len(numbers)):
        out[j] = numbers[j]
