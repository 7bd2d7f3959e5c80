"""The window of SSIM on the CPU: blurs in one pass down the rows, and the window's mean and variance around every pixel.

A blur is separable.  Along a row it is computed at once, from a bordered row: `stride` numbers with BORDER zeros at either
side.  Down the columns it is computed from a ring: the last RING rows of each field, blurred along themselves.  Outside the
image every field is 0.

The variance blur(y^2) - blur(y)^2 cancels.  That of the separable window is, by the law of total variance,

    var = blur_down(var_along) + var_down(mean_along)       var_1d = sum w_k d_k^2 - (sum w_k d_k)^2,  d_k = y_k - y_0

whose relative error is round-off times mean / std, as that of rounding y itself, not the square of it: the square that is
subtracted is at most 1 / w_0 = 3.8 times the difference, w_0 the middle weight.

Kernels take a range of rows, those of the three channels one after the other, and work out for themselves what they need
beyond its ends.  Fields are flat plane sets (3, plane_rows, stride); the image is their part (3, height, width).
"""

from typing import NamedTuple

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import neighbours, scratch
from splat.backend.cpu.simd import broadcast, lane_sum, lanes, load, load_wide, store
from splat.losses.reference import REACH

BORDER = 16  # numbers, at least REACH; whole cache lines
RING = 16  # rows, at least WINDOW; a power of two
TRIPLE = 3  # fields of a ring that lie together: a loss blurs three at a time


class Frame(NamedTuple):
    """The sizes of plane sets, and the weights of a window: the middle one, then those at 1 to REACH on either side."""

    height: int
    width: int
    plane_rows: int
    stride: int
    taps: tuple[np.floating, ...]


@formula
def bordered_rows(like, fields, frame):
    """Bordered rows of zeros, side by side."""
    rows = scratch(like, fields * (frame.stride + 2 * BORDER))
    rows[:] = 0
    return rows


