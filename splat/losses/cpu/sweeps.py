"""The sweeps of the losses: value, gradient, Hessian-vector product, quadratic form and diagonal, each in one pass down the
rows.

A sweep (`window_kernels.py`) has up to three stages, each REACH rows behind the one before: products blurred along the row;
partial derivatives at a row (`losses_formulas.py`), blurred along it; the result at a row.  So nothing of the size of an image
is written but the result, and what is held for tangents is blur(S_p) and the two images: m, p and q are blurred again beside
it, where six plane sets of S's second derivatives would be held, once for all vectors of a sweep.

A quadratic form has no third stage, as the window is its own adjoint: for five vectors it takes two fifths of the time of as
many products one by one, and products together two thirds (504 x 378, vectors of 256 bits).
"""

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import broadcast, lanes, load, store
from splat.losses.cpu.window import (
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
from splat.losses.formulas import (
    CENTRE,
    SECONDS,
    pixel_curvature,
    pixel_slope,
    seconds_of,
    similarity,
    slopes_of,
    ssim_adjoint,
    ssim_diag_hessian,
    ssim_quadratic_form,
    ssim_second_dot,
)

PRODUCT_FIELDS = 6  # of rows that a sweep of products keeps for a vector


@formula
def blur_three(b0, b1, b2, width, stride, taps, ring, field, row):
    blur_along(b0, width, stride, taps, ring, ring_row(field, row, stride))
    blur_along(b1, width, stride, taps, ring, ring_row(field + 1, row, stride))
    blur_along(b2, width, stride, taps, ring, ring_row(field + 2, row, stride))


@formula
def clear_three(ring, field, row, stride):
    clear(ring, field, row, stride)
    clear(ring, field + 1, row, stride)
    clear(ring, field + 2, row, stride)


@formula
def down_three(ring, field, row, i, stride, taps):
    one, two = blur_down(ring, field, row, i, stride, taps), blur_down(ring, field + 1, row, i, stride, taps)
    return one, two, blur_down(ring, field + 2, row, i, stride, taps)


@formula
def feed(V, vector, x, y, top, row, shape, taps, b0, b1, b2, ring, field):
    """Stage one: row `row` of v, r v and (y - c) v of the channel that begins at `top`, blurred along itself, to three fields
    of the ring.  vector: where v begins in V."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear_three(ring, field, row, stride)
        return
    at = top + row * stride
    for i in range(0, stride, lanes(V)):
        value, aim = load(V, vector + at + i), load(y, at + i)
        store(b0, BORDER + i, value)
        store(b1, BORDER + i, value * (load(x, at + i) - aim))
        store(b2, BORDER + i, value * (aim - CENTRE))
    blur_three(b0, b1, b2, width, stride, taps, ring, field, row)


@formula
def feed_residual(x, y, top, row, shape, taps, b0, b1, b2, ring):
    """Stage one for v = r."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear_three(ring, 0, row, stride)
        return
    at = top + row * stride
    for i in range(0, stride, lanes(x)):
        aim = load(y, at + i)
        residual = load(x, at + i) - aim
        store(b0, BORDER + i, residual)
        store(b1, BORDER + i, residual * residual)
        store(b2, BORDER + i, residual * (aim - CENTRE))
    blur_three(b0, b1, b2, width, stride, taps, ring, 0, row)


@formula
def feed_all(V, K, x, y, top, row, shape, taps, b0, b1, b2, own, ring):
    """Stage one for the residual and for all K vectors of V."""
    feed_residual(x, y, top, row, shape, taps, b0, b1, b2, own)
    for k in range(K):
        feed(V, k * (V.size // K), x, y, top, row, shape, taps, b0, b1, b2, ring, 3 * k)


@formula
def similarity_at(ring, row, i, at, size, stride, taps, target):
    """`similarity` at a row and column, from the ring of the residual's stage one."""
    m, p, q = down_three(ring, 0, row, i, stride, taps)
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
    blur_three(b0, b1, b2, width, stride, taps, slopes, 0, row)
    return row_sum(values, width)


@kernel
def gradient_rows(
    start, stop, shape, taps, x, y, target, kind, eps, pixel, structural, gradient, blurred_sp, pixels, distances
):  # fmt: skip
    """The gradient of the loss; sums over each row of the pixel loss and of 1 - S (unless structural = 0).

    pixel, structural: weights of the two losses over the number of values.  target: mu and var (2 plane sets).  blurred_sp:
    where blur(S_p) goes, or empty.
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
                        clear_three(slopes, 0, row, stride)
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
                    bm, bp, bq = down_three(slopes, 0, row, i, stride, taps)
                    slope -= structural * ssim_adjoint(residual, load(y, at + i) - CENTRE, bm, bp, bq)
                    if blurred_sp.size > 0:
                        store(blurred_sp, at + i, bp)
                store(gradient, at + i, slope)
            pixels[channel * height + row] = row_sum(values, width)
            for i in range(width, stride):
                gradient[at + i] = 0


@formula
def seconds_row(own, row, at, size, stride, taps, target, buffers):
    """The SECONDS second derivatives of a row, to as many buffers."""
    for i in range(0, stride, lanes(own)):
        found = similarity_at(own, row, i, at + i, size, stride, taps, target)
        mm, mp, mq, pp, pq, qq = seconds_of(found)
        store(buffers[0], BORDER + i, mm)
        store(buffers[1], BORDER + i, mp)
        store(buffers[2], BORDER + i, mq)
        store(buffers[3], BORDER + i, pp)
        store(buffers[4], BORDER + i, pq)
        store(buffers[5], BORDER + i, qq)


@formula
def six_buffers(x, stride):
    one, two, three = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    return one, two, three, row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)


@formula
def load_six(buffers, at):
    one, two, three = load(buffers[0], at), load(buffers[1], at), load(buffers[2], at)
    return one, two, three, load(buffers[3], at), load(buffers[4], at), load(buffers[5], at)


@formula
def curve_row(second, ring, field, row, shape, taps, b0, b1, b2, slopes):
    """Stage two of the product: S_m', S_p', S_q' of a row, blurred along it, to three fields of slopes.  second: buffers."""
    _height, width, _plane_rows, stride = shape
    for i in range(0, stride, lanes(ring)):
        dm, dp, dq = down_three(ring, field, row, i, stride, taps)
        sm, sp, sq = ssim_second_dot(load_six(second, BORDER + i), dm, 2.0 * dp, dq)
        store(b0, BORDER + i, sm)
        store(b1, BORDER + i, sp)
        store(b2, BORDER + i, sq)
    blur_three(b0, b1, b2, width, stride, taps, slopes, field, row)


@kernel
def product_rows(start, stop, shape, taps, V, x, y, target, blurred_sp, kind, eps, pixel, structural, products):
    """The Hessian of the loss times every v in V.  products must not be V: another range may still read it."""
    height, width, plane_rows, stride = shape
    L, size, K = lanes(x), 3 * plane_rows * stride, len(products)
    each, second = V.size // K, six_buffers(x, stride)
    b0, b1, b2 = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    own, ring, slopes = ring_buffer(x, 3, stride), ring_buffer(x, 3 * K, stride), ring_buffer(x, 3 * K, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        lead = 2 * REACH if structural != 0 else 0
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_all(V, K, x, y, top, ahead, shape, taps, b0, b1, b2, own, ring)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        seconds_row(own, row, top + row * stride, size, stride, taps, target, second)
                        for k in range(K):
                            curve_row(second, ring, 3 * k, row, shape, taps, b0, b1, b2, slopes)
                    else:
                        for k in range(K):
                            clear_three(slopes, 3 * k, row, stride)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for k in range(K):
                product = products[k]
                for i in range(0, stride, L):
                    aim, tangent = load(y, at + i), load(V, k * each + at + i)
                    residual = load(x, at + i) - aim
                    total = pixel_curvature(residual, kind, eps, broadcast(x, pixel)) * tangent
                    if structural != 0:
                        bm, bp, bq = down_three(slopes, 3 * k, row, i, stride, taps)
                        turned = 2.0 * tangent * load(blurred_sp, at + i)
                        total -= structural * (ssim_adjoint(residual, aim - CENTRE, bm, bp, bq) + turned)
                    store(product, at + i, total)
                for i in range(width, stride):
                    product[at + i] = 0


@kernel
def form_rows(
    start, stop, shape, taps, V, x, y, target, blurred_sp, kind, eps, pixel, structural, diagonal, full, pixelwise
):  # fmt: skip
    """v . l'' v and v . D v of every v in V, D the diagonal of l'', summed over each row: (k, 3 height) each."""
    height, width, plane_rows, stride = shape
    L, size, K = lanes(x), 3 * plane_rows * stride, len(full)
    each, second = V.size // K, six_buffers(x, stride)
    b0, b1, b2 = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    own, ring = ring_buffer(x, 3, stride), ring_buffer(x, 3 * K, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        lead = REACH if structural != 0 else 0
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_all(V, K, x, y, top, ahead, shape, taps, b0, b1, b2, own, ring)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            if structural != 0:
                seconds_row(own, row, at, size, stride, taps, target, second)
            for k in range(K):
                for i in range(0, stride, L):
                    squared = load(V, k * each + at + i) * load(V, k * each + at + i)
                    residual = load(x, at + i) - load(y, at + i)
                    total = pixel_curvature(residual, kind, eps, broadcast(x, pixel)) * squared
                    if structural != 0:
                        dm, dp, dq = down_three(ring, 3 * k, row, i, stride, taps)
                        bends = load_six(second, BORDER + i)
                        total -= structural * ssim_quadratic_form(
                            bends, dm, 2.0 * dp, dq, squared, load(blurred_sp, at + i)
                        )
                    store(b0, BORDER + i, total)
                    store(b1, BORDER + i, load(diagonal, at + i) * squared)
                full[k, channel * height + row] = row_sum(b0, width)
                pixelwise[k, channel * height + row] = row_sum(b1, width)


@kernel
def diagonal_rows(start, stop, shape, taps, squares, x, y, target, blurred_sp, kind, eps, pixel, structural, diagonal):
    """The diagonal of the loss's Hessian.  squares: the window squared."""
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    b0, b1, b2 = row_buffer(x, stride), row_buffer(x, stride), row_buffer(x, stride)
    buffers, own, bends = six_buffers(x, stride), ring_buffer(x, 3, stride), ring_buffer(x, SECONDS, stride)
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        lead = 2 * REACH if structural != 0 else 0
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_residual(x, y, top, ahead, shape, taps, b0, b1, b2, own)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        seconds_row(own, row, top + row * stride, size, stride, taps, target, buffers)
                        for f in range(SECONDS):
                            blur_along(buffers[f], width, stride, squares, bends, ring_row(f, row, stride))
                    else:
                        for f in range(SECONDS):
                            clear(bends, f, row, stride)
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
                    second = mm, mp, mq, pp, pq, qq
                    total -= structural * ssim_diag_hessian(second, load(blurred_sp, at + i), residual, aim)
                store(diagonal, at + i, total)
            for i in range(width, stride):
                diagonal[at + i] = 0
