"""The part of every splat's diagonal block that SSIM's window adds, exactly.

The second derivative of SSIM couples the pixels of a window g (a Gaussian, "blur").  In each channel, for a change d of the
image, with S'' (3, 3) at the window's centre (`losses/formulas.py`), r the residual, y the target and c = 1/2,

    d . l'' d = sum over centres of M . S'' M + pixelwise terms,      M = (blur(d), blur(2 r d), blur((y - c) d))

A splat changes a channel by the slopes d = D, D u, D v, D u^2, D u v, D v^2 in the coefficients Q0, QU, ... of q', and d = w in
its colour (w and D: `footprints.py`; u, v: whitened offset).  Its block has M . S'' M' for every pair of these SLOPES.

The offsets are linear in the pixel: u(x + t) = u(x) + a t for t columns, and v is more by e t, e = a r, and by b s for s rows.
So the slopes' M are those of D's moments in a window, times powers of u and v at its centre:

    B_ij = sum over t, s of (a t)^i (b s)^j g_t g_s F(x + t, y + s),  i + j <= 2,      F = f D,  f = 1, 2 r, y - c
    blur(u F) = u B_00 + B_10             blur(u^2 F) = u^2 B_00 + 2 u B_10 + B_20
    blur(v F) = v B_00 + r B_10 + B_01    and so on (`slopes_of`)

The blur is separable: each row of a splat's F and f w is blurred along itself with the powers of a t, and these down the
columns with those of b s, a strip of windows, `lanes` wide, at a time.  Rows without weight are left out.  Sums are moved to
double precision every FLUSH rows.  Three tuples go through:

    footprints   (layout, begin, values): `Footprints`, and w and D of the accumulators from begin on (`find_footprints`)
    planes       (factors, seconds, index of the channel's first pixel): of `losses.cpu.loss.Coupling`
    work         (fields, rows, taps, spans, sums): w and D in a splat's box, side by side in each row; a strip, blurred along
                 its rows; g_s (b s)^j; the splat's first and last column in each row; sums by lane
"""

import numpy as np
import torch

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import PIXEL_ROWS, neighbouring_products, neighbours, scratch, store_pixels
from splat.backend.cpu.simd import (
    broadcast,
    fetch_and_increment,
    iota,
    lanes,
    load,
    load_all,
    prefetch,
    store,
    store_sums,
)
from splat.losses.cpu.window import BORDER, both_ways, weighted
from splat.losses.formulas import ssim_second_dot
from splat.losses.reference import REACH, WINDOW, window
from splat.render.cpu.footprints import FOOTPRINT
from splat.render.cpu.tile import ACROSS, ALONG, PARAMS, STEP, column_u, column_v, corner_of, row_range

BLURRED = 4 * 3  # along a row, for each of three f: f D with the powers 0, 1, 2 of a t, and f w
SLOPES = 7  # of a channel in a splat's numbers, in the order of its block: six of geometry, one of colour
PAIRS = SLOPES * (SLOPES + 1) // 2
MARGIN = 48  # zeros between rows of fields: at least 2 lanes - 1 + REACH, which a blur reads beyond the box
AHEAD = 3  # rows of windows between a prefetch and its use; of a footprint twice as many vectors
FLUSH = 16  # rows
TAPS = tuple(float(tap) for tap in window(torch.float64)[REACH:])
# taps with the powers 1 and 2 of t, without the middle ones, which are 0
FIRST, SECOND = (tuple(k**power * tap for k, tap in enumerate(TAPS) if k) for power in (1, 2))


