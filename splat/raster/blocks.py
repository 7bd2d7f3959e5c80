"""Every splat's own block of the Hessian, exactly, in one pass over the pixels.

A pixel is multilinear in the alphas of the splats over it, so a splat's own second derivatives need that splat alone.  With
q = ln alpha, w = alpha T, c the splat's colour, R_c the colour behind it, D_c = dI_c/dq = w c - beta R_c = d2I_c/dq2,
g = dl/dI and h_c = d2l/dI_c2 (the pixel-diagonal of l''), the block of one pixel in (q, colour) is

    q q     s + v, s = sum_c g_c D_c, v = sum_c h_c D_c^2        q c     w g_c + w h_c D_c        c c     w^2 h_c

where s and w g_c come from the curvature of the compositing (R''), the others from Gauss-Newton (J^T diag(h) J): with g = 0
the pass gives that part alone.  q is quadratic in the pixel's offset (dx, dy) from the mean, so the sums over pixels are
moments of offsets:

    s + v to degree 4 (15), w g_c + w h_c D_c to degree 2 (6 each, three channels), w^2 h_c (three): 36 a splat

and d2q itself needs the moments S, Sx, Sy of s, which the first-order adjoint has.

Where the cap holds, q is constant: only c c is left.
"""

import numpy as np

from splat.raster.compositing import (
    CAPPED,
    MY,
    PARAMS,
    RED,
    TILE_ROWS,
    alpha_row,
    alpha_terms,
    broadcast3,
    clear_entries,
    corner_of,
    dark,
    formula,
    kernel,
    load3,
    next_tile,
    prefetch,
    reached,
    row_range,
    scratch,
    store3,
)
from splat.raster.simd import broadcast, lanes, load, select, store, store_sums

AHEAD = 4
DEGREE4, DEGREE2 = 15, 6
CROSS = DEGREE4  # after the moments of s + v: those of w g_c + w h_c D_c, and the sums of w^2 h_c
COLOUR = DEGREE4 + 3 * DEGREE2
BLOCK_SUMS = COLOUR + 3
SPLAT = 9
TINY = np.finfo(np.float64).tiny  # an opacity below has no weight, and no inverse


def _moment_index() -> np.ndarray:
    """Where the moment of x^j y^k lies among the fifteen, by [j, k]: powers of y outermost, as `store_powers` leaves them."""
    index = np.full((5, 5), -1, np.int64)
    place = 0
    for k in range(5):
        for j in range(5 - k):
            index[j, k] = place
            place += 1
    return index


MOMENT = _moment_index()  # the six of degree 2 are stored alike: 1, x, x^2, y, x y, y^2


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
    dx, terms = alpha_terms(params, o, x0)
    colour = broadcast3(params, o + RED)
    capped = lists.rows[e] & CAPPED
    dy0 = broadcast(params, y0 - params[o + MY])
    index = broadcast(params, k)
    zero = broadcast(params, 0.0)
    m0, m1, m2, m3, m4 = zero, zero, zero, zero, zero
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        b = 11 * L * y
        dy = dy0 + load(frame.row_offsets, L * y)
        alpha, uncapped = alpha_row(dy, terms, index < load(state, b + 10 * L), frame.cap)
        r = 1.0 / (1.0 - alpha)
        T = load(state, b) * r
        w, beta = alpha * T, alpha * r
        free = w
        if capped:
            free, beta = select(uncapped <= frame.cap, w, 0.0), select(uncapped <= frame.cap, beta, 0.0)
        R, g, h = load3(state, b + L, L), load3(state, b + 4 * L, L), load3(state, b + 7 * L, L)
        D = (free * colour[0] - beta * R[0], free * colour[1] - beta * R[1], free * colour[2] - beta * R[2])
        store(state, b, T)
        store3(state, b + L, L, (R[0] + w * colour[0], R[1] + w * colour[1], R[2] + w * colour[2]))
        store(shared, 5 * L * y, w)
        store(shared, 5 * L * y + L, free)
        store3(shared, 5 * L * y + 2 * L, L, D)
        weight = D[0] * (g[0] + h[0] * D[0]) + D[1] * (g[1] + h[1] * D[1]) + D[2] * (g[2] + h[2] * D[2])
        yy = dy * dy
        m0, m1, m2 = m0 + weight, m1 + weight * dy, m2 + weight * yy
        m3, m4 = m3 + weight * (yy * dy), m4 + weight * (yy * yy)
    slot = np.int64(lists.slots[e]) * BLOCK_SUMS
    store_powers(sums, slot, dx, m0, m1, m2, m3, m4)
    for c in range(3):
        channel_entry(lists, e, c, dx, dy0, frame, state, shared, sums, slot, L, zero)


@formula
def channel_entry(lists, e, c, dx, dy0, frame, state, shared, sums, slot, L, zero):
    m0, m1, m2, squared = zero, zero, zero, zero
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        dy = dy0 + load(frame.row_offsets, L * y)
        g, h = load(state, (11 * y + 4 + c) * L), load(state, (11 * y + 7 + c) * L)
        w, free, D = load(shared, 5 * L * y), load(shared, 5 * L * y + L), load(shared, (5 * y + 2 + c) * L)
        cross = free * g + w * h * D
        squared += w * w * h
        m0, m1, m2 = m0 + cross, m1 + cross * dy, m2 + cross * (dy * dy)
    xx = dx * dx
    store_sums(sums, slot + CROSS + DEGREE2 * c, (m0, m0 * dx, m0 * xx, m1, m1 * dx, m2))
    store_sums(sums, slot + COLOUR + c, (squared,))


