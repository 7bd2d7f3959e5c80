"""The sweeps of the losses: value, gradient, Hessian-vector product and diagonal, each in one pass down the rows.

A sweep (`window_kernels.py`) has up to three stages, each REACH rows behind the one before: products blurred along the row;
partial derivatives at a row (`losses_formulas.py`), blurred along it; the result at a row.  So nothing of the size of an image
is written but the result, and nothing is held for a tangent but the two images: m, p, q and blur(S_p) are blurred again beside
it: half as much again of the work, a fifteenth of an H v, where six plane sets of S's second derivatives and two more would be
held.
"""

from splat.losses_formulas import (
    CENTRE,
    SECONDS,
    bent,
    own_bend,
    pixel_curvature,
    pixel_slope,
    seconds_of,
    similarity,
    slopes_of,
    spread,
)
from splat.raster.jit import formula, kernel
from splat.raster.simd import broadcast, lanes, load, store
from splat.window_kernels import (
    BORDER,
    REACH,
    blur_along,
    blur_down,
    channel_part,
    clear,
    ring_buffer,
    ring_row,
    row_buffer,
    row_sum,
)


@formula
def blur_three(b0, b1, b2, width, stride, taps, ring, row):
    blur_along(b0, width, stride, taps, ring, ring_row(0, row, stride))
    blur_along(b1, width, stride, taps, ring, ring_row(1, row, stride))
    blur_along(b2, width, stride, taps, ring, ring_row(2, row, stride))


@formula
def clear_three(ring, row, stride):
    clear(ring, 0, row, stride)
    clear(ring, 1, row, stride)
    clear(ring, 2, row, stride)


@formula
def feed(v, x, y, top, row, shape, taps, b0, b1, b2, ring):
    """Stage one: row `row` of v, r v and (y - c) v of the channel that begins at `top`, blurred along itself, to the ring."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear_three(ring, row, stride)
        return
    at = top + row * stride
    for i in range(0, stride, lanes(v)):
        value, aim = load(v, at + i), load(y, at + i)
        store(b0, BORDER + i, value)
        store(b1, BORDER + i, value * (load(x, at + i) - aim))
        store(b2, BORDER + i, value * (aim - CENTRE))
    blur_three(b0, b1, b2, width, stride, taps, ring, row)


@formula
def feed_residual(x, y, top, row, shape, taps, b0, b1, b2, ring):
    """Stage one for v = r."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear_three(ring, row, stride)
        return
    at = top + row * stride
    for i in range(0, stride, lanes(x)):
        aim = load(y, at + i)
        residual = load(x, at + i) - aim
        store(b0, BORDER + i, residual)
        store(b1, BORDER + i, residual * residual)
        store(b2, BORDER + i, residual * (aim - CENTRE))
    blur_three(b0, b1, b2, width, stride, taps, ring, row)


@formula
def similarity_at(ring, row, i, at, size, stride, taps, target):
    """`similarity` at a row and column, from the ring of the residual's stage one."""
    m, p = blur_down(ring, 0, row, i, stride, taps), blur_down(ring, 1, row, i, stride, taps)
    q = blur_down(ring, 2, row, i, stride, taps)
    return similarity(m, p, q, load(target, at), load(target, size + at))


@kernel
def value_rows(start, stop, shape, taps, x, y, target, kind, eps, structural, pixels, distances):
    """Sums over each row of the pixel loss and, unless structural = 0, of 1 - S.  target: mu and var (2 plane sets)."""
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    b0, b1, b2 = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    ring, values = ring_buffer(x, 3, stride), row_buffer(x, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for row in range(first, last):
            at = top + row * stride
            for i in range(0, stride, L):
                store(values, BORDER + i, pixel_slope(load(x, at + i) - load(y, at + i), kind, eps)[0])
            pixels[channel * height + row] = row_sum(values, width)
        if structural == 0:
            continue
        for ahead in range(first - REACH, last + REACH):
            feed_residual(x, y, top, ahead, shape, taps, b0, b1, b2, ring)
            row = ahead - REACH
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, L):
                found = similarity_at(ring, row, i, at + i, size, stride, taps, target)
                store(values, BORDER + i, slopes_of(found)[0])
            distances[channel * height + row] = row_sum(values, width)


