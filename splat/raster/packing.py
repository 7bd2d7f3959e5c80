"""From splats to what the compositing kernels read, and from their sums back to splats, for the splats start..stop.

A splat is nine numbers: mean x, y; conic a, b, c; opacity; colour.  Tangents carry K vectors side by side: (n, K, 9).
With S, Sx, ... the moments of a splat's entries (`compositing.py`) and Q = [[a, b], [b, c]]:

    gradient   mean Q (Sx, Sy);  a -Sxx / 2;  b -Sxy;  c -Syy / 2;  opacity S / o;  colour G
    its tangent, with the moments S', ... of the tangent pass
               mean Q (S'x - mx' S, S'y - my' S) + Q' (Sx, Sy);  a -(S'xx - 2 mx' Sx) / 2;  b -(S'xy - mx' Sy - my' Sx)
               c -(S'yy - 2 my' Sy) / 2;  opacity (S' - S o' / o) / o;  colour G'
"""

from math import log, log2

import numpy as np

from splat.raster.compositing import (
    BLUE,
    CUT,
    DBLUE,
    DGREEN,
    DRED,
    GREEN,
    LO,
    LXX,
    LXY,
    LYY,
    MX,
    MY,
    PARAMS,
    Q0,
    QX,
    QXX,
    QXY,
    QY,
    QYY,
    RED,
    SUMS,
    TANGENTS,
    formula,
    kernel,
)

LOG2_E = 1 / log(2)


@kernel
def pack_splats(start, stop, splats, log2_alpha_min, contour, params):
    """params (n * PARAMS) of splats (n, 9)."""
    for i in range(start, stop):
        p, opacity = PARAMS * i, splats[i, 5]
        params[p + MX], params[p + MY] = splats[i, 0] - 0.5, splats[i, 1] - 0.5
        params[p + LXX] = -LOG2_E / 2 * splats[i, 2]
        params[p + LXY] = -LOG2_E * splats[i, 3]
        params[p + LYY] = -LOG2_E / 2 * splats[i, 4]
        level = log2(opacity) if opacity > 0 else -np.inf
        params[p + LO] = level
        params[p + CUT] = max(log2_alpha_min, level - LOG2_E / 2 * contour * contour)
        params[p + RED], params[p + GREEN], params[p + BLUE] = splats[i, 6], splats[i, 7], splats[i, 8]


@kernel
def pack_tangents(start, stop, splats, directions, tangents):
    """tangents (n * K * TANGENTS) of directions (n, K, 9)."""
    K = directions.shape[1]
    for i in range(start, stop):
        a, b, c, opacity = splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5]
        for k in range(K):
            t, u = (i * K + k) * TANGENTS, directions[i, k]
            tangents[t + Q0] = u[5] / opacity if opacity > 0 else 0.0
            tangents[t + QX], tangents[t + QY] = a * u[0] + b * u[1], b * u[0] + c * u[1]
            tangents[t + QXX], tangents[t + QXY], tangents[t + QYY] = -0.5 * u[2], -u[3], -0.5 * u[4]
            tangents[t + DRED], tangents[t + DGREEN], tangents[t + DBLUE] = u[6], u[7], u[8]


@formula
def sum_of_slots(sums, first, last, stride, offset):
    """The nine sums of the slots first..last - 1; slot i's lie at i * stride + offset.  In registers."""
    zero = sums.dtype.type(0)
    s0, s1, s2, s3, s4, s5, s6, s7, s8 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for slot in range(first, last):
        p = slot * stride + offset
        s0 += sums[p]
        s1 += sums[p + 1]
        s2 += sums[p + 2]
        s3 += sums[p + 3]
        s4 += sums[p + 4]
        s5 += sums[p + 5]
        s6 += sums[p + 6]
        s7 += sums[p + 7]
        s8 += sums[p + 8]
    return s0, s1, s2, s3, s4, s5, s6, s7, s8


@kernel
def reduce_gradient(start, stop, splats, slot_start, sums, moments, gradient):
    """gradient (n, 9) and the moments S, Sx, Sy (n, 3) from the sums of the entries (slots, SUMS)."""
    for i in range(start, stop):
        total = sum_of_slots(sums, slot_start[i], slot_start[i + 1], SUMS, 0)
        a, b, c, opacity = splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5]
        S, Sx, Sy = total[0], total[1], total[2]
        moments[i, 0], moments[i, 1], moments[i, 2] = S, Sx, Sy
        gradient[i, 0], gradient[i, 1] = a * Sx + b * Sy, b * Sx + c * Sy
        gradient[i, 2], gradient[i, 3], gradient[i, 4] = -0.5 * total[3], -total[4], -0.5 * total[5]
        gradient[i, 5] = S / opacity if opacity > 0 else 0.0
        gradient[i, 6], gradient[i, 7], gradient[i, 8] = total[6], total[7], total[8]


@kernel
def reduce_curvature(start, stop, splats, directions, slot_start, sums, moments, product):
    """product (n, K, 9) from the sums of the entries (slots, K, SUMS) and the moments of the gradient."""
    K = directions.shape[1]
    for i in range(start, stop):
        a, b, c, opacity = splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5]
        S, Sx, Sy = moments[i, 0], moments[i, 1], moments[i, 2]
        for k in range(K):
            total = sum_of_slots(sums, slot_start[i], slot_start[i + 1], K * SUMS, k * SUMS)
            u, out = directions[i, k], product[i, k]
            mx, my = u[0], u[1]
            tx, ty = total[1] - mx * S, total[2] - my * S
            out[0], out[1] = a * tx + b * ty + u[2] * Sx + u[3] * Sy, b * tx + c * ty + u[3] * Sx + u[4] * Sy
            out[2] = -0.5 * (total[3] - 2 * mx * Sx)
            out[3] = -(total[4] - mx * Sy - my * Sx)
            out[4] = -0.5 * (total[5] - 2 * my * Sy)
            out[5] = (total[0] - S * u[5] / opacity) / opacity if opacity > 0 else 0.0
            out[6], out[7], out[8] = total[6], total[7], total[8]
