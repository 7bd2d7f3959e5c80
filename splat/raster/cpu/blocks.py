"""Every splat's own block of the Hessian, exactly, in one pass over the pixels.

A pixel is multilinear in the alphas of the splats over it, so a splat's own second derivatives need that splat alone.  With
q = ln alpha, w = alpha T, c the splat's colour, R_c the colour behind it, D_c = dI_c/dq = w c - beta R_c = d2I_c/dq2,
g = dl/dI and h_c = d2l/dI_c2 (the pixel-diagonal of l''), the block of one pixel in (q, colour) is

    q q     s + v, s = sum_c g_c D_c, v = sum_c h_c D_c^2        q c     w g_c + w h_c D_c        c c     w^2 h_c

where s and w g_c come from the curvature of the compositing (R''), the others from Gauss-Newton (J^T diag(h) J): with g = 0
the pass gives that part alone.  q is quadratic in the pixel's offset from the mean, in whitened coordinates (u, v)
(`whitening.py`), so the sums over pixels are moments of offsets:

    s + v to degree 4 (15), w g_c + w h_c D_c to degree 2 (6 each, three channels), w^2 h_c (three): 36 a splat

and d2q itself needs the moments S, Su, Sv of s, which the first-order adjoint has.

Where the cap holds, q is constant: only c c is left.
"""

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.planes import TILE_ROWS, scratch
from splat.backend.cpu.simd import broadcast, lanes, load, prefetch, select, store, store_sums
from splat.projection.whitening import ROUND, plain_adjoint, put, whitening
from splat.raster.cpu.tile import (
    CAPPED,
    PARAMS,
    RED,
    alpha_terms,
    broadcast3,
    clear_entries,
    corner_of,
    dark,
    load3,
    next_tile,
    reached,
    row_range,
    row_v,
    store3,
)
from splat.raster.formulas import (
    BLOCK_SUMS,
    COLOUR,
    CROSS,
    DEGREE2,
    MOMENT,
    MOMENT2,
    TINY,
    alpha_row,
    cross_terms,
    reciprocal,
    step_block,
)

AHEAD = 4
SPLAT = 9


@kernel
def block_moments(counter, params, lists, frame, pixels, gradient, curvature, sums):
    """Moments of every entry, (slots, BLOCK_SUMS).  gradient: g, 4 planes; curvature: h, 3 planes."""
    L = lanes(params)
    state = scratch(params, 11 * L * TILE_ROWS)  # a row: T, R (3), g (3), h (3), stop
    shared = scratch(params, 5 * L * TILE_ROWS)  # a row: w, w where the cap does not hold, D (3)
    tile = next_tile(counter, lists)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            b, p = 11 * L * y, corner + y * frame.stride
            T = load(pixels.transmittance, p)
            store(state, b, T)
            for c in range(3):
                store(state, b + (1 + c) * L, T * frame.background[c])
            store3(state, b + 4 * L, L, load3(gradient, p, frame.size))
            store3(state, b + 7 * L, L, load3(curvature, p, frame.size))
            store(state, b + 10 * L, load(pixels.stop, p))
        first, count = reached(lists, tile, pixels, corner, frame.stride)
        plain = dark(gradient, 0, 4, corner, frame.size, frame.stride)
        if plain and dark(curvature, 0, 3, corner, frame.size, frame.stride):
            clear_entries(lists, first, count, BLOCK_SUMS, sums)
            count = 0
        for k in range(count - 1, -1, -1):
            later = first + max(k - AHEAD, 0)
            prefetch(params, np.int64(lists.splat[later]) * PARAMS)
            for line in range(0, BLOCK_SUMS, 16):
                prefetch(sums, np.int64(lists.slots[later]) * BLOCK_SUMS + line)
            block_entry(params, lists, first + k, k, x0, y0, frame, state, shared, sums)
        tile = next_tile(counter, lists)


@formula
def block_entry(params, lists, e, k, x0, y0, frame, state, shared, sums):
    L = lanes(params)
    o = np.int64(lists.splat[e]) * PARAMS
    u, terms = alpha_terms(params, o, x0, y0)
    colour = broadcast3(params, o + RED)
    capped = lists.rows[e] & CAPPED
    index = broadcast(params, k)
    zero = broadcast(params, 0.0)
    m0, m1, m2, m3, m4 = zero, zero, zero, zero, zero
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        b = 11 * L * y
        v = row_v(frame, L, y, terms)
        alpha, uncapped = alpha_row(v, terms, index < load(state, b + 10 * L), frame.cap)
        r = reciprocal(1.0 - alpha)
        T = load(state, b) * r
        w, beta = alpha * T, alpha * r
        free = w
        if capped:
            free, beta = select(uncapped <= frame.cap, w, 0.0), select(uncapped <= frame.cap, beta, 0.0)
        R, g, h = load3(state, b + L, L), load3(state, b + 4 * L, L), load3(state, b + 7 * L, L)
        D, after, weight = step_block(w, free, beta, R, g, h, colour)
        store(state, b, T)
        store3(state, b + L, L, after)
        store(shared, 5 * L * y, w)
        store(shared, 5 * L * y + L, free)
        store3(shared, 5 * L * y + 2 * L, L, D)
        vv = v * v
        m0, m1, m2 = m0 + weight, m1 + weight * v, m2 + weight * vv
        m3, m4 = m3 + weight * (vv * v), m4 + weight * (vv * vv)
    slot = np.int64(lists.slots[e]) * BLOCK_SUMS
    store_powers(sums, slot, u, m0, m1, m2, m3, m4)
    for c in range(3):
        channel_entry(lists, e, c, u, terms, frame, state, shared, sums, slot, L, zero)


