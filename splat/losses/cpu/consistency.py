"""The kernel of the loss between two images that both depend on the parameters: value and both gradients in one sweep.

The loss of x and y is symmetric, so it is written in r = x - y and a = (x + y) / 2, whose blurs tell all there is to know of
the two: m and p, the window's means of r and r^2, and M and V, its mean and variance of a.  At a pixel and channel

    1 - S = 1 - l s       l = 1 - m^2 / B1     B1 = 2 M^2 + m^2 / 2 + C1         (2 M^2 + m^2 / 2 = mu_x^2 + mu_y^2)
                          s = 1 - w / B2       B2 = 2 V + w / 2 + C2             (2 V + w / 2 = var_x + var_y)
                                               w = p - m^2, the variance of r

With D = 1 - S and the partial derivatives D_m, D_p, D_M, D_V, and c = 1/2 (which centres pictures),

    gradient of sum D in r      blur(D_m) + 2 r blur(D_p)                               (that in x is half the one in a
                     in a       blur(D_M - 2 (M - c) D_V) + 2 (a - c) blur(D_V)          plus that in r; in y, minus)

Four blurs in and four out, where a loss against each image as the other's target takes sixteen.
"""

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import lanes, load, store
from splat.losses.cpu.window import (
    BORDER,
    REACH,
    blur_along,
    blur_down,
    channel_part,
    clear,
    moments_along,
    moments_down,
    ring_buffer,
    ring_row,
    row_buffer,
    row_sum,
)
from splat.losses.formulas import CENTRE, pair_slopes, pixel_slope

FIELDS = 4  # in the ring: m, p, M, V; in that of the slopes: what is blurred for the gradients in r (2) and in a (2)


@formula
def feed_pair(x, y, top, row, shape, taps, b0, b1, b2, ring):
    """Stage one: row `row` of r, r^2 and a of the channel that begins at `top`, blurred along itself, to the ring."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        for field in range(FIELDS):
            clear(ring, field, row, stride)
        return
    at = top + row * stride
    for i in range(0, stride, lanes(x)):
        one, other = load(x, at + i), load(y, at + i)
        r = one - other
        store(b0, BORDER + i, r)
        store(b1, BORDER + i, r * r)
        store(b2, BORDER + i, 0.5 * (one + other))
    blur_along(b0, width, stride, taps, ring, ring_row(0, row, stride))
    blur_along(b1, width, stride, taps, ring, ring_row(1, row, stride))
    moments_along(b2, width, stride, taps, ring, 2, 3, row)


@formula
def differentiate_pair(ring, row, shape, taps, b0, b1, b2, b3, values, slopes):
    """Stage two: the derivatives of 1 - S at a row, blurred along it; the sum of 1 - S."""
    _height, width, _plane_rows, stride = shape
    for i in range(0, stride, lanes(ring)):
        m, p = blur_down(ring, 0, row, i, stride, taps), blur_down(ring, 1, row, i, stride, taps)
        mean, variance = moments_down(ring, 2, 3, row, i, stride, taps)
        distance, in_m, in_p, in_mean, in_variance = pair_slopes(m, p, mean, variance)
        store(values, BORDER + i, distance)
        store(b0, BORDER + i, in_m)
        store(b1, BORDER + i, in_p)
        store(b2, BORDER + i, in_mean)
        store(b3, BORDER + i, in_variance)
    blur_along(b0, width, stride, taps, slopes, ring_row(0, row, stride))
    blur_along(b1, width, stride, taps, slopes, ring_row(1, row, stride))
    blur_along(b2, width, stride, taps, slopes, ring_row(2, row, stride))
    blur_along(b3, width, stride, taps, slopes, ring_row(3, row, stride))
    return row_sum(values, width)


@kernel
def consistency_rows(start, stop, shape, taps, x, y, kind, eps, pixel, structural, in_x, in_y, pixels, distances):
    """The gradients of the loss in x and y; sums over each row of the pixel loss and of 1 - S (unless structural = 0).

    pixel, structural: weights of the two losses over the number of values.
    """
    height, width, plane_rows, stride = shape
    b0, b1, b2, b3 = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    ring, slopes, values = ring_buffer(x, FIELDS, stride), ring_buffer(x, FIELDS, stride), row_buffer(x, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        lead = 2 * REACH if structural != 0 else 0
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_pair(x, y, top, ahead, shape, taps, b0, b1, b2, ring)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        total = differentiate_pair(ring, row, shape, taps, b0, b1, b2, b3, values, slopes)
                        if first <= row < last:
                            distances[channel * height + row] = total
                    else:
                        for field in range(FIELDS):
                            clear(slopes, field, row, stride)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, lanes(x)):
                one, other = load(x, at + i), load(y, at + i)
                r = one - other
                value, slope = pixel_slope(r, kind, eps)
                apart, along = slope * pixel, r * 0.0
                store(values, BORDER + i, value)
                if structural != 0:
                    bm, bp = blur_down(slopes, 0, row, i, stride, taps), blur_down(slopes, 1, row, i, stride, taps)
                    ba, bv = blur_down(slopes, 2, row, i, stride, taps), blur_down(slopes, 3, row, i, stride, taps)
                    apart += structural * (bm + 2.0 * r * bp)
                    along = structural * (0.5 * ba + (0.5 * (one + other) - CENTRE) * bv)
                store(in_x, at + i, along + apart)
                store(in_y, at + i, along - apart)
            pixels[channel * height + row] = row_sum(values, width)
