"""The diagonal block of the Hessian of every splat, exactly, in one pass over the pixels.

A pixel is multilinear in the alphas of the splats over it, so second derivatives in a splat's numbers need it alone.  With
q = ln alpha, w = alpha T, c the splat's colour, R_c the colour behind it, D_c = dI_c/dq = w c - beta R_c = d2I_c/dq2,
g = dl/dI and h_c = d2l/dI_c2 (the pixel-diagonal of l''), the block of one pixel in (q, colour) is

    q q     s + v, s = sum_c g_c D_c, v = sum_c h_c D_c^2        q c     w g_c + w h_c D_c        c c     w^2 h_c

where s and w g_c come from the curvature of the compositing (R''), the others from Gauss-Newton (J^T diag(h) J): with g = 0
the pass gives that part alone.  q' is quadratic in the pixel's whitened offset (u, v) with the coefficients Q0, QU, ... of
`projection/whitening.py`, so that its block over these and the colour is made of moments of offsets:

    s + v to degree 4 (15), w g_c + w h_c D_c to degree 2 (6 each, three channels), w^2 h_c (three): 36 a splat

and d2q itself needs the moments S, Su, Sv of s, which the first-order adjoint has.

Where the cap holds, q is constant: only c c is left.
"""

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import TILE_ROWS, scratch
from splat.backend.cpu.simd import broadcast, lanes, load, prefetch, store, store_sums
from splat.render.cpu.tile import (
    BEHIND,
    PARAMS,
    UNDO,
    begin_undo_row,
    clear_sums,
    corner_of,
    dark,
    intersection,
    intersections_of,
    kept_at,
    load3,
    load_planes,
    next_tile,
    row_at,
    row_v,
    store3,
    undo_row,
)
from splat.render.formulas import BLOCK_INDEX, BLOCK_SUMS, COLOUR, CROSS, D2Q, DEGREE2, SPLAT, cross_terms, step_block

AHEAD = 4  # intersections between a prefetch and its use
GRAD, CURVATURE, BLOCK = UNDO, UNDO + 3, UNDO + 6  # in a row of pixels: v_image, h


@kernel
def block_moments(counter, params, lists, frame, pixels, v_planes, curvature, sums):
    """The sums of every intersection, (accumulators, BLOCK_SUMS).  v_planes: g, 4 planes; curvature: h, 3 planes."""
    L = lanes(params)
    state = scratch(params, BLOCK * L * TILE_ROWS)
    shared = scratch(params, 5 * L * TILE_ROWS)  # a row: w, w where the cap does not hold, D (3)
    tile = next_tile(counter, lists, frame, -1)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            b, p = BLOCK * L * y, row_at(corner, y, frame)
            begin_undo_row(state, b, L, frame, pixels, kept_at(tile, y, L))
            store3(state, b + GRAD * L, L, load_planes(v_planes, p, frame))
            store3(state, b + CURVATURE * L, L, load_planes(curvature, p, frame))
        first, count = intersections_of(lists, tile)
        plain = dark(v_planes, 0, 4, corner, frame)
        if plain and dark(curvature, 0, 3, corner, frame):
            clear_sums(lists, first, count, BLOCK_SUMS, sums)
            count = 0
        for k in range(count - 1, -1, -1):
            later = first + max(k - AHEAD, 0)
            prefetch(params, np.int64(lists.splat[later]) * PARAMS)
            for line in range(0, BLOCK_SUMS, 16):
                prefetch(sums, np.int64(lists.accumulator[later]) * BLOCK_SUMS + line)
            block_of(params, lists, first + k, k, x0, y0, frame, state, shared, sums)
        tile = next_tile(counter, lists, frame, tile)


@formula
def block_of(params, lists, e, k, x0, y0, frame, state, shared, sums):
    """Undo intersection e, and write its sums."""
    L = lanes(params)
    _splat, u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    zero = broadcast(params, 0.0)
    m0, m1, m2, m3, m4 = zero, zero, zero, zero, zero
    for y in range(top, bottom):
        b = BLOCK * L * y
        v = row_v(frame, L, y, terms)
        # undo the splat: w, and w and beta without the cap's pixels
        w, free, beta = undo_row(state, b, L, frame, v, terms, index)
        R, g, h = load3(state, b + BEHIND * L, L), load3(state, b + GRAD * L, L), load3(state, b + CURVATURE * L, L)
        # D = dI/dq of the three colours, and the weight of the second derivative in q
        D, after, weight = step_block(w, free, beta, R, g, h, colour)
        store3(state, b + BEHIND * L, L, after)
        store(shared, 5 * L * y, w)
        store(shared, 5 * L * y + L, free)
        store3(shared, 5 * L * y + 2 * L, L, D)
        vv = v * v
        # moments of this weight, v^0 to v^4
        m0, m1, m2 = m0 + weight, m1 + weight * v, m2 + weight * vv
        m3, m4 = m3 + weight * (vv * v), m4 + weight * (vv * vv)
    at = np.int64(lists.accumulator[e]) * BLOCK_SUMS
    store_powers(sums, at, u, m0, m1, m2, m3, m4)
    # what mixes q and colour, channel by channel
    for c in range(3):
        add_channel(top, bottom, c, u, terms, frame, state, shared, sums, at, L, zero)


@formula
def add_channel(top, bottom, c, u, terms, frame, state, shared, sums, at, L, zero):
    m0, m1, m2, squared = zero, zero, zero, zero
    for y in range(top, bottom):
        v = row_v(frame, L, y, terms)
        g, h = load(state, (BLOCK * y + GRAD + c) * L), load(state, (BLOCK * y + CURVATURE + c) * L)
        w, free, D = load(shared, 5 * L * y), load(shared, 5 * L * y + L), load(shared, (5 * y + 2 + c) * L)
        cross, square = cross_terms(w, free, D, g, h)
        squared += square
        m0, m1, m2 = m0 + cross, m1 + cross * v, m2 + cross * (v * v)
    store_sums(sums, at + CROSS + DEGREE2 * c, (m0, m0 * u, m0 * (u * u), m1, m1 * u, m2))
    store_sums(sums, at + COLOUR + c, (squared,))


@formula
def store_powers(sums, at, u, m0, m1, m2, m3, m4):
    """The fifteen moments from the sums over rows of a weight times v^k."""
    uu = u * u
    uuu = uu * u
    store_sums(sums, at, (m0, m0 * u, m0 * uu, m0 * uuu, m0 * (uu * uu), m1, m1 * u, m1 * uu, m1 * uuu))
    store_sums(sums, at + 9, (m2, m2 * u, m2 * uu, m3, m3 * u, m4))


@kernel
def reduce_blocks(start, stop, index, splat_start, sums, moments, second_order, blocks):
    """The diagonal blocks (m, 9, 9) of the splats at index, over coefficients and colour; moments: the gradient's."""
    total = np.zeros(BLOCK_SUMS + 1)
    for e in range(start, stop):
        i = index[e]
        total[:] = 0
        # a splat's sums lie side by side
        for accumulator in range(splat_start[i], splat_start[i + 1]):
            for j in range(BLOCK_SUMS):
                total[j] += sums[accumulator * BLOCK_SUMS + j]
        # the block is symmetric: each of its entries is one of the sums
        for p in range(SPLAT):
            for q in range(SPLAT):
                blocks[e, p, q] = total[BLOCK_INDEX[p, q]]
                # the curvature of q in its coefficients, times the moments of s
                if second_order:
                    for j in range(3):
                        blocks[e, p, q] += D2Q[j, p, q] * moments[i, j]