@formula
def channel_entry(lists, e, c, u, terms, frame, state, shared, sums, slot, L, zero):
    m0, m1, m2, squared = zero, zero, zero, zero
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        v = row_v(frame, L, y, terms)
        g, h = load(state, (11 * y + 4 + c) * L), load(state, (11 * y + 7 + c) * L)
        w, free, D = load(shared, 5 * L * y), load(shared, 5 * L * y + L), load(shared, (5 * y + 2 + c) * L)
        cross, square = cross_terms(w, free, D, g, h)
        squared += square
        m0, m1, m2 = m0 + cross, m1 + cross * v, m2 + cross * (v * v)
    store_sums(sums, slot + CROSS + DEGREE2 * c, (m0, m0 * u, m0 * (u * u), m1, m1 * u, m2))
    store_sums(sums, slot + COLOUR + c, (squared,))


@formula
def store_powers(sums, at, u, m0, m1, m2, m3, m4):
    """The fifteen moments from the sums over rows of a weight times v^k."""
    uu = u * u
    uuu = uu * u
    store_sums(sums, at, (m0, m0 * u, m0 * uu, m0 * uuu, m0 * (uu * uu), m1, m1 * u, m1 * uu, m1 * uuu))
    store_sums(sums, at + 9, (m2, m2 * u, m2 * uu, m3, m3 * u, m4))


# --- from moments to blocks -------------------------------------------------------------------------------------------


@kernel
def splat_block(splat, moments, S, Su, Sv, block):
    """A splat's own block (9, 9), symmetric, in mean, conic (both whitened), opacity, colour; S, Su, Sv: for d2q.

    dq: ROUND u, ROUND v in the mean; -u^2 / 2, -u v, -v^2 / 2 in the conic; 1 / o in the opacity.
    """
    inverse = 1.0 / max(splat[5], TINY)
    first = ((1, 0, ROUND), (0, 1, ROUND), (2, 0, -0.5), (1, 1, -1.0), (0, 2, -0.5), (0, 0, inverse))
    for p in range(6):
        j, k, factor = first[p]
        for q in range(p + 1):
            j2, k2, factor2 = first[q]
            block[p, q] = factor * (factor2 * moments[MOMENT[j + j2, k + k2]])
        for c in range(3):
            block[6 + c, p] = factor * moments[CROSS + DEGREE2 * c + MOMENT2[j, k]]
    for c in range(3):
        block[6 + c, 6 + c] = moments[COLOUR + c]
    # sum s d2q
    block[0, 0] -= S * ROUND
    block[1, 1] -= S * ROUND
    block[2, 0] += Su
    block[3, 0] += Sv
    block[3, 1] += Su
    block[4, 1] += Sv
    block[5, 5] = inverse * (inverse * (moments[0] - S))  # 1 / o^2 alone may overflow
    for p in range(SPLAT):
        for q in range(p):
            block[q, p] = block[p, q]


@formula
def make_plain(W, rows):
    """The adjoints in a splat's numbers (9, ...), column by column, in plain coordinates."""
    for j in range(SPLAT):
        put(rows[:, j], plain_adjoint(W, rows[:, j]))


@kernel
def reduce_blocks(start, stop, index, splats, slot_start, sums, moments, curved, blocks):
    """The own blocks (m, 9, 9) of the splats at index; moments: (n, 3) S, Su, Sv."""
    total, own = np.zeros(BLOCK_SUMS), np.zeros((SPLAT, SPLAT))
    for e in range(start, stop):
        i = index[e]
        for j in range(BLOCK_SUMS):
            total[j] = 0
        for slot in range(slot_start[i], slot_start[i + 1]):
            for j in range(BLOCK_SUMS):
                total[j] += sums[slot * BLOCK_SUMS + j]
        S, Su, Sv = np.float64(moments[i, 0]), np.float64(moments[i, 1]), np.float64(moments[i, 2])
        if not curved:
            S, Su, Sv = 0.0, 0.0, 0.0
        splat_block(splats[i], total, S, Su, Sv, own)
        W = whitening(splats[i])
        make_plain(W, own)
        make_plain(W, own.T)
        blocks[e] = own