@formula
def differentiate_row(ring, row, at, size, shape, taps, target, b0, b1, b2, values, slopes):
    """Stage two of the gradient: S_m, S_p, S_q of a row, blurred along it; the sum of 1 - S."""
    _height, width, _plane_rows, stride = shape
    for i in range(0, stride, lanes(ring)):
        distance, sm, sp, sq = slopes_of(similarity_at(ring, row, i, at + i, size, stride, taps, target))
        store(values, BORDER + i, distance)
        store(b0, BORDER + i, sm)
        store(b1, BORDER + i, sp)
        store(b2, BORDER + i, sq)
    blur_three(b0, b1, b2, width, stride, taps, slopes, row)
    return row_sum(values, width)


@kernel
def gradient_rows(
    start, stop, shape, taps, x, y, target, kind, eps, pixel, structural, gradient, pixels, distances
):  # fmt: skip
    """The gradient of the loss; sums over each row of the pixel loss and of 1 - S (unless structural = 0).

    pixel, structural: weights of the two losses over the number of values.  target: mu and var (2 plane sets).
    """
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    b0, b1, b2 = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    ring, slopes, values = ring_buffer(x, 3, stride), ring_buffer(x, 3, stride), row_buffer(x, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        lead = 2 * REACH if structural != 0 else 0
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_residual(x, y, top, ahead, shape, taps, b0, b1, b2, ring)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        at = top + row * stride
                        total = differentiate_row(ring, row, at, size, shape, taps, target, b0, b1, b2, values, slopes)
                        if first <= row < last:
                            distances[channel * height + row] = total
                    else:
                        clear_three(slopes, row, stride)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, L):
                residual = load(x, at + i) - load(y, at + i)
                value, slope = pixel_slope(residual, kind, eps)
                slope = slope * pixel
                store(values, BORDER + i, value)
                if structural != 0:
                    bm, bp = blur_down(slopes, 0, row, i, stride, taps), blur_down(slopes, 1, row, i, stride, taps)
                    bq = blur_down(slopes, 2, row, i, stride, taps)
                    slope -= structural * spread(residual, load(y, at + i) - CENTRE, bm, bp, bq)
                store(gradient, at + i, slope)
            pixels[channel * height + row] = row_sum(values, width)
            for i in range(width, stride):
                gradient[at + i] = 0


@formula
def curve_row(own, ring, row, at, size, shape, taps, target, b0, b1, b2, b3, slopes):
    """Stage two of the product: S_m', S_p', S_q' of a row and its S_p, blurred along it.  own: the residual's stage one."""
    _height, width, _plane_rows, stride = shape
    for i in range(0, stride, lanes(ring)):
        found = similarity_at(own, row, i, at + i, size, stride, taps, target)
        dm, dp = blur_down(ring, 0, row, i, stride, taps), 2.0 * blur_down(ring, 1, row, i, stride, taps)
        dq = blur_down(ring, 2, row, i, stride, taps)
        sm, sp, sq = bent(seconds_of(found), dm, dp, dq)
        store(b0, BORDER + i, sm)
        store(b1, BORDER + i, sp)
        store(b2, BORDER + i, sq)
        store(b3, BORDER + i, slopes_of(found)[2])
    blur_three(b0, b1, b2, width, stride, taps, slopes, row)
    blur_along(b3, width, stride, taps, slopes, ring_row(3, row, stride))