@kernel
def coupled_blocks(counter, order, index, params, frame, footprints, factors, seconds, weight, blocks):
    """Add weight times sum M . S'' M' to the blocks (m, 9, 9) of the splats at index; order: of its elements, those to do."""
    L, height = lanes(params), frame.size // frame.stride
    fields = scratch(params, FOOTPRINT * height * (frame.stride + MARGIN) + 2 * MARGIN)
    rows, taps = scratch(params, BLURRED * height * L), scratch(params, 3 * WINDOW * L)
    spans, weights = np.empty((height, 2), np.int64), scratch(params, L)
    sums, part, total = scratch(params, PAIRS * L), np.empty(PAIRS, params.dtype), np.empty(PAIRS)
    work = (fields, rows, taps, spans, sums)
    # a splat a turn
    turn = fetch_and_increment(counter)
    while turn < order.size:
        splat = index[order[turn]]
        origin, pitch, y0, y1 = fill_fields(splat, frame, footprints, fields, spans, weights, L)
        if y0 <= y1:
            box = (origin, pitch, y0, y1, *columns_of_windows(spans, y0, y1, frame, L))
            fill_taps(taps, params[splat * PARAMS + ACROSS], L)
            for channel in range(3):
                planes = (factors, seconds, channel * frame.size)
                sum_windows(params, splat, channel, box, frame, planes, work, part, total)
                add_to_block(total, weight, channel, blocks[order[turn]])
        turn = fetch_and_increment(counter)


