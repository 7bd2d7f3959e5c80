"""The loss between two images that both depend on the parameters: its value and both gradients in one sweep.

The formulas are in `splat/losses/formulas.py`.  Four blurs in and four out, where a loss against each image as the other's
target takes sixteen.
"""

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import lanes, load, store
from splat.losses.cpu.window import (
    BORDER,
    REACH,
    blur_along,
    blur_down,
    blur_down_three,
    bordered_rows,
    channel_part,
    clear,
    moments_along,
    moments_down,
    put,
    ring_buffer,
    row_sum,
)
from splat.losses.formulas import pair_adjoint, pair_slopes, pixel_slope

FIELDS = 4  # in the first ring: m, p, M, V; in the second what is blurred for the gradients in r (2) and in a (2)


@formula
def feed_pair(x, y, top, row, shape, taps, rows, ring):
    """Stage one: row `row` of r, r^2 and a of the channel that begins at `top`, blurred along itself, to the ring."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear(ring, 0, FIELDS, row, stride)
        return
    at = top + row * stride
    for i in range(0, stride, lanes(x)):
        one, other = load(x, at + i), load(y, at + i)
        r = one - other
        put(rows, i, stride, (r, r * r, 0.5 * (one + other)))
    blur_along(rows, 2, width, stride, taps, ring, 0, row)
    moments_along(rows, 2, width, stride, taps, ring, 2, row)


@formula
def differentiate_pair(ring, row, shape, taps, rows, values, slopes):
    """Stage two: the fields of `pair_slopes` at a row, blurred along it; the sum of 1 - S."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear(slopes, 0, FIELDS, row, stride)
        return 0.0
    for i in range(0, stride, lanes(ring)):
        m, p = blur_down(ring, 0, row, i, stride, taps), blur_down(ring, 1, row, i, stride, taps)
        mean, variance = moments_down(ring, 2, row, i, stride, taps)
        distance, in_m, in_p, in_mean, in_variance = pair_slopes(m, p, mean, variance)
        store(values, BORDER + i, distance)
        put(rows, i, stride, (in_m, in_p, in_mean, in_variance))
    blur_along(rows, FIELDS, width, stride, taps, slopes, 0, row)
    return row_sum(values, width)


@kernel
def consistency_rows(start, stop, shape, taps, x, y, kind, eps, pixel, structural, in_x, in_y, pixels, distances):
    """The gradients of the loss in x and y; sums over each row of the pixel loss and of 1 - S.  Arguments as in `sweeps.py`."""
    height, width, plane_rows, stride = shape
    rows, values = bordered_rows(x, FIELDS, stride), bordered_rows(x, 1, stride)
    ring, slopes = ring_buffer(x, FIELDS, stride), ring_buffer(x, FIELDS, stride)
    lead = 2 * REACH if structural != 0 else 0
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_pair(x, y, top, ahead, shape, taps, rows, ring)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    distance = differentiate_pair(ring, row, shape, taps, rows, values, slopes)
                    if first <= row < last:
                        distances[channel * height + row] = distance
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, lanes(x)):
                one, other = load(x, at + i), load(y, at + i)
                value, slope = pixel_slope(one - other, kind, eps)
                store(values, BORDER + i, value)
                one_bar, other_bar = slope * pixel, -(slope * pixel)
                if structural != 0:
                    bm, bp, ba = blur_down_three(slopes, 0, row, i, stride, taps)
                    bv = blur_down(slopes, 3, row, i, stride, taps)
                    one_bar, other_bar = pair_adjoint(one, other, slope * pixel, structural, bm, bp, ba, bv)
                store(in_x, at + i, one_bar)
                store(in_y, at + i, other_bar)
            pixels[channel * height + row] = row_sum(values, width)
