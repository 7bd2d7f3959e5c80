"""The window of SSIM on the CPU: blurs in one sweep down the rows, and the window's mean and variance round every pixel.

A blur is separable: along each row at once, down the columns out of a `ring` of the last RING rows.  Outside the image
everything is 0.

The variance blur(y^2) - blur(y)^2 cancels.  That of the separable window is, by the law of total variance,

    var = blur_down(var_along) + var_down(mean_along)       var_1d = sum w_k d_k^2 - (sum w_k d_k)^2,  d_k = y_k - y_0

whose relative error is round-off times mean / std, that of rounding y itself, not the square of it: the square taken away
is at most 1 / w_0 = 3.8 times what is left, w_0 the middle weight.

Kernels take a range of `rows`, those of the three channels one after the other; fields are flat plane sets (3, plane_rows,
stride) of `shape` = (height, width, plane_rows, stride).  What a range needs beyond its ends it works out for itself.
"""

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.planes import scratch
from splat.backend.cpu.simd import lanes, load, store
from splat.losses.reference import WINDOW

BORDER = 16  # floats before a row in scratch, so that the window may look past its ends
REACH = WINDOW // 2
RING = 16  # rows; a power of two, at least WINDOW


@formula
def row_buffer(like, stride):
    return scratch(like, stride + 2 * BORDER + 16)


@formula
def ring_buffer(like, fields, stride):
    return scratch(like, fields * RING * stride)


@formula
def ring_row(field, y, stride):
    """Where row y of a field lies in a ring."""
    return (field * RING + (y & (RING - 1))) * stride


@formula
def clear(ring, field, y, stride):
    """Rows outside the image are 0."""
    at = ring_row(field, y, stride)
    for i in range(stride):
        ring[at + i] = 0


@formula
def clear_borders(buffer, width):
    """A bordered row is 0 beyond its `width` numbers."""
    for i in range(BORDER):
        buffer[i] = 0
    for i in range(BORDER + width, buffer.size):
        buffer[i] = 0


@formula
def blur_along(buffer, width, stride, taps, ring, at):
    """The window along a bordered row of `width` numbers, to ring[at:]."""
    clear_borders(buffer, width)
    for i in range(0, stride, lanes(buffer)):
        total = load(buffer, BORDER + i) * taps[REACH]
        for k in range(1, REACH + 1):
            total += (load(buffer, BORDER + i - k) + load(buffer, BORDER + i + k)) * taps[REACH + k]
        store(ring, at + i, total)


@formula
def blur_down(ring, field, y, i, stride, taps):
    """The window over the rows round y of a ring, at the lanes at i."""
    total = load(ring, ring_row(field, y, stride) + i) * taps[REACH]
    for k in range(1, REACH + 1):
        above, below = ring_row(field, y - k, stride) + i, ring_row(field, y + k, stride) + i
        total += (load(ring, above) + load(ring, below)) * taps[REACH + k]
    return total


@formula
def row_sum(values, width):
    """In float64; four chains of additions, because one would wait for itself."""
    a = b = c = d = 0.0
    whole = width & ~3
    for i in range(BORDER, BORDER + whole, 4):
        a, b, c, d = a + values[i], b + values[i + 1], c + values[i + 2], d + values[i + 3]
    for i in range(BORDER + whole, BORDER + width):
        a += values[i]
    return (a + b) + (c + d)


@formula
def moments_along(buffer, width, stride, taps, ring, mean, variance, y):
    """The window's mean and variance along a bordered row, to row y of two fields of the ring."""
    clear_borders(buffer, width)
    for i in range(0, stride, lanes(buffer)):
        middle = load(buffer, BORDER + i)
        shift = square = middle * 0.0
        for k in range(1, REACH + 1):
            before, after = load(buffer, BORDER + i - k) - middle, load(buffer, BORDER + i + k) - middle
            shift += (before + after) * taps[REACH + k]
            square += (before * before + after * after) * taps[REACH + k]
        store(ring, ring_row(mean, y, stride) + i, middle + shift)
        store(ring, ring_row(variance, y, stride) + i, square - shift * shift)


@formula
def moments_down(ring, mean, variance, y, i, stride, taps):
    """The window's mean and variance at row y, at the lanes at i, from two fields of the ring."""
    middle = load(ring, ring_row(mean, y, stride) + i)
    within = load(ring, ring_row(variance, y, stride) + i) * taps[REACH]
    shift = square = middle * 0.0
    for k in range(1, REACH + 1):
        above, below = ring_row(mean, y - k, stride) + i, ring_row(mean, y + k, stride) + i
        before, after = load(ring, above) - middle, load(ring, below) - middle
        shift += (before + after) * taps[REACH + k]
        square += (before * before + after * after) * taps[REACH + k]
        above, below = ring_row(variance, y - k, stride) + i, ring_row(variance, y + k, stride) + i
        within += (load(ring, above) + load(ring, below)) * taps[REACH + k]
    return middle + shift, within + (square - shift * shift)


@formula
def channel_part(start, stop, channel, height):
    """The rows of a channel that a range of rows covers; none where the first is not beneath the second."""
    return max(start - channel * height, 0), min(stop - channel * height, height)


@kernel
def moments_rows(start, stop, shape, taps, y, moments):
    """mu and var (2 plane sets): the window's mean and variance of y."""
    height, width, plane_rows, stride = shape
    L, size = lanes(y), 3 * plane_rows * stride
    buffer, ring = row_buffer(y, stride), ring_buffer(y, 2, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for ahead in range(first - REACH, last + REACH):
            if 0 <= ahead < height:
                for i in range(0, stride, L):
                    store(buffer, BORDER + i, load(y, top + ahead * stride + i))
                moments_along(buffer, width, stride, taps, ring, 0, 1, ahead)
            else:
                clear(ring, 0, ahead, stride)
                clear(ring, 1, ahead, stride)
            row = ahead - REACH
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, L):
                mean, variance = moments_down(ring, 0, 1, row, i, stride, taps)
                store(moments, at + i, mean)
                store(moments, size + at + i, variance)
