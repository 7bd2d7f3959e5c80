"""From splats to what the compositing kernels read, and from their sums back to splats, for the splats start..stop.

A splat is nine numbers: mean x, y; conic a, b, c; opacity; colour.  Tangents carry K vectors side by side: (n, K, 9).
They and the adjoints are in double precision; the kernels' numbers are in the splat's whitened coordinates (`whitening.py`),
in which the conic is ROUND times the identity.  There, with S, Su, ... the moments of a splat's entries (`formulas.py`):

    gradient   mean ROUND (Su, Sv);  a -Suu / 2;  b -Suv;  c -Svv / 2;  opacity S / o;  colour G
    its tangent, with the moments S', ... of the tangent pass
               mean ROUND (S'u - mu' S, S'v - mv' S) + Q' (Su, Sv);  a -(S'uu - 2 mu' Su) / 2;  b -(S'uv - mu' Sv - mv' Su)
               c -(S'vv - 2 mv' Sv) / 2;  opacity (S' - S o' / o) / o;  colour G'
"""

from math import log2

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.projection.whitening import LOG2_E, put, whitening
from splat.raster.cpu.tile import (
    ACROSS,
    ALONG,
    BLUE,
    CUT,
    DBLUE,
    DGREEN,
    DRED,
    GREEN,
    LO,
    MX,
    MY,
    PARAMS,
    RED,
    SHEAR,
    SUMS,
    TANGENTS,
)
from splat.raster.formulas import exponent_tangent, first_order, second_order


@formula
def put_exactly(params, at, x):
    """A double as the number next to it and the rest."""
    params[at] = x
    params[at + 1] = x - params[at]


@kernel
def pack_splats(start, stop, splats, log2_alpha_min, contour, params):
    """params (n * PARAMS) of splats (n, 9)."""
    for i in range(start, stop):
        p, opacity = PARAMS * i, splats[i, 5]
        put_exactly(params, p + MX, splats[i, 0] - 0.5)
        put_exactly(params, p + MY, splats[i, 1] - 0.5)
        params[p + ALONG], params[p + ACROSS], shear = whitening(splats[i])
        put_exactly(params, p + SHEAR, shear)
        level = log2(opacity) if opacity > 0 else -np.inf
        params[p + LO] = level
        params[p + CUT] = max(log2_alpha_min, level - LOG2_E / 2 * contour * contour)
        params[p + RED], params[p + GREEN], params[p + BLUE] = splats[i, 6], splats[i, 7], splats[i, 8]


@kernel
def pack_tangents(start, stop, splats, directions, tangents):
    """tangents (n * K * TANGENTS) of directions (n, K, 9)."""
    K = directions.shape[1]
    for i in range(start, stop):
        W = whitening(splats[i])
        for k in range(K):
            t, y = (i * K + k) * TANGENTS, directions[i, k]
            put(tangents[t : t + 6], exponent_tangent(W, splats[i, 5], y))
            tangents[t + DRED], tangents[t + DGREEN], tangents[t + DBLUE] = y[6], y[7], y[8]


@formula
def sum_of_slots(sums, first, last, stride, offset):
    """The nine sums of the slots first..last - 1; slot i's lie at i * stride + offset.  In registers."""
    zero = 0.0
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
    """gradient (n, 9) and the moments S, Su, Sv (n, 3) from the sums of the entries (slots, SUMS)."""
    for i in range(start, stop):
        total = sum_of_slots(sums, slot_start[i], slot_start[i + 1], SUMS, 0)
        moments[i, 0], moments[i, 1], moments[i, 2] = total[0], total[1], total[2]
        put(gradient[i], first_order(whitening(splats[i]), splats[i, 5], total))
        gradient[i, 6], gradient[i, 7], gradient[i, 8] = total[6], total[7], total[8]


@kernel
def reduce_curvature(start, stop, splats, directions, slot_start, sums, moments, product):
    """product (n, K, 9) from the sums of the entries (slots, K, SUMS) and the moments of the gradient."""
    K = directions.shape[1]
    for i in range(start, stop):
        W, opacity = whitening(splats[i]), splats[i, 5]
        for k in range(K):
            total = sum_of_slots(sums, slot_start[i], slot_start[i + 1], K * SUMS, k * SUMS)
            out = product[i, k]
            put(out, second_order(W, opacity, directions[i, k], moments[i], total))
            out[6], out[7], out[8] = total[6], total[7], total[8]
