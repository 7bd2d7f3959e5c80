"""The part of every splat's diagonal block that SSIM's window adds, exactly.

The second derivative of SSIM couples the pixels of a window g (a Gaussian, "blur").  In each channel, for a change d of the
image, with S'' (3, 3) at the window's centre (`losses/formulas.py`), r the residual, y the target and c = 1/2,

    d . l'' d = sum over centres of M . S'' M + pixelwise terms,      M = (blur(d), blur(2 r d), blur((y - c) d))

A splat changes a channel by the slopes d = D, D u, D v, D u^2, D u v, D v^2 in the coefficients Q0, QU, ... of q', and d = w in
its colour (w and D: `footprints.py`; u, v: whitened offset).  Its block has M . S'' M' for every pair of these SLOPES.

The blur is separable, and u depends on the column alone.  So D f, D f v, D f v^2 and w f, for the factors f = 1, 2 r and y - c,
are blurred down the columns first, and then along the rows, where u(x + t) = u(x) + t `along` gives the slopes with u:

    blur(u F) = u B_0 + along B_1       blur(u^2 F) = u^2 B_0 + 2 u along B_1 + along^2 B_2       B_j = sum_t t^j g_t F(x + t)

A ring buffer holds the last RING rows of a splat's fields; their columns count from the first window that reaches one of its
pixels.  Sums are moved to double precision every FLUSH rows.  Three tuples go through the functions:

    footprints   (layout, begin, values): `Footprints`, and w and D of the accumulators from begin on (`find_footprints`)
    planes       (image, target, seconds, index of the channel's first pixel): of `losses.cpu.loss.Coupling`
    work         (ring, rows, corners, spans, moved, sums): ring buffer; a row blurred down the columns; first pixel (row,
                 column) of each of the splat's tiles; its first and last column in each row; M of each slope; sums by lane
"""

import numpy as np
import torch

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import PIXEL_ROWS, TILE_HEIGHT, TILE_ROWS, load_pixels, scratch, store_pixels
from splat.backend.cpu.simd import broadcast, fetch_and_increment, iota, lanes, load, store, store_sums
from splat.losses.cpu.window import both_ways, weighted
from splat.losses.formulas import CENTRE, ssim_second_dot
from splat.losses.reference import REACH, window
from splat.render.cpu.footprints import FOOTPRINT
from splat.render.cpu.tile import ALONG, PARAMS, alpha_terms, column_u, row_range

FACTORS = 3  # f: 1, 2 r, y - c
POWERS = 4  # fields of each factor: D, D v, D v^2, w
FIELDS = FACTORS * POWERS
SLOPES = 7  # of a channel in a splat's numbers, in the order of its block: six of geometry, one of colour
PAIRS = SLOPES * (SLOPES + 1) // 2
TOGETHER = 4  # rows of windows that are blurred in one go
RING = 16  # rows: a power of two, at least the window's 2 REACH and TOGETHER
EDGE = 16  # floats of padding at either side of a row: at least a vector, and REACH
FLUSH = 16  # rows
TAPS = tuple(float(tap) for tap in window(torch.float64)[REACH:])
# taps of B_1 and B_2, without the middle ones, which are 0
FIRST, SECOND = (tuple(k**power * tap for k, tap in enumerate(TAPS) if k) for power in (1, 2))


