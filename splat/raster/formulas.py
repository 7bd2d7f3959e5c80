"""What the compositing kernels share: their arrays, and the formulas of one splat in one pixel, at first and second order.

A tile is `lanes` pixels wide and TILE_ROWS high; a row of it is one vector.  Per pixel, splats in order of depth, with the
pixel's offset from the mean in the splat's whitened coordinates (u, v) (`whitening.py`), opacity o, colour c:

    l = log2 alpha = log2 o - u^2 - v^2      alpha = min(cap, 2^l)
    active where l >= cut and the pixel has not stopped; elsewhere alpha = 0 and every update below is a no-op

`forward`     w = alpha T;  image += w c;  T <- T - w;  at the end image += T background, alpha plane = 1 - T.

`backward`    given g = dloss/dimage and, for the alpha plane, g_A.  Back to front, T starts at the final T and R, the
              sum over the splats behind of w_j (g . c_j) plus the background's part, at T (g . background - g_A):
              r = 1 / (1 - alpha);  T <- T r;  w = alpha T;  beta = alpha r;  e = g . c
              s = w e - beta R, the derivative in q = ln alpha, 0 where the cap holds;  R <- R + w e
              per splat: moments S, Su, Sv, Suu, Suv, Svv of s over the offsets, and G = sum w g.

`tangent`     (J u) given tangents of the splats; q' is one quadratic in the offset, 0 where the cap holds:
              w' = w q' + alpha T';  image' += w' c + w c';  T' <- T' - w';  at the end image' += T' background.

`curvature`   (the tangent of `backward`) given q', c' and g' = dg.  With tau = T' / T, r, w, beta, R as above:
              tau <- tau + beta q';  nu = q' + tau;  h = nu g + g';  z = w (h . c + g . c')
              s' = z - beta (R' + r R q'), 0 where the cap holds;  R' <- R' + z;  moments of s' and G' = sum w h.

A dash marks a tangent.  K tangents share the primal quantities of a splat's rows, which stay in L1 between them; for
K = 1 the two loops are one.  Every entry (a splat in a tile) writes its nine sums to its own slot, splat-major, so that no
sum depends on the order in which threads finish.

Every kernel (`compositing.py`, `tangents.py`) takes tiles from a counter until none is left (`threads.over_tiles`).  Arrays are
flat: `params` holds PARAMS floats a splat, `tangents` K x TANGENTS floats a splat, a plane stride x height floats.
"""

from typing import NamedTuple

import numpy as np

from splat.raster.jit import formula
from splat.raster.simd import (
    any_lane,
    broadcast,
    exp2,
    fetch_and_increment,
    fma,
    iota,
    lanes,
    load,
    maximum,
    minimum,
    select,
    store,
    store_sums,
)

TILE_ROWS = 16
NEVER = 1e30  # the stop index of a pixel that does not stop
AHEAD = 6  # entries between a prefetch and its use

PARAMS = 16  # one cache line in float32: mean x, y (pixel index units), the whitening, LO = log2 o; _REST: of a rounded number
MX, MX_REST, MY, MY_REST, ALONG, ACROSS, SHEAR, SHEAR_REST, LO, RED, GREEN, BLUE, CUT = range(13)
CAPPED = 1 << 16  # in an entry's rows: its splat's alpha can reach the cap
TANGENTS = 12  # q' = Q0 + QU u + QV v + QUU u^2 + QUV u v + QVV v^2, colour'
Q0, QU, QV, QUU, QUV, QVV, DRED, DGREEN, DBLUE = range(9)
SUMS = 9  # S, Su, Sv, Suu, Suv, Svv, G (3)


class Lists(NamedTuple):
    """Which splats touch which tiles. An entry is a splat in a tile; the entries of a tile are in order of depth.

    start: (tiles + 1,) first entry of each tile; splat: (entries,); rows: (entries,) first row | last row << 8 within the
    tile, and CAPPED; slots: (entries,) where an entry's sums go, splat-major; order: the tiles as they are handed out.
    """

    start: np.ndarray
    splat: np.ndarray
    rows: np.ndarray
    slots: np.ndarray
    order: np.ndarray


