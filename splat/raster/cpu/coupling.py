"""What the coupling of pixels by SSIM adds to the diagonal block of every splat, exactly.

The second derivative of SSIM couples pixels through its window g: with S'' at every window's centre (`losses/formulas.py`),
r the residual, y the target and c = 1/2,

    v . l'' v = sum over centres of M . S'' M + pixelwise terms,      M = blur(v), blur(2 r v), blur((y - c) v)

for each channel.  A splat moves its pixels by w along its own colour, and along the coefficients Q0, QU, ... of q' by
D 1, D u, D v, D u^2, D u v, D v^2 (`footprints.py`): SLOPES fields, each blurred with three factors f.  As u does not depend on
the row, the columns are blurred first, of D f, D f v, D f v^2 and w f; along the rows then, u(x + t) = u(x) + t `along`,

    blur(u F) = u B_0 + along B_1       blur(u^2 F) = u^2 B_0 + 2 u along B_1 + along^2 B_2       B_j = sum_t t^j g_t F(x + t)

A splat's rows go through a ring, as in `losses/cpu/window.py`, which holds every row twice so that those of a window lie one
after the other.  Sums leave single precision every FLUSH rows.
"""

import numpy as np
import torch

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.planes import TILE_ROWS, scratch
from splat.backend.cpu.simd import broadcast, fetch_and_increment, iota, lanes, load, select, store, store_sums
from splat.losses.formulas import CENTRE, ssim_second_dot
from splat.losses.reference import REACH, window
from splat.raster.cpu.footprints import FOOTPRINT
from splat.raster.cpu.tile import ALONG, PARAMS, alpha_terms, row_range

FACTORS = 3  # 1, 2 r, y - c
POWERS = 4  # fields of a factor that are blurred down: D, D v, D v^2, w
FIELDS = FACTORS * POWERS
SLOPES = 7  # of a channel, in the order of `BLOCK`: six of geometry, one of its colour
PAIRS = SLOPES * (SLOPES + 1) // 2
RING = 16  # rows, at least the window's
EDGE = 32  # floats at either side of a row: a vector and the window's reach
FLUSH = 16
MIDDLE, *TAPS = (float(tap) for tap in window(torch.float64)[REACH:])
TAPS = tuple(TAPS)
FIRST, SECOND = (tuple((k + 1) ** power * tap for k, tap in enumerate(TAPS)) for power in (1, 2))


@kernel
def coupled_blocks(counter, index, params, frame, size, footprints, begin, found, image, target, seconds, blocks):
    """Add to blocks (m, 9, 9) of the splats at index; heaviest first.

    size: height and width of the image.  footprints, found: as of `find_footprints`, from accumulator begin on.  image, target,
    seconds: as of `Coupling`.
    """
    L = lanes(params)
    pitch = frame.stride + 2 * EDGE
    ring, rows = scratch(params, 2 * RING * FIELDS * frame.stride), scratch(params, FIELDS * pitch)
    low, high = np.empty(RING, np.int64), np.empty(RING, np.int64)
    moved, sums, total = scratch(params, FACTORS * SLOPES * L), scratch(params, PAIRS * L), np.empty(PAIRS)
    part = np.empty(PAIRS, params.dtype)
    turn = fetch_and_increment(counter)
    while turn < index.size:
        splat = index[turn]
        box = box_of_rows(footprints, splat, frame, L)
        for channel in range(3):
            planes = (image, target, seconds, channel * frame.size)
            work = (ring, rows, low, high, moved, sums)
            couple(params, splat, channel, box, frame, size, footprints, begin, found, planes, work, part, total)
            spread(total, channel, blocks[turn])
        turn = fetch_and_increment(counter)


@formula
def box_of_rows(footprints, splat, frame, L):
    """First and last row of a splat, and its first and last column of tiles, in pixels."""
    y0, y1, x0, x1 = np.int64(1 << 40), np.int64(-1), np.int64(1 << 40), np.int64(-1)
    for a in range(footprints.splat_start[splat], footprints.splat_start[splat + 1]):
        top, bottom = row_range(footprints.rows[a])
        row, column = footprints.tiles[a] // frame.columns * TILE_ROWS, footprints.tiles[a] % frame.columns * L
        y0, y1, x0, x1 = min(y0, row + top), max(y1, row + bottom - 1), min(x0, column), max(x1, column)
    return y0, y1, x0, x1