@formula
def ring_buffer(like, fields, frame):
    return scratch(like, (fields + TRIPLE - 1) // TRIPLE * RING * TRIPLE * ring_pitch(frame))


@formula
def ring_pitch(frame):
    """Numbers of a field from a row to the next: an odd number of 16, so that rows do not share sets of the cache."""
    return ((frame.stride + 15) // 16 | 1) * 16


@formula
def ring_at(ring, field, y, i, frame):
    """The place of row y of a field in a ring, at the lanes at i: a row of three fields takes a vector of each in turn."""
    row = field // TRIPLE * RING + (y & (RING - 1))
    return TRIPLE * (row * ring_pitch(frame) + i) + field % TRIPLE * lanes(ring)


@formula
def clear(ring, first, fields, y, frame):
    """Row y of the fields of a ring from `first` on is 0, as a row outside of the image."""
    for field in range(first, first + fields):
        for i in range(0, frame.stride, lanes(ring)):
            store(ring, ring_at(ring, field, y, i, frame), 0.0)


@formula
def clear_padding(plane, at, frame):
    """The row of a plane that begins at `at` is 0 behind the image."""
    for i in range(frame.width, frame.stride):
        plane[at + i] = 0


@formula
def put(rows, i, frame, numbers):
    """Numbers at column i of as many bordered rows."""
    for field in range(len(numbers)):
        store(rows, field * (frame.stride + 2 * BORDER) + BORDER + i, numbers[field])


@formula
def counts(row, margin, frame):
    """Whether a row is far enough from the image's upper and lower edges."""
    return margin <= row < frame.height - margin


@formula
def leave_margin(rows, fields, margin, frame):
    """Bordered rows are 0 so near to the image's left and right edges."""
    for field in range(fields):
        at = field * (frame.stride + 2 * BORDER) + BORDER
        for i in range(margin):
            rows[at + i] = 0
            rows[at + frame.width - 1 - i] = 0


@formula
def begin_of(rows, field, frame):
    """Index of the first number of a bordered row; what follows its `width` numbers is set to 0."""
    at = field * (frame.stride + 2 * BORDER) + BORDER
    for i in range(frame.width, frame.stride):
        rows[at + i] = 0
    return at


@formula
def blur_along(rows, fields, frame, ring, first, y):
    """The window along bordered rows, to row y of the fields of a ring from `first` on."""
    for field in range(fields):
        begin = begin_of(rows, field, frame)
        for i in range(0, frame.stride, lanes(rows)):
            blurred = weighted(load(rows, begin + i), both_ways(neighbours(rows, begin + i))[0], frame.taps)
            store(ring, ring_at(ring, first + field, y, i, frame), blurred)


@formula
def both_ways(near):
    """F(x + t) + F(x - t) and F(x + t) - F(x - t) for t = 1 to 5; near: of `neighbours`."""
    p1, p2, p3, p4, p5, m1, m2, m3, m4, m5 = near
    return (p1 + m1, p2 + m2, p3 + m3, p4 + m4, p5 + m5), (p1 - m1, p2 - m2, p3 - m3, p4 - m4, p5 - m5)


@formula
def weighted(middle, pairs, taps):
    """A window's sum, of its middle number and the sums of two at equal distances from it."""
    total = middle * taps[0] + pairs[0] * taps[1]
    return total + pairs[1] * taps[2] + pairs[2] * taps[3] + pairs[3] * taps[4] + pairs[4] * taps[5]


@formula
def two_rows(ring, field, y, k, i, frame):
    """The sum of the rows k above and k below y of a field of a ring, at the lanes at i."""
    return load(ring, ring_at(ring, field, y - k, i, frame)) + load(ring, ring_at(ring, field, y + k, i, frame))


@formula
def blur_down(ring, field, y, i, frame):
    """The window over the rows around y of a field, at the lanes at i."""
    pairs = (
        two_rows(ring, field, y, 1, i, frame), two_rows(ring, field, y, 2, i, frame), two_rows(ring, field, y, 3, i, frame),
        two_rows(ring, field, y, 4, i, frame), two_rows(ring, field, y, 5, i, frame),
    )  # fmt: skip
    return weighted(load(ring, ring_at(ring, field, y, i, frame)), pairs, frame.taps)


@formula
def blur_down_three(ring, field, y, i, frame):
    """`blur_down` of three fields from one on."""
    one, two = blur_down(ring, field, y, i, frame), blur_down(ring, field + 1, y, i, frame)
    return one, two, blur_down(ring, field + 2, y, i, frame)


@formula
def row_sum(values, width):
    """The sum of a bordered row in float64; two chains of additions, because one would wait for itself."""
    L = lanes(np.empty(0))
    a = b = broadcast(np.empty(0), 0.0)
    whole = width // (2 * L) * (2 * L)
    for i in range(BORDER, BORDER + whole, 2 * L):
        a, b = a + load_wide(values, i), b + load_wide(values, i + L)
    total = lane_sum(a + b)
    for i in range(BORDER + whole, BORDER + width):
        total += values[i]
    return total


@formula
def moments_along(rows, field, frame, ring, first, y):
    """The window's mean and variance along one of the bordered rows, to row y of two fields of the ring."""
    begin = begin_of(rows, field, frame)
    for i in range(0, frame.stride, lanes(rows)):
        middle = load(rows, begin + i)
        shift = square = middle * 0.0
        for k in range(1, REACH + 1):
            before, after = load(rows, begin + i - k) - middle, load(rows, begin + i + k) - middle
            shift += (before + after) * frame.taps[k]
            square += (before * before + after * after) * frame.taps[k]
        store(ring, ring_at(ring, first, y, i, frame), middle + shift)
        store(ring, ring_at(ring, first + 1, y, i, frame), square - shift * shift)


@formula
def moments_down(ring, first, y, i, frame):
    """The window's mean and variance at row y, at the lanes at i, from two fields of the ring."""
    middle = load(ring, ring_at(ring, first, y, i, frame))
    shift = square = middle * 0.0
    for k in range(1, REACH + 1):
        above, below = ring_at(ring, first, y - k, i, frame), ring_at(ring, first, y + k, i, frame)
        before, after = load(ring, above) - middle, load(ring, below) - middle
        shift += (before + after) * frame.taps[k]
        square += (before * before + after * after) * frame.taps[k]
    return middle + shift, blur_down(ring, first + 1, y, i, frame) + (square - shift * shift)


@formula
def part_of(start, stop, channel, lead, frame):
    """A range's part of a channel: where the channel begins, the part's first row and the one after its last; rows to feed.

    The latter begin `lead` rows before the part and end as many behind it; none where the part has no rows.
    """
    first, last = max(start - channel * frame.height, 0), min(stop - channel * frame.height, frame.height)
    ahead = range(first - lead, last + lead) if first < last else range(0)
    return channel * frame.plane_rows * frame.stride, first, last, ahead


@kernel
def moments_rows(start, stop, frame, y, moments):
    """mu and var (2 plane sets): the window's mean and variance of y."""
    size = 3 * frame.plane_rows * frame.stride
    rows, ring = bordered_rows(y, 1, frame), ring_buffer(y, 2, frame)
    for channel in range(3):
        top, first, _last, rows_ahead = part_of(start, stop, channel, REACH, frame)
        for ahead in rows_ahead:
            if 0 <= ahead < frame.height:
                for i in range(0, frame.stride, lanes(y)):
                    store(rows, BORDER + i, load(y, top + ahead * frame.stride + i))
                moments_along(rows, 0, frame, ring, 0, ahead)
            else:
                clear(ring, 0, 2, ahead, frame)
            row = ahead - REACH
            if row < first:
                continue
            at = top + row * frame.stride
            for i in range(0, frame.stride, lanes(y)):
                mean, variance = moments_down(ring, 0, row, i, frame)
                store(moments, at + i, mean)
                store(moments, size + at + i, variance)