class Frame(NamedTuple):
    """What all pixels share: tiles in a row, floats in a row of a plane, floats in a plane, cap, floor, background (3,).

    row_offsets: 0, ..., TILE_ROWS - 1, each `lanes` times: read as vectors, they cost the kernels less than a conversion.
    """

    columns: int
    stride: int
    size: int
    cap: float
    floor: float
    background: np.ndarray
    row_offsets: np.ndarray


class Pixels(NamedTuple):
    """What `forward` leaves in each pixel: planes (red, green, blue, alpha), the final T, the entry at which it stopped."""

    planes: np.ndarray
    transmittance: np.ndarray
    stop: np.ndarray


@formula
def scratch(like, size):
    """A new array of like's dtype that starts on a cache line."""
    buffer = np.empty(size + 16, like.dtype)
    start = ((64 - (buffer.ctypes.data & 63)) & 63) // buffer.itemsize
    return buffer[start : start + size]


@formula
def next_tile(counter, lists):
    """The next tile that no thread has taken, or -1."""
    turn = fetch_and_increment(counter)
    return lists.order[turn] if turn < lists.order.size else np.int64(-1)


@formula
def corner_of(tile, lanes, columns, stride):
    """Column and row of a tile's first pixel, and its index in a plane."""
    x0, y0 = (tile % columns) * lanes, (tile // columns) * TILE_ROWS
    return x0, y0, y0 * stride + x0


@formula
def row_range(packed):
    """First row and one past the last row of an entry."""
    return packed & 255, ((packed >> 8) & 255) + 1


@formula
def alpha_terms(params, o, x0, y0):
    """u of a tile's columns, and what gives v and log2 alpha of its rows: v of row 0, its step, log2 o - u^2, cut.

    The offset of the tile's corner is in double precision: far from the mean, v of a needle is a small difference.
    """
    along, across = params[o + ALONG], params[o + ACROSS]
    shear = np.float64(params[o + SHEAR]) + params[o + SHEAR_REST]
    dx = x0 - np.float64(params[o + MX]) - params[o + MX_REST]
    dy = y0 - np.float64(params[o + MY]) - params[o + MY_REST]
    u = fma(iota(params), along, along * dx)
    v = fma(iota(params), across * shear, across * (shear * dx + dy))
    terms = (v, broadcast(params, across), fma(-u, u, params[o + LO]), broadcast(params, params[o + CUT]))
    return u, terms


@formula
def row_v(frame, L, y, terms):
    """v of a tile's row y."""
    return fma(load(frame.row_offsets, L * y), terms[1], terms[0])


@formula
def reciprocal(x):
    return 1.0 / x


@formula
def alpha_row(v, terms, running, cap):
    """alpha of a row and 2^l before the cap; running: the mask of the pixels that have not stopped.

    l decides, so it is rounded alike in every kernel: fma.
    """
    l = fma(-v, v, terms[2])
    uncapped = exp2(l)
    return select((l >= terms[3]) & running, minimum(uncapped, cap), 0.0), uncapped


@formula
def along_row(q, u):
    """q' = A + v (B + v C) as (A, B, C), from its six coefficients."""
    return u * (u * q[QUU] + q[QU]) + q[Q0], u * q[QUV] + q[QV], q[QVV]


@formula
def tangent_terms(tangents, j, u):
    A, B, C = along_row(
        (tangents[j], tangents[j + 1], tangents[j + 2], tangents[j + 3], tangents[j + 4], tangents[j + 5]), u
    )
    return A, B, broadcast(tangents, C)


@formula
def quadratic(v, terms):
    return terms[0] + v * (terms[1] + v * terms[2])


@formula
def broadcast3(array, i):
    return broadcast(array, array[i]), broadcast(array, array[i + 1]), broadcast(array, array[i + 2])


@formula
def load3(array, i, step):
    return load(array, i), load(array, i + step), load(array, i + 2 * step)


@formula
def store3(array, i, step, values):
    store(array, i, values[0])
    store(array, i + step, values[1])
    store(array, i + 2 * step, values[2])


@formula
def dot(x, y):
    return x[0] * y[0] + (x[1] * y[1] + x[2] * y[2])


@formula
def dot_plus(x, y, z):
    """x . y + z, as a chain of fused multiply-adds."""
    return x[0] * y[0] + (x[1] * y[1] + (x[2] * y[2] + z))


@formula
def plus(x, y, c):
    """x + y c, for colours x and c."""
    return x[0] + y * c[0], x[1] + y * c[1], x[2] + y * c[2]


@formula
def behind_all(g, background):
    """What the final transmittance is multiplied by in the loss: g . background - g_A."""
    return g[0] * background[0] + g[1] * background[1] + g[2] * background[2] - g[3]


@formula
def load_cotangent(planes, p, size):
    """(g, g_A) of a row."""
    g = load3(planes, p, size)
    return g[0], g[1], g[2], load(planes, p + 3 * size)


@formula
def step_back(alpha, T, R, g, colour):
    """A splat undone: T, R in front of it, and its w, beta, r, w e."""
    r = reciprocal(1.0 - alpha)
    T = T * r
    w = alpha * T
    we = w * dot(g, colour)
    return T, R + we, w, alpha * r, r, we


@formula
def step_tangent(dT, dimage, alpha, w, w_dq, colour, dcolour):
    """w' = w q' + alpha T';  T' <- T' - w';  image' += w c' + w' c."""
    dw = w_dq + alpha * dT
    return dT - dw, plus(plus(dimage, w, dcolour), dw, colour)


@formula
def step_curvature(tau, dR, dg, w, beta, rR, dq, g, colour, dcolour):
    """tau and R' after a splat, its s' where the cap does not hold, and h."""
    tau = tau + beta * dq
    h = plus(dg, dq + tau, g)
    z = w * dot_plus(h, colour, dot(g, dcolour))
    return tau, dR + z, z - beta * (rR * dq + dR), h


@formula
def reached(lists, tile, pixels, corner, stride):
    """The first entry of a tile, and how many of its entries some pixel reaches before it stops."""
    furthest = load(pixels.stop, corner)
    for y in range(1, TILE_ROWS):
        furthest = maximum(furthest, load(pixels.stop, corner + y * stride))
    row = np.empty(lanes(pixels.stop), pixels.stop.dtype)
    store(row, 0, furthest)
    first = np.int64(lists.start[tile])
    return first, np.int64(min(lists.start[tile + 1] - first, row.max()))


@formula
def dark(planes, first_plane, count, corner, size, stride):
    """Whether `count` planes are exactly 0 all over a tile: a cotangent that leaves nothing to do."""
    lit, one = broadcast(planes, 0.0), broadcast(planes, 1.0)
    for plane in range(first_plane, first_plane + count):
        for y in range(TILE_ROWS):
            value = load(planes, plane * size + corner + y * stride)
            lit = select((value >= 0.0) & (value <= 0.0), lit, one)  # NaN is neither
    return not any_lane(lit > 0.0)


@formula
def clear_entries(lists, first, count, width, sums):
    """Zeros for the sums, `width` an entry, of a tile's entries."""
    for e in range(first, first + count):
        at = np.int64(lists.slots[e]) * width
        for j in range(width):
            sums[at + j] = 0


@formula
def no_moments(params):
    zero = broadcast(params, 0.0)
    return zero, zero, zero, zero, zero, zero


@formula
def row_terms(v, s, w, h):
    """What a row adds to its columns' sums."""
    sv = s * v
    return s, sv, sv * v, w * h[0], w * h[1], w * h[2]


@formula
def add_row(moments, v, s, w, h):
    t = row_terms(v, s, w, h)
    return (
        moments[0] + t[0],
        moments[1] + t[1],
        moments[2] + t[2],
        moments[3] + t[3],
        moments[4] + t[4],
        moments[5] + t[5],
    )


@formula
def column_terms(columns, u):
    """The nine sums' parts of each column, from its sums over rows."""
    S, Sv, Svv, G0, G1, G2 = columns
    Su = S * u
    return S, Su, Sv, Su * u, Sv * u, Svv, G0, G1, G2


@formula
def store_moments(sums, slot, moments, u):
    store_sums(sums, slot * SUMS, column_terms(moments, u))