@formula
def spread(total, channel, block):
    """Add a channel's sums to the entries of a block (9, 9)."""
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
def couple(params, splat, channel, box, frame, size, footprints, begin, found, planes, work, part, total):
    """The sums over all windows of a channel's M . S'' M, for every pair of slopes: total (PAIRS,)."""
    ring, rows, low, high, moved, sums = work
    y0, y1, x0, x1 = box
    L = lanes(params)
    width = x1 + L - x0
    low[:], high[:] = frame.stride, -1
    ring[: 2 * RING * FIELDS * width] = 0
    sums[:], total[:] = 0, 0
    behind, a = 0, footprints.splat_start[splat]
    for ahead in range(y0, y1 + 2 * REACH + 1):
        slot = ahead & (RING - 1)
        to = slot * FIELDS * width
        low[slot], high[slot] = frame.stride, -1
        if ahead <= y1:
            a = feed_row(params, splat, channel, ahead, box, frame, size[1], footprints, a, begin, found, planes, work)
        else:
            for j in range(to, to + FIELDS * width, L):
                store(ring, j, 0.0)
                store(ring, j + RING * FIELDS * width, 0.0)
        row = ahead - REACH
        if row < 0 or row >= size[0]:
            continue
        lo, hi = low.min(), high.max()
        if hi < 0:
            continue
        blur_columns(ring, ((row - REACH) & (RING - 1)) * FIELDS * width - x0, width, lo, hi, rows, frame, L)
        add_windows(params, splat, row, lo, hi, frame, planes, rows, moved, sums)
        behind += 1
        if behind == FLUSH:
            flush(sums, L, part, total)
            behind = 0
    flush(sums, L, part, total)


@formula
def feed_row(params, splat, channel, y, box, frame, image_width, footprints, a, begin, found, planes, work):
    """A row of the fields to the ring; a: an accumulator of the splat, at or before this row of tiles; where to begin next."""
    ring, _rows, low, high, _moved, _sums = work
    _y0, _y1, x0, x1 = box
    L = lanes(params)
    width, slot = x1 + L - x0, y & (RING - 1)
    last, tile_row = footprints.splat_start[splat + 1], y // TILE_ROWS
    while footprints.tiles[a] // frame.columns < tile_row:
        a += 1
    at, done = a, x0
    lo, hi = frame.stride, np.int64(-1)
    base = slot * FIELDS * width - x0
    while at < last and footprints.tiles[at] // frame.columns == tile_row:
        top, bottom = row_range(footprints.rows[at])
        inside = y - tile_row * TILE_ROWS
        if top <= inside < bottom:
            x = np.int64(footprints.tiles[at] % frame.columns) * L
            lo, hi = min(lo, x), x
            clear_columns(ring, base, done, x, width, L)
            where = (footprints.place[at] - footprints.place[begin] + inside - top) * FOOTPRINT * L
            feed(params, splat, x, y, channel, frame, image_width, where, found, planes, ring, base + x, width)
            done = x + L
        at += 1
    clear_columns(ring, base, done, x1 + L, width, L)
    low[slot], high[slot] = lo, hi
    return a


@formula
def clear_columns(ring, base, start, stop, width, L):
    for field in range(FIELDS):
        for x in range(start, stop, L):
            store(ring, base + field * width + x, 0.0)
            store(ring, base + (RING * FIELDS + field) * width + x, 0.0)


@formula
def feed(params, splat, x, y, channel, frame, image_width, where, found, planes, ring, to, width):
    """The fields of the lanes at x, to both copies of their row."""
    L = lanes(params)
    image, target, _seconds, top = planes
    _u, terms = alpha_terms(params, splat * PARAMS, x, y)
    v = terms[0]
    inside = iota(params) < broadcast(params, image_width - x)
    w, D = select(inside, load(found, where), 0.0), select(inside, load(found, where + (1 + channel) * L), 0.0)
    aim = load(target, top + y * frame.stride + x)
    residual = load(image, top + y * frame.stride + x) - aim
    for _copy in range(2):
        put_powers(ring, to, width, w, D, v)
        put_powers(ring, to + POWERS * width, width, 2.0 * residual * w, 2.0 * residual * D, v)
        put_powers(ring, to + 2 * POWERS * width, width, (aim - CENTRE) * w, (aim - CENTRE) * D, v)
        to += RING * FIELDS * width


@formula
def put_powers(ring, to, width, w, D, v):
    Dv = D * v
    store(ring, to, D)
    store(ring, to + width, Dv)
    store(ring, to + 2 * width, Dv * v)
    store(ring, to + 3 * width, w)


