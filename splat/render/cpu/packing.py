"""Packing of splats start..stop for the compositing kernels, and reduction of their sums back to splats.

Splats and the coordinates of their tangents and adjoints: `projection/whitening.py`.
"""

from math import log2

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import store_double
from splat.projection.whitening import LOG2_E, put, whitening
from splat.render.cpu.tile import ACROSS, ALONG, CUT, LO, MX, MY, PARAMS, RED, SHEAR, STEP
from splat.render.formulas import SPLAT, second_order


@kernel
def pack_splats(start, stop, splats, log2_alpha_min, contour, params):
    """params (n * PARAMS) of splats (n, 9)."""
    for i in range(start, stop):
        p, opacity = PARAMS * i, splats[i, 5]
        along, across, shear = whitening(splats[i])
        store_double(params, p + MX, splats[i, 0] - 0.5)
        store_double(params, p + MY, splats[i, 1] - 0.5)
        store_double(params, p + SHEAR, shear)
        params[p + ALONG], params[p + ACROSS] = along, across
        params[p + STEP] = shear * np.float64(params[p + ACROSS])
        level = log2(opacity) if opacity > 0 else -np.inf
        params[p + LO] = level
        params[p + CUT] = max(log2_alpha_min, level - LOG2_E / 2 * contour * contour)
        for c in range(3):
            params[p + RED + c] = splats[i, 6 + c]


@formula
def total_of(sums, first, last, stride, offset):
    """The nine totals of the accumulators first..last - 1; the sums of i lie at i * stride + offset.  In registers."""
    zero = 0.0
    s0, s1, s2, s3, s4, s5, s6, s7, s8 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for i in range(first, last):
        p = i * stride + offset
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
def reduce_sums(start, stop, splat_start, sums, moments):
    """The adjoints, moments (n, 9), from the sums of the intersections (accumulators, SPLAT)."""
    for i in range(start, stop):
        put(moments[i], total_of(sums, splat_start[i], splat_start[i + 1], SPLAT, 0))


@kernel
def reduce_tangents(start, stop, tangents, splat_start, sums, moments, product):
    """The adjoints' tangents (n, K, 9) along tangents (n, K, 9), from the sums (accumulators, K, SPLAT) and the adjoints."""
    K = tangents.shape[1]
    for i in range(start, stop):
        for k in range(K):
            total = total_of(sums, splat_start[i], splat_start[i + 1], K * SPLAT, k * SPLAT)
            put(product[i, k], total)
            put(product[i, k], second_order(tangents[i, k], moments[i], total))