@formula
def fill_fields(splat, frame, footprints, fields, spans, weights, L):
    """Write w and D of a splat row by row, 0 where it has no weight, and the columns of each row that has to spans.

    Returns the place of pixel (0, 0)'s w, the numbers from a field to the next, and the first and last row with weight.
    weights: space for a vector.
    """
    layout, begin, values = footprints
    left, right, top, bottom = frame.stride, 0, frame.size, 0
    # the box of the splat's tiles
    for a in range(layout.splat_start[splat], layout.splat_start[splat + 1]):
        column, row, _ = corner_of(layout.tiles[a], L, frame.columns, frame.stride)
        first, last = row_range(layout.rows[a])
        left, right = min(left, column), max(right, column + L // PIXEL_ROWS)
        top, bottom = min(top, row + PIXEL_ROWS * first), max(bottom, row + PIXEL_ROWS * last)
    pitch = right - left + MARGIN
    for at in range(0, (bottom - top) * FOOTPRINT * pitch + MARGIN, L):
        store(fields, at, 0.0)
    for y in range(top, bottom):
        spans[y, 0], spans[y, 1] = frame.stride, -1
    origin, y0, y1 = MARGIN - left - top * FOOTPRINT * pitch, bottom, top - 1
    for a in range(layout.splat_start[splat], layout.splat_start[splat + 1]):
        column, row, _ = corner_of(layout.tiles[a], L, frame.columns, frame.stride)
        first, last = row_range(layout.rows[a])
        at = (layout.place[a] - layout.place[begin]) * FOOTPRINT * L
        for y in range(row + PIXEL_ROWS * first, row + PIXEL_ROWS * last, PIXEL_ROWS):
            to = origin + y * FOOTPRINT * pitch + column
            store(weights, 0, load(values, at))
            for field in range(FOOTPRINT):
                prefetch(values, at + 2 * AHEAD * FOOTPRINT * L)
                store_pixels(fields, to + field * pitch, FOOTPRINT * pitch, load(values, at))
                at += L
            # widen the rows' spans by the pixels with weight
            for lane in range(L):
                if weights[lane] > 0:
                    x, line = column + lane % (L // PIXEL_ROWS), y + lane // (L // PIXEL_ROWS)
                    spans[line, 0], spans[line, 1] = min(spans[line, 0], x), max(spans[line, 1], x)
                    y0, y1 = min(y0, line), max(y1, line)
    return origin, pitch, y0, y1


@formula
def columns_of_windows(spans, y0, y1, frame, L):
    """First column of a splat's windows, and the number of vectors that their columns take."""
    lo, hi = spans[y0, 0], spans[y0, 1]
    for y in range(y0 + 1, y1 + 1):
        lo, hi = min(lo, spans[y, 0]), max(hi, spans[y, 1])
    left = max(lo - REACH, 0)
    vectors = (min(hi + REACH, frame.width - 1) - left) // L + 1
    return min(left, frame.stride - vectors * L), vectors


@formula
def fill_taps(taps, across, L):
    """Write g_s (b s)^j in every lane, j = 0, 1, 2 side by side, for b = across."""
    for k in range(-REACH, REACH + 1):
        for power in range(3):
            store(taps, (3 * (k + REACH) + power) * L, TAPS[abs(k)] * (k * across) ** power)


@formula
def add_to_block(total, weight, channel, block):
    """Add weight times a channel's sums for pairs of slopes to a block (9, 9); the last slope is the channel's colour."""
    j = 0
    for a in range(SLOPES):
        for b in range(a + 1):
            row = a + channel if a == SLOPES - 1 else a
            column = b + channel if b == SLOPES - 1 else b
            block[row, column] += weight * total[j]
            if a != b:
                block[column, row] += weight * total[j]
            j += 1


@formula
def sum_windows(params, splat, channel, box, frame, planes, work, part, total):
    """Write the sum of a channel's M . S'' M' over all windows to total (PAIRS,).

    box: of `fill_fields` and `columns_of_windows`; part: space.
    """
    fields, rows, _taps, spans, sums = work
    (origin, pitch, y0, y1, left, vectors), (factors, _seconds, top) = box, planes
    L, unflushed = lanes(params), 0
    along = broadcast(params, params[splat * PARAMS + ALONG])
    sums[:], total[:] = 0, 0
    for x in range(0, vectors * L, L):
        # rows with pixels that the windows of this strip can see
        first, last = reach_of(spans, y0, y1, left + x - REACH, left + x + L - 1 + REACH)
        for y in range(first, last + 1):
            at, p = origin + y * FOOTPRINT * pitch + left + x, BORDER + top + y * frame.stride + left + x
            D = at + (1 + channel) * pitch
            blur_row(fields, at, D, factors, p, 3 * frame.size, along, rows, (y - first) * BLURRED * L)
        # the windows' centres
        for y in range(max(first - REACH, 0), min(last + REACH + 1, frame.height)):
            add_windows(params, splat, y, left + x, first, last, frame, planes, work)
            unflushed += 1
            if unflushed == FLUSH:
                flush(sums, L, part, total)
                unflushed = 0
    flush(sums, L, part, total)


@formula
def reach_of(spans, y0, y1, lo, hi):
    """First and last of the rows y0 .. y1 with a pixel in the columns lo .. hi; y1 + 1 and y0 - 1 - 2 REACH if none has."""
    first, last = y1 + 1, y0 - 1 - 2 * REACH
    for y in range(y0, y1 + 1):
        if spans[y, 0] <= hi and spans[y, 1] >= lo:
            first, last = min(first, y), y
    return first, last


@formula
def dot5(x, taps):
    return x[0] * taps[0] + x[1] * taps[1] + x[2] * taps[2] + x[3] * taps[3] + x[4] * taps[4]


@formula
def blur_row(fields, w, D, factors, p, size, along, rows, to):
    """Blur w, D and their products with the factors at p along their row, to rows at `to`.  size: from a factor to the next."""
    L = lanes(fields)
    blur_moments(load(fields, D), both_ways(neighbours(fields, D)), along, rows, to)
    store(rows, to + 3 * L, weighted(load(fields, w), both_ways(neighbours(fields, w))[0], TAPS))
    for _ in range(2):
        to, f = to + 4 * L, load(factors, p)
        blur_moments(load(fields, D) * f, both_ways(neighbouring_products(fields, D, factors, p)), along, rows, to)
        s, _d = both_ways(neighbouring_products(fields, w, factors, p))
        store(rows, to + 3 * L, weighted(load(fields, w) * f, s, TAPS))
        p += size


@formula
def blur_moments(middle, pairs, along, rows, to):
    """Store the window's sums with the powers 0, 1 and 2 of a t; pairs: see `both_ways`."""
    L = lanes(rows)
    s, d = pairs
    store(rows, to, weighted(middle, s, TAPS))
    store(rows, to + L, along * dot5(d, FIRST))
    store(rows, to + 2 * L, along * along * dot5(s, SECOND))


@formula
def add_windows(params, splat, y, x, first, last, frame, planes, work):
    """Add M . S'' M' of the windows centred in row y, from column x on, to the sums; first, last: rows with weight."""
    _factors, seconds, top = planes
    _fields, rows, taps, _spans, sums = work
    L, o, zero = lanes(params), splat * PARAMS, broadcast(params, 0.0)
    # down the columns: B_00, B_10, B_20, B_01, B_11, B_02 and w of each factor
    E = F = G = (zero, zero, zero, zero, zero, zero, zero)
    for k in range(max(first, y - REACH), min(last, y + REACH) + 1):
        at, g = (k - first) * BLURRED * L, load_all(taps, 3 * (k - y + REACH) * L, 3)
        E = weigh_row(E, load_all(rows, at, 4), g)
        F = weigh_row(F, load_all(rows, at + 4 * L, 4), g)
        G = weigh_row(G, load_all(rows, at + 8 * L, 4), g)
    # the offset of the windows' centres
    u, v = column_u(params, o, x, iota(params)), column_v(params, o, x, y, iota(params))
    ratio = params[o + STEP] / params[o + ALONG]
    p, size = top + y * frame.stride + x, 3 * frame.size
    second = (
        load(seconds, p), load(seconds, p + size), load(seconds, p + 2 * size),
        load(seconds, p + 3 * size), load(seconds, p + 4 * size),
    )  # fmt: skip
    # rows further down are not in the cache yet
    for k in range(5):
        prefetch(seconds, p + k * size + AHEAD * frame.stride)
        prefetch(seconds, p + k * size + AHEAD * frame.stride + L - 1)
    add_pairs(slopes_of(E, u, v, ratio), slopes_of(F, u, v, ratio), slopes_of(G, u, v, ratio), second, sums, L)


@formula
def weigh_row(B, R, g):
    """B and a blurred row times its taps g_s (b s)^j."""
    R0, R1, R2, w = R
    return (
        B[0] + g[0] * R0, B[1] + g[0] * R1, B[2] + g[0] * R2, B[3] + g[1] * R0, B[4] + g[1] * R1, B[5] + g[2] * R0,
        B[6] + g[0] * w,
    )  # fmt: skip


@formula
def slopes_of(B, u, v, r):
    """A component of M for each slope: D, D u, D v, D u^2, D u v, D v^2 and w."""
    B00, B10, B20, B01, B11, B02, w = B
    # u of a pixel is the centre's and a t, v the centre's and dv, of r a t and b s
    dv = r * B10 + B01
    Du, Dv = u * B00 + B10, v * B00 + dv
    Duv = u * Dv + (v * B10 + (r * B20 + B11))
    return B00, Du, Dv, u * (Du + B10) + B20, Duv, v * (Dv + dv) + (r * (r * B20 + (B11 + B11)) + B02), w


@formula
def add_pairs(E, F, G, second, sums, L):
    """Add M . S'' M' of every pair of slopes to the sums; E, F, G: the components of M."""
    j = 0
    for a in range(SLOPES):
        n0, n1, n2 = ssim_second_dot(second, E[a], F[a], G[a])
        for b in range(a + 1):
            store(sums, (j + b) * L, load(sums, (j + b) * L) + n0 * E[b] + n1 * F[b] + n2 * G[b])
        j += a + 1


@formula
def flush(sums, L, part, total):
    """Add the sums over lanes to total, in double precision, and clear them."""
    for j in range(0, PAIRS, 4):
        at = j * L
        store_sums(part, j, (load(sums, at), load(sums, at + L), load(sums, at + 2 * L), load(sums, at + 3 * L)))
    for j in range(PAIRS):
        total[j] += part[j]
        store(sums, j * L, 0.0)