@formula
def dot5(x, taps):
    return x[0] * taps[0] + x[1] * taps[1] + x[2] * taps[2] + x[3] * taps[3] + x[4] * taps[4]


@formula
def sums_around(array, at, step):
    return (
        load(array, at + step) + load(array, at - step),
        load(array, at + 2 * step) + load(array, at - 2 * step),
        load(array, at + 3 * step) + load(array, at - 3 * step),
        load(array, at + 4 * step) + load(array, at - 4 * step),
        load(array, at + 5 * step) + load(array, at - 5 * step),
    )


@formula
def differences_around(array, at):
    return (
        load(array, at + 1) - load(array, at - 1),
        load(array, at + 2) - load(array, at - 2),
        load(array, at + 3) - load(array, at - 3),
        load(array, at + 4) - load(array, at - 4),
        load(array, at + 5) - load(array, at - 5),
    )


@formula
def blur_columns(ring, base, width, lo, hi, rows, frame, L):
    """The window down the columns lo .. hi + L - 1 of every field, to bordered rows; base: of the window's first row."""
    step, pitch, beyond = FIELDS * width, frame.stride + 2 * EDGE, 2 * max(L, 8)
    for field in range(FIELDS):
        to, at = field * pitch + EDGE, base + field * width + REACH * step
        for x in range(lo, hi + L, L):
            store(rows, to + x, load(ring, at + x) * MIDDLE + dot5(sums_around(ring, at + x, step), TAPS))
        for x in range(0, beyond, L):
            store(rows, to + lo - L - x, 0.0)
            store(rows, to + hi + L + x, 0.0)


@formula
def add_windows(params, splat, row, lo, hi, frame, planes, rows, moved, sums):
    """Add a row's windows to the sums; lo, hi: the columns of pixels that the splat moves."""
    _image, _target, seconds, top = planes
    L = lanes(params)
    along, pitch, size = broadcast(params, params[splat * PARAMS + ALONG]), frame.stride + 2 * EDGE, 3 * frame.size
    first = max((lo - REACH) // L * L, 0)
    last = min((hi + L - 1 + REACH) // L * L, frame.stride - L)
    for x in range(first, last + L, L):
        u, _terms = alpha_terms(params, splat * PARAMS, x, row)
        for factor in range(FACTORS):
            blur_row(rows, POWERS * factor * pitch + EDGE + x, pitch, u, along, moved, SLOPES * factor * L)
        p = top + row * frame.stride + x
        second = (
            load(seconds, p), load(seconds, p + size), load(seconds, p + 2 * size),
            load(seconds, p + 3 * size), load(seconds, p + 4 * size), load(seconds, p + 5 * size),
        )  # fmt: skip
        add_pairs(moved, second, sums, L)


@formula
def blur_row(rows, at, pitch, u, along, moved, to):
    """The blurred slopes with one factor at the lanes at `at`, from the columns' fields."""
    L = lanes(rows)
    F, s, d = load(rows, at), sums_around(rows, at, 1), differences_around(rows, at)
    B0, B1, B2 = F * MIDDLE + dot5(s, TAPS), along * dot5(d, FIRST), along * along * dot5(s, SECOND)
    Fv, sv = load(rows, at + pitch), sums_around(rows, at + pitch, 1)
    C0, C1 = Fv * MIDDLE + dot5(sv, TAPS), along * dot5(differences_around(rows, at + pitch), FIRST)
    uB = u * B0 + B1
    store(moved, to, B0)
    store(moved, to + L, uB)
    store(moved, to + 2 * L, C0)
    store(moved, to + 3 * L, u * (uB + B1) + B2)
    store(moved, to + 4 * L, u * C0 + C1)
    for field in range(2, 4):
        at_field = at + field * pitch
        store(moved, to + (3 + field) * L, load(rows, at_field) * MIDDLE + dot5(sums_around(rows, at_field, 1), TAPS))


@formula
def add_pairs(moved, second, sums, L):
    """Add M . S'' M of every pair of slopes."""
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
    """Empty the sums into total."""
    for j in range(0, PAIRS, 4):
        at = j * L
        store_sums(part, j, (load(sums, at), load(sums, at + L), load(sums, at + 2 * L), load(sums, at + 3 * L)))
    for j in range(PAIRS):
        total[j] += part[j]
        store(sums, j * L, 0.0)
