"""The window of SSIM on the CPU: blurs in one pass down the rows, and the window's mean and variance around every pixel.

A blur is separable.  Along a row it is computed at once, from a bordered row: `stride` numbers with BORDER zeros at either
side.  Down the columns it is computed from a ring: the last RING rows of each field, blurred along themselves.  Outside the
image every field is 0.

The variance blur(y^2) - blur(y)^2 cancels.  That of the separable window is, by the law of total variance,

    var = blur_down(var_along) + var_down(mean_along)       var_1d = sum w_k d_k^2 - (sum w_k d_k)^2,  d_k = y_k - y_0

whose relative error is round-off times mean / std, as that of rounding y itself, not the square of it: the square that is
subtracted is at most 1 / w_0 = 3.8 times the difference, w_0 the middle weight.

Kernels take a range of `rows`, those of the three channels one after the other, and work out for themselves what they need
beyond its ends.  Fields are flat plane sets (3, plane_rows, stride) of `shape` = (height, width, plane_rows, stride).
"""

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.planes import scratch
from splat.backend.cpu.simd import lanes, load, store
from splat.losses.reference import REACH

BORDER = 16  # numbers, at least REACH; whole cache lines
RING = 16  # rows, at least WINDOW; a power of two


@formula
def bordered_rows(like, fields, stride):
    """Uninitialised bordered rows, side by side."""
    return scratch(like, fields * (stride + 2 * BORDER))


@formula
def ring_buffer(like, fields, stride):
    return scratch(like, fields * RING * stride)


@formula
def ring_row(field, y, stride):
    """The place of row y of a field in a ring."""
    return (field * RING + (y & (RING - 1))) * stride


@formula
def clear(ring, first, fields, y, stride):
    """Row y of the fields of a ring from `first` on is 0, as a row outside of the image."""
    for field in range(first, first + fields):
        at = ring_row(field, y, stride)
        for i in range(stride):
            ring[at + i] = 0


@formula
def put(rows, i, stride, numbers):
    """Numbers at column i of as many bordered rows."""
    for field in range(len(numbers)):
        store(rows, field * (stride + 2 * BORDER) + BORDER + i, numbers[field])


@formula
def begin_of(rows, field, width, stride):
    """Where a bordered row has its first number; what follows its `width` numbers, and what precedes them, is set to 0."""
    at = field * (stride + 2 * BORDER)
    for i in range(BORDER):
        rows[at + i] = 0
    for i in range(BORDER + width, stride + 2 * BORDER):
        rows[at + i] = 0
    return at + BORDER


@formula
def blur_along(rows, fields, width, stride, taps, ring, first, y):
    """The window along bordered rows of `width` numbers, to row y of the fields of a ring from `first` on."""
    for field in range(fields):
        begin, at = begin_of(rows, field, width, stride), ring_row(first + field, y, stride)
        for i in range(0, stride, lanes(rows)):
            total = load(rows, begin + i) * taps[REACH]
            for k in range(1, REACH + 1):
                total += (load(rows, begin + i - k) + load(rows, begin + i + k)) * taps[REACH + k]
            store(ring, at + i, total)


@formula
def blur_down(ring, field, y, i, stride, taps):
    """The window over the rows around y of a field, at the lanes at i."""
    total = load(ring, ring_row(field, y, stride) + i) * taps[REACH]
    for k in range(1, REACH + 1):
        above, below = ring_row(field, y - k, stride) + i, ring_row(field, y + k, stride) + i
        total += (load(ring, above) + load(ring, below)) * taps[REACH + k]
    return total


@formula
def blur_down_three(ring, field, y, i, stride, taps):
    """`blur_down` of three fields from one on."""
    one, two = blur_down(ring, field, y, i, stride, taps), blur_down(ring, field + 1, y, i, stride, taps)
    return one, two, blur_down(ring, field + 2, y, i, stride, taps)


@formula
def row_sum(values, width):
    """The sum of a bordered row in float64; four chains of additions, because one would wait for itself."""
    a = b = c = d = 0.0
    whole = width & ~3
    for i in range(BORDER, BORDER + whole, 4):
        a, b, c, d = a + values[i], b + values[i + 1], c + values[i + 2], d + values[i + 3]
    for i in range(BORDER + whole, BORDER + width):
        a += values[i]
    return (a + b) + (c + d)


@formula
def moments_along(rows, field, width, stride, taps, ring, first, y):
    """The window's mean and variance along one of the bordered rows, to row y of two fields of the ring."""
    begin = begin_of(rows, field, width, stride)
    for i in range(0, stride, lanes(rows)):
        middle = load(rows, begin + i)
        shift = square = middle * 0.0
        for k in range(1, REACH + 1):
            before, after = load(rows, begin + i - k) - middle, load(rows, begin + i + k) - middle
            shift += (before + after) * taps[REACH + k]
            square += (before * before + after * after) * taps[REACH + k]
        store(ring, ring_row(first, y, stride) + i, middle + shift)
        store(ring, ring_row(first + 1, y, stride) + i, square - shift * shift)


@formula
def moments_down(ring, first, y, i, stride, taps):
    """The window's mean and variance at row y, at the lanes at i, from two fields of the ring."""
    middle = load(ring, ring_row(first, y, stride) + i)
    shift = square = middle * 0.0
    for k in range(1, REACH + 1):
        above, below = ring_row(first, y - k, stride) + i, ring_row(first, y + k, stride) + i
        before, after = load(ring, above) - middle, load(ring, below) - middle
        shift += (before + after) * taps[REACH + k]
        square += (before * before + after * after) * taps[REACH + k]
    return middle + shift, blur_down(ring, first + 1, y, i, stride, taps) + (square - shift * shift)


@formula
def channel_part(start, stop, channel, height):
    """The rows of a channel that a range of rows covers; none where the first is not below the second."""
    return max(start - channel * height, 0), min(stop - channel * height, height)


@kernel
def moments_rows(start, stop, shape, taps, y, moments):
    """mu and var (2 plane sets): the window's mean and variance of y."""
    height, width, plane_rows, stride = shape
    L, size = lanes(y), 3 * plane_rows * stride
    rows, ring = bordered_rows(y, 1, stride), ring_buffer(y, 2, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for ahead in range(first - REACH, last + REACH):
            if 0 <= ahead < height:
                for i in range(0, stride, L):
                    store(rows, BORDER + i, load(y, top + ahead * stride + i))
                moments_along(rows, 0, width, stride, taps, ring, 0, ahead)
            else:
                clear(ring, 0, 2, ahead, stride)
            row = ahead - REACH
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, L):
                mean, variance = moments_down(ring, 0, row, i, stride, taps)
                store(moments, at + i, mean)
                store(moments, size + at + i, variance)