@kernel
def coupled_blocks(counter, index, params, frame, footprints, image, target, seconds, blocks):
    """Add sum M . S'' M' to the blocks (m, 9, 9) of the splats at index, largest first: threads then end at the same time."""
    L = lanes(params)
    widest = FIELDS * (frame.stride + 2 * EDGE)
    ring, rows = scratch(params, RING * widest), scratch(params, TOGETHER * widest)
    spans, weights = np.empty((frame.size // frame.stride, 2), np.int64), scratch(params, L)
    corners = np.empty((frame.size // (TILE_ROWS * L), 2), np.int64)
    moved, sums, total = scratch(params, FACTORS * SLOPES * L), scratch(params, PAIRS * L), np.empty(PAIRS)
    part = np.empty(PAIRS, params.dtype)
    # a splat a turn, the largest first
    turn = fetch_and_increment(counter)
    while turn < index.size:
        splat = index[turn]
        y0, y1 = find_spans(params, splat, frame, footprints, corners, spans, weights)
        if y0 <= y1:
            box = box_of_windows(spans, y0, y1, frame, L)
            for channel in range(3):
                planes = (image, target, seconds, channel * frame.size)
                work = (ring, rows, corners, spans, moved, sums)
                sum_windows(params, splat, channel, box, frame, footprints, planes, work, part, total)
                add_to_block(total, channel, blocks[turn])
        turn = fetch_and_increment(counter)


@formula
def find_spans(params, splat, frame, footprints, corners, spans, weights):
    """First and last row in which a splat has weight; fills corners and spans (see `work`).  weights: space for a vector."""
    L, across = lanes(params), lanes(params) // PIXEL_ROWS
    layout, begin, values = footprints
    first, last = layout.splat_start[splat], layout.splat_start[splat + 1]
    y0, y1, done = frame.size, np.int64(-1), np.int64(0)
    for a in range(first, last):
        row, column = layout.tiles[a] // frame.columns * TILE_HEIGHT, layout.tiles[a] % frame.columns * across
        corners[a - first, 0], corners[a - first, 1] = row, column
        # the rows of a new row of tiles have no columns yet
        for y in range(max(row, done), row + TILE_HEIGHT):
            spans[y, 0], spans[y, 1] = frame.stride, -1
        done = row + TILE_HEIGHT
        top, bottom = row_range(layout.rows[a])
        for k in range(top, bottom):
            store(weights, 0, load(values, (layout.place[a] - layout.place[begin] + k - top) * FOOTPRINT * L))
            # widen the rows' spans by the pixels with weight
            for lane in range(L):
                x, y = column + lane % across, row + PIXEL_ROWS * k + lane // across
                if weights[lane] > 0:
                    spans[y, 0], spans[y, 1] = min(spans[y, 0], x), x
                    y0, y1 = min(y0, y), max(y1, y)
    return y0, y1


@formula
def hull_of(spans, first, last):
    """First and last column over the rows first .. last."""
    lo, hi = spans[first, 0], spans[first, 1]
    for y in range(first + 1, last + 1):
        lo, hi = min(lo, spans[y, 0]), max(hi, spans[y, 1])
    return lo, hi


@formula
def box_of_windows(spans, y0, y1, frame, L):
    """First and last row of a splat, first column of its windows, and the number of vectors that their columns take."""
    lo, hi = hull_of(spans, y0, y1)
    left = max(lo - REACH, 0)
    vectors = (min(hi + REACH, frame.width - 1) - left) // L + 1
    return y0 - y0 % PIXEL_ROWS, y1, min(left, frame.stride - vectors * L), vectors


@formula
def add_to_block(total, channel, block):
    """Add a channel's sums for pairs of slopes to a block (9, 9); the last slope is the channel's colour."""
    j = 0
    for a in range(SLOPES):
        for b in range(a + 1):
            row = a + channel if a == SLOPES - 1 else a
            column = b + channel if b == SLOPES - 1 else b
            block[row, column] += total[j]
            if a != b:
                block[column, row] += total[j]
            j += 1


@formula
def sum_windows(params, splat, channel, box, frame, footprints, planes, work, part, total):
    """Write the sum of a channel's M . S'' M' over all windows to total (PAIRS,).  box: of `box_of_windows`; part: space."""
    ring, _rows, _corners, spans, _moved, sums = work
    y0, y1, left, vectors = box
    L = lanes(params)
    pitch = vectors * L + 2 * EDGE
    sums[:], total[:] = 0, 0
    for y in range(y0 - 2 * REACH, y0):  # the rows above the splat
        clear_row(ring, y, vectors, pitch, L)
    unflushed, a = 0, footprints[0].splat_start[splat]
    for first in range(y0 - REACH, y1 + REACH + 1, TOGETHER):  # rows of windows' centres
        # the rows that come into the ring
        for ahead in range(first + REACH, first + REACH + TOGETHER, PIXEL_ROWS):
            for y in range(ahead, ahead + PIXEL_ROWS):
                clear_row(ring, y, vectors, pitch, L)
            if y0 <= ahead <= y1:
                a = fill_rows(params, splat, channel, ahead, box, frame, footprints, a, planes, work)
        # the columns that any window of these rows can see of the splat
        last = min(first + TOGETHER - 1, y1 + REACH)
        lo, hi = hull_of(spans, max(first - REACH, y0), min(last + REACH, y1))
        if hi < 0:
            continue
        lo, hi = lo - left, hi - left
        columns = (max(lo - REACH, 0) // L * L, min((hi + REACH) // L, vectors - 1) * L)
        # down the columns, then along each row, then into the sums
        blur_columns(work, first, lo // L * L, hi, columns, pitch, L)
        for row in range(max(first, 0), min(last + 1, frame.height)):
            at = (row - first) * FIELDS * pitch + EDGE
            add_windows(params, splat, row, left, columns, frame, planes, at, pitch, work)
        unflushed += TOGETHER
        if unflushed >= FLUSH:
            flush(sums, L, part, total)
            unflushed = 0
    flush(sums, L, part, total)


@formula
def clear_row(ring, y, vectors, pitch, L):
    """Write zeros to row y of every field."""
    base = slot(y) * FIELDS * pitch + EDGE
    for at in range(base, base + FIELDS * pitch, pitch):
        for x in range(at, at + vectors * L, L):
            store(ring, x, 0.0)


@formula
def fill_rows(params, splat, channel, y, box, frame, footprints, a, planes, work):
    """Write PIXEL_ROWS rows of the fields, from y on, to the ring; return the splat's first accumulator in this row of tiles.

    a: that of the row before, or the splat's first; accumulators are in order of their tiles' rows.
    """
    ring, _rows, corners, spans, _moved, _sums = work
    _y0, _y1, left, vectors = box
    layout, begin, values = footprints
    L = lanes(params)
    pitch, row = vectors * L + 2 * EDGE, y & -TILE_HEIGHT
    lo, hi = hull_of(spans, y, y + PIXEL_ROWS - 1)
    base = slot(y) * FIELDS * pitch + EDGE - left
    first, last = layout.splat_start[splat], layout.splat_start[splat + 1]
    # skip the tiles above this row
    while corners[a - first, 0] < row:
        a += 1
    at = a
    # the tiles of this row, as far as the splat has weight in them
    while at < last and corners[at - first, 0] == row:
        top, bottom = row_range(layout.rows[at])
        inside, x = (y - row) // PIXEL_ROWS, corners[at - first, 1]
        if top <= inside < bottom and x <= hi and x + L // PIXEL_ROWS > lo:
            where = (layout.place[at] - layout.place[begin] + inside - top) * FOOTPRINT * L
            fill_lanes(params, splat, x, y, channel, frame, where, values, planes, ring, base + x, pitch)
        at += 1
    return a


@formula
def fill_lanes(params, splat, x, y, channel, frame, where, values, planes, ring, to, pitch):
    """Write the fields of the vector of pixels at (x, y) to the ring at `to`; its w and D are in values at `where`."""
    L = lanes(params)
    image, target, _seconds, top = planes
    _u, terms = alpha_terms(params, splat * PARAMS, x, y)
    v = terms[0]
    w, D = load(values, where), load(values, where + (1 + channel) * L)
    p = top + y * frame.stride + x
    photo = load_pixels(target, p, frame.stride)
    # the factors f: 1, 2 r, y - c
    residual = load_pixels(image, p, frame.stride) - photo
    put_powers(ring, to, pitch, w, D, v)
    put_powers(ring, to + POWERS * pitch, pitch, 2.0 * residual * w, 2.0 * residual * D, v)
    put_powers(ring, to + 2 * POWERS * pitch, pitch, (photo - CENTRE) * w, (photo - CENTRE) * D, v)


@formula
def put_powers(ring, to, pitch, w, D, v):
    """Write the POWERS fields of a factor."""
    Dv = D * v
    step = FIELDS * pitch  # a row of pixels to the next one: y is even
    store_pixels(ring, to, step, D)
    store_pixels(ring, to + pitch, step, Dv)
    store_pixels(ring, to + 2 * pitch, step, Dv * v)
    store_pixels(ring, to + 3 * pitch, step, w)


@formula
def slot(y):
    """Place of a row in the ring."""
    return y & (RING - 1)


@formula
def dot5(x, taps):
    return x[0] * taps[0] + x[1] * taps[1] + x[2] * taps[2] + x[3] * taps[3] + x[4] * taps[4]


@formula
def blurred(F):
    """The middle of eleven rows, blurred."""
    return weighted(F[5], (F[6] + F[4], F[7] + F[3], F[8] + F[2], F[9] + F[1], F[10] + F[0]), TAPS)


@formula
def blur_columns(work, row, lo, hi, columns, pitch, L):
    """Blur TOGETHER rows of every field, from this row on, down the columns lo .. hi: each row of the ring is read once.

    0 in the other columns that windows centred in `columns` reach.
    """
    ring, rows, _corners, _spans, _moved, _sums = work
    step, (first, last) = FIELDS * pitch, columns
    for at in range(EDGE, EDGE + step, pitch):
        for x in range(at + first - max(L, 8), at + last + max(L, 8) + L, L):
            if lo <= x - at <= hi:
                F = (
                    load(ring, x + slot(row - 5) * step), load(ring, x + slot(row - 4) * step),
                    load(ring, x + slot(row - 3) * step), load(ring, x + slot(row - 2) * step),
                    load(ring, x + slot(row - 1) * step), load(ring, x + slot(row) * step),
                    load(ring, x + slot(row + 1) * step), load(ring, x + slot(row + 2) * step),
                    load(ring, x + slot(row + 3) * step), load(ring, x + slot(row + 4) * step),
                    load(ring, x + slot(row + 5) * step), load(ring, x + slot(row + 6) * step),
                    load(ring, x + slot(row + 7) * step), load(ring, x + slot(row + 8) * step),
                )  # fmt: skip
                store(rows, x, blurred(F[0:11]))
                store(rows, x + step, blurred(F[1:12]))
                store(rows, x + 2 * step, blurred(F[2:13]))
                store(rows, x + 3 * step, blurred(F[3:14]))
            else:
                for k in range(TOGETHER):
                    store(rows, x + k * step, 0.0)


@formula
def add_windows(params, splat, row, left, columns, frame, planes, at, pitch, work):
    """Add M . S'' M' of the windows centred in a row, in these columns, to the sums; at: where its blurred fields begin."""
    _image, _target, seconds, top = planes
    _ring, rows, _corners, _spans, moved, sums = work
    L = lanes(params)
    along, size = broadcast(params, params[splat * PARAMS + ALONG]), 3 * frame.size
    for x in range(columns[0], columns[1] + L, L):
        u = column_u(params, splat * PARAMS, left + x, iota(params))
        for factor in range(FACTORS):
            blur_row(rows, at + POWERS * factor * pitch + x, pitch, u, along, moved, SLOPES * factor * L)
        p = top + row * frame.stride + left + x
        second = (
            load(seconds, p), load(seconds, p + size), load(seconds, p + 2 * size),
            load(seconds, p + 3 * size), load(seconds, p + 4 * size),
        )  # fmt: skip
        add_pairs(moved, second, sums, L)


@formula
def blur_row(rows, at, pitch, u, along, moved, to):
    """Blur along a row, for the vector at `at`: one component of M for each slope, to moved."""
    L = lanes(rows)
    # D f: B_0, B_1 and B_2 from the sums and differences at equal distances
    s, d = both_ways(rows, at)
    B0, B1, B2 = weighted(load(rows, at), s, TAPS), along * dot5(d, FIRST), along * along * dot5(s, SECOND)
    # D f v: the same without the second power of u
    s, d = both_ways(rows, at + pitch)
    C0, C1 = weighted(load(rows, at + pitch), s, TAPS), along * dot5(d, FIRST)
    uB = u * B0 + B1
    # slopes D, D u, D v, D u^2, D u v; then D v^2 and w, which have no u
    store(moved, to, B0)
    store(moved, to + L, uB)
    store(moved, to + 2 * L, C0)
    store(moved, to + 3 * L, u * (uB + B1) + B2)
    store(moved, to + 4 * L, u * C0 + C1)
    for field in range(2, 4):
        at_field = at + field * pitch
        store(moved, to + (3 + field) * L, weighted(load(rows, at_field), both_ways(rows, at_field)[0], TAPS))


@formula
def add_pairs(moved, second, sums, L):
    """Add M . S'' M' of every pair of slopes to the sums."""
    j = 0
    for a in range(SLOPES):
        n0, n1, n2 = ssim_second_dot(
            second, load(moved, a * L), load(moved, (SLOPES + a) * L), load(moved, (2 * SLOPES + a) * L)
        )
        for b in range(a + 1):
            m0, m1, m2 = load(moved, b * L), load(moved, (SLOPES + b) * L), load(moved, (2 * SLOPES + b) * L)
            store(sums, (j + b) * L, load(sums, (j + b) * L) + n0 * m0 + n1 * m1 + n2 * m2)
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