@formula
def store_powers(sums, at, dx, m0, m1, m2, m3, m4):
    """The fifteen moments from the sums over rows of a weight times dy^k."""
    xx = dx * dx
    xxx = xx * dx
    store_sums(sums, at, (m0, m0 * dx, m0 * xx, m0 * xxx, m0 * (xx * xx), m1, m1 * dx, m1 * xx, m1 * xxx))
    store_sums(sums, at + 9, (m2, m2 * dx, m2 * xx, m3, m3 * dx, m4))


# --- from moments to blocks -------------------------------------------------------------------------------------------


@formula
def quadratic_form(moments, x, y, j, k):
    """The moment of (x . (dx, dy)) (y . (dx, dy)) dx^j dy^k."""
    return (
        x[0] * y[0] * moments[MOMENT[j + 2, k]]
        + (x[0] * y[1] + x[1] * y[0]) * moments[MOMENT[j + 1, k + 1]]
        + x[1] * y[1] * moments[MOMENT[j, k + 2]]
    )


@formula
def linear_form(moments, at, x, j, k):
    """The moment of (x . (dx, dy)) dx^j dy^k: of s + v, or, at > 0, of a channel's cross weight with j = k = 0."""
    if at > 0:
        return x[0] * moments[at + 1] + x[1] * moments[at + 3]
    return x[0] * moments[MOMENT[j + 1, k]] + x[1] * moments[MOMENT[j, k + 1]]


@kernel
def splat_block(splat, moments, S, Sx, Sy, block):
    """A splat's own block (9, 9), its lower triangle, in mean x, y, conic a, b, c, opacity, colour; S, Sx, Sy: for d2q.

    dq: a dx + b dy, b dx + c dy in the mean; -dx^2 / 2, -dx dy, -dy^2 / 2 in the conic; 1 / o in the opacity.
    """
    rows = ((splat[2], splat[3]), (splat[3], splat[4]))
    inverse = 1.0 / max(splat[5], TINY)
    powers = ((2, 0, -0.5), (1, 1, -1.0), (0, 2, -0.5))
    for p in range(2):
        for q in range(p + 1):
            block[p, q] = quadratic_form(moments, rows[p], rows[q], 0, 0)
        block[5, p] = inverse * linear_form(moments, 0, rows[p], 0, 0)
        for q in range(3):
            j, k, factor = powers[q]
            block[2 + q, p] = factor * linear_form(moments, 0, rows[p], j, k)
    for p in range(3):
        j, k, factor = powers[p]
        block[5, 2 + p] = factor * inverse * moments[MOMENT[j, k]]
        for q in range(p + 1):
            j2, k2, factor2 = powers[q]
            block[2 + p, 2 + q] = factor * factor2 * moments[MOMENT[j + j2, k + k2]]
    block[5, 5] = inverse * (inverse * (moments[0] - S))  # 1 / o^2 alone may overflow
    for c in range(3):
        at = CROSS + DEGREE2 * c
        for p in range(2):
            block[6 + c, p] = linear_form(moments, at, rows[p], 0, 0)
        block[6 + c, 2], block[6 + c, 3], block[6 + c, 4] = (
            -0.5 * moments[at + 2],
            -moments[at + 4],
            -0.5 * moments[at + 5],
        )
        block[6 + c, 5] = inverse * moments[at]
        block[6 + c, 6 + c] = moments[COLOUR + c]
    # sum s d2q
    block[0, 0] -= S * splat[2]
    block[1, 0] -= S * splat[3]
    block[1, 1] -= S * splat[4]
    block[2, 0] += Sx
    block[3, 0] += Sy
    block[3, 1] += Sx
    block[4, 1] += Sy


@kernel
def reduce_blocks(start, stop, index, splats, slot_start, sums, moments, curved, blocks):
    """The own blocks (m, 9, 9), lower triangles, of the splats at index; moments: (n, 3) S, Sx, Sy."""
    total, splat, own = np.zeros(BLOCK_SUMS), np.zeros(SPLAT), np.zeros((SPLAT, SPLAT))
    for e in range(start, stop):
        i = index[e]
        for j in range(BLOCK_SUMS):
            total[j] = 0
        for slot in range(slot_start[i], slot_start[i + 1]):
            for j in range(BLOCK_SUMS):
                total[j] += sums[slot * BLOCK_SUMS + j]
        for j in range(SPLAT):
            splat[j] = splats[i, j]
        S, Sx, Sy = np.float64(moments[i, 0]), np.float64(moments[i, 1]), np.float64(moments[i, 2])
        if not curved:
            S, Sx, Sy = 0.0, 0.0, 0.0
        splat_block(splat, total, S, Sx, Sy, own)
        for p in range(SPLAT):
            for q in range(p + 1):
                blocks[e, p, q] = own[p, q]