@kernel
def product_rows(start, stop, shape, taps, v, x, y, target, kind, eps, pixel, structural, product):
    """The Hessian of the loss times v.  product must not be v: another range may still read it."""
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    b0, b1, b2, b3 = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    own, ring, slopes = ring_buffer(x, 3, stride), ring_buffer(x, 3, stride), ring_buffer(x, 4, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        lead = 2 * REACH if structural != 0 else 0
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_residual(x, y, top, ahead, shape, taps, b0, b1, b2, own)
                feed(v, x, y, top, ahead, shape, taps, b0, b1, b2, ring)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        at = top + row * stride
                        curve_row(own, ring, row, at, size, shape, taps, target, b0, b1, b2, b3, slopes)
                    else:
                        clear_three(slopes, row, stride)
                        clear(slopes, 3, row, stride)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, L):
                aim, tangent = load(y, at + i), load(v, at + i)
                residual = load(x, at + i) - aim
                total = pixel_curvature(residual, kind, eps, broadcast(x, pixel)) * tangent
                if structural != 0:
                    bm, bp = blur_down(slopes, 0, row, i, stride, taps), blur_down(slopes, 1, row, i, stride, taps)
                    bq, sp = blur_down(slopes, 2, row, i, stride, taps), blur_down(slopes, 3, row, i, stride, taps)
                    total -= structural * (spread(residual, aim - CENTRE, bm, bp, bq) + 2.0 * tangent * sp)
                store(product, at + i, total)
            for i in range(width, stride):
                product[at + i] = 0


@formula
def seconds_row(own, row, at, size, shape, taps, squares, target, buffers, bends, slopes):
    """The SECONDS second derivatives of a row, blurred along it by the window squared, and S_p by the window.

    buffers: SECONDS + 1 rows.
    """
    _height, width, _plane_rows, stride = shape
    for i in range(0, stride, lanes(own)):
        found = similarity_at(own, row, i, at + i, size, stride, taps, target)
        mm, mp, mq, pp, pq, qq = seconds_of(found)
        store(buffers[0], BORDER + i, mm)
        store(buffers[1], BORDER + i, mp)
        store(buffers[2], BORDER + i, mq)
        store(buffers[3], BORDER + i, pp)
        store(buffers[4], BORDER + i, pq)
        store(buffers[5], BORDER + i, qq)
        store(buffers[6], BORDER + i, slopes_of(found)[2])
    for f in range(SECONDS):
        blur_along(buffers[f], width, stride, squares, bends, ring_row(f, row, stride))
    blur_along(buffers[6], width, stride, taps, slopes, ring_row(0, row, stride))


@kernel
def diagonal_rows(start, stop, shape, taps, squares, x, y, target, kind, eps, pixel, structural, diagonal):
    """The diagonal of the loss's Hessian.  squares: the window squared."""
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    buffers = (
        row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride),
        row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride),
    )  # fmt: skip
    own, bends, slopes = ring_buffer(x, 3, stride), ring_buffer(x, SECONDS, stride), ring_buffer(x, 1, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        lead = 2 * REACH if structural != 0 else 0
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_residual(x, y, top, ahead, shape, taps, buffers[0], buffers[1], buffers[2], own)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        at = top + row * stride
                        seconds_row(own, row, at, size, shape, taps, squares, target, buffers, bends, slopes)
                    else:
                        for f in range(SECONDS):
                            clear(bends, f, row, stride)
                        clear(slopes, 0, row, stride)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, L):
                residual, aim = load(x, at + i) - load(y, at + i), load(y, at + i) - CENTRE
                total = pixel_curvature(residual, kind, eps, broadcast(x, pixel))
                if structural != 0:
                    mm, mp = blur_down(bends, 0, row, i, stride, squares), blur_down(bends, 1, row, i, stride, squares)
                    mq, pp = blur_down(bends, 2, row, i, stride, squares), blur_down(bends, 3, row, i, stride, squares)
                    pq, qq = blur_down(bends, 4, row, i, stride, squares), blur_down(bends, 5, row, i, stride, squares)
                    second, sp = (mm, mp, mq, pp, pq, qq), blur_down(slopes, 0, row, i, stride, taps)
                    total -= structural * own_bend(second, sp, residual, aim)
                store(diagonal, at + i, total)
            for i in range(width, stride):
                diagonal[at + i] = 0
