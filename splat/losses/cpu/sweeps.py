"""The sweeps of the losses: value, gradient, Hessian-vector product, quadratic form and diagonal.

A sweep is one pass down the rows with up to three stages, each REACH rows behind the one before:

    feed            products of v, r and y at a row, blurred along it (`window.py`)
    differentiate   those blurred down, and from them partial derivatives at a row (`formulas.py`), blurred along it
    finish          those blurred down, and the result at a row

So the only arrays of the size of the image that a sweep writes are its results.  Products need blur(S_p), which the gradient's
sweep leaves, and the two images; S's second derivatives are worked out again, once for all vectors of a sweep.  A quadratic
form has no third stage, as the window is its own adjoint.  Two images that both depend on the parameters (a pair) take four
blurs in and four out, where a loss against each as the other's target takes sixteen.

The kernels' arguments: x, y image and target, or a pair; target: mu and var of y (2 plane sets); kind, eps, pixel, structural:
pixel loss, its parameter, and the weights of pixel loss and 1 - S over the number of values; if structural is 0, no SSIM.
"""

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import broadcast, lanes, load, store
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
from splat.losses.formulas import (
    CENTRE,
    SECONDS,
    pair_adjoint,
    pair_slopes,
    pixel_curvature,
    pixel_slope,
    ssim_adjoint,
    ssim_diag_hessian,
    ssim_quadratic_form,
    ssim_second_dot,
    ssim_seconds,
    ssim_slopes,
)

PRODUCT_FIELDS = 6  # rings of rows that a sweep of products keeps for a vector
PAIR_FIELDS = 4  # m, p, M, V; after differentiation what is blurred for the gradients in r (2) and in a (2)


@formula
def feed(V, begin, x, y, top, row, shape, taps, rows, ring, field):
    """Stage one: row `row` of v, r v and (y - c) v, blurred along itself, to three fields of the ring.

    v begins at V[begin], and is r where V is None.  top: where the channel begins.
    """
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear(ring, field, 3, row, stride)
        return
    at = top + row * stride
    for i in range(0, stride, lanes(x)):
        target = load(y, at + i)
        residual = load(x, at + i) - target
        if V is None:
            value = residual
        else:
            value = load(V, begin + at + i)
        put(rows, i, stride, (value, value * residual, value * (target - CENTRE)))
    blur_along(rows, 3, width, stride, taps, ring, field, row)


@formula
def feed_all(V, K, x, y, top, row, shape, taps, rows, own, ring):
    """Stage one for the residual and for all K vectors of V."""
    feed(None, 0, x, y, top, row, shape, taps, rows, own, 0)
    for k in range(K):
        feed(V, k * (V.size // K), x, y, top, row, shape, taps, rows, ring, 3 * k)


@formula
def window_at(own, row, i, at, plane, stride, taps, target):
    """m, p, q, mu and var at the lanes at i of a row; own: the ring of the residual's stage one; plane: size of a plane set."""
    m, p, q = blur_down_three(own, 0, row, i, stride, taps)
    return m, p, q, load(target, at + i), load(target, plane + at + i)


@formula
def differentiate(own, row, top, shape, taps, target, rows, values, slopes, gradient):
    """Stage two of the gradient, if any: S_m, S_p, S_q of a row, blurred along it, to `slopes`; the sum of 1 - S."""
    height, width, plane_rows, stride = shape
    if row < 0 or row >= height:
        if gradient is not None:
            clear(slopes, 0, 3, row, stride)
        return 0.0
    at, plane = top + row * stride, 3 * plane_rows * stride
    for i in range(0, stride, lanes(own)):
        m, p, q, mu, var = window_at(own, row, i, at, plane, stride, taps, target)
        distance, sm, sp, sq = ssim_slopes(m, p, q, mu, var)
        store(values, BORDER + i, distance)
        if gradient is not None:
            put(rows, i, stride, (sm, sp, sq))
    if gradient is not None:
        blur_along(rows, 3, width, stride, taps, slopes, 0, row)
    return row_sum(values, width)


@formula
def finish_gradient(x, y, at, row, shape, taps, slopes, kind, eps, pixel, structural, gradient, blurred_sp, values):
    """Stage three of the gradient, if any; the sum of the pixel loss over the row at `at`."""
    _height, width, _plane_rows, stride = shape
    for i in range(0, stride, lanes(x)):
        target = load(y, at + i)
        residual = load(x, at + i) - target
        value, slope = pixel_slope(residual, kind, eps)
        store(values, BORDER + i, value)
        if gradient is not None:
            slope = slope * pixel
            if structural != 0:
                bm, bp, bq = blur_down_three(slopes, 0, row, i, stride, taps)
                slope -= structural * ssim_adjoint(residual, target - CENTRE, bm, bp, bq)
                if blurred_sp.size > 0:
                    store(blurred_sp, at + i, bp)
            store(gradient, at + i, slope)
    if gradient is not None:
        for i in range(width, stride):
            gradient[at + i] = 0
    return row_sum(values, width)


@formula
def feed_pair(x, y, top, row, shape, taps, rows, ring):
    """Stage one of a pair: r, r^2 and the moments of a."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear(ring, 0, PAIR_FIELDS, row, stride)
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
    """Stage two of a pair: the fields of `pair_slopes`, blurred along the row; the sum of 1 - S."""
    height, width, _plane_rows, stride = shape
    if row < 0 or row >= height:
        clear(slopes, 0, PAIR_FIELDS, row, stride)
        return 0.0
    for i in range(0, stride, lanes(ring)):
        m, p = blur_down(ring, 0, row, i, stride, taps), blur_down(ring, 1, row, i, stride, taps)
        mean, variance = moments_down(ring, 2, row, i, stride, taps)
        distance, in_m, in_p, in_mean, in_variance = pair_slopes(m, p, mean, variance)
        store(values, BORDER + i, distance)
        put(rows, i, stride, (in_m, in_p, in_mean, in_variance))
    blur_along(rows, PAIR_FIELDS, width, stride, taps, slopes, 0, row)
    return row_sum(values, width)


@formula
def finish_pair(x, y, at, row, shape, taps, slopes, kind, eps, pixel, structural, in_x, in_y, values):
    """Stage three of a pair, if any; the sum of the pixel loss over the row at `at`."""
    _height, width, _plane_rows, stride = shape
    for i in range(0, stride, lanes(x)):
        one, other = load(x, at + i), load(y, at + i)
        value, slope = pixel_slope(one - other, kind, eps)
        store(values, BORDER + i, value)
        if in_x is not None:
            one_bar, other_bar = slope * pixel, -(slope * pixel)
            if structural != 0:
                bm, bp, ba = blur_down_three(slopes, 0, row, i, stride, taps)
                bv = blur_down(slopes, 3, row, i, stride, taps)
                one_bar, other_bar = pair_adjoint(one, other, slope * pixel, structural, bm, bp, ba, bv)
            store(in_x, at + i, one_bar)
            store(in_y, at + i, other_bar)
    return row_sum(values, width)


@kernel
def gradient_rows(
    start, stop, shape, taps, x, y, target, kind, eps, pixel, structural, gradient, other, pixels, distances
):  # fmt: skip
    """The gradient in x, unless None, of a loss against a target; or, where target is None, the gradients in both of a pair.

    other: where the gradient in y goes or, against a target, blur(S_p), unless empty.  pixels, distances: sums over each row
    of the pixel loss and of 1 - S.
    """
    height, _width, plane_rows, stride = shape
    rows, values = bordered_rows(x, PAIR_FIELDS, stride), bordered_rows(x, 1, stride)
    ring, slopes = ring_buffer(x, PAIR_FIELDS, stride), ring_buffer(x, PAIR_FIELDS, stride)
    reach = 0 if gradient is None else REACH  # rows beyond the range that are differentiated
    lead = reach + REACH if structural != 0 else 0
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                if target is None:
                    feed_pair(x, y, top, ahead, shape, taps, rows, ring)
                else:
                    feed(None, 0, x, y, top, ahead, shape, taps, rows, ring, 0)
                row = ahead - REACH
                if first - reach <= row < last + reach:
                    if target is None:
                        distance = differentiate_pair(ring, row, shape, taps, rows, values, slopes)
                    else:
                        distance = differentiate(ring, row, top, shape, taps, target, rows, values, slopes, gradient)
                    if first <= row < last:
                        distances[channel * height + row] = distance
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            if target is None:
                found = finish_pair(
                    x, y, at, row, shape, taps, slopes, kind, eps, pixel, structural, gradient, other, values
                )
            else:
                found = finish_gradient(
                    x, y, at, row, shape, taps, slopes, kind, eps, pixel, structural, gradient, other, values
                )
            pixels[channel * height + row] = found


@formula
def seconds_row(own, row, top, shape, taps, target, second):
    """S's second derivatives at a row of the image, to SECONDS bordered rows."""
    _height, _width, plane_rows, stride = shape
    at, plane = top + row * stride, 3 * plane_rows * stride
    for i in range(0, stride, lanes(own)):
        m, p, q, mu, var = window_at(own, row, i, at, plane, stride, taps, target)
        put(second, i, stride, ssim_seconds(m, p, q, mu, var))


@formula
def seconds_at(second, i, stride):
    """The second derivatives at the lanes at i."""
    at, pitch = BORDER + i, stride + 2 * BORDER
    mm, mp, mq = load(second, at), load(second, at + pitch), load(second, at + 2 * pitch)
    return mm, mp, mq, load(second, at + 3 * pitch), load(second, at + 4 * pitch), load(second, at + 5 * pitch)


@formula
def curve(second, ring, K, row, shape, taps, rows, slopes):
    """Stage two of the product: S_m', S_p', S_q' of all K vectors at a row of the image, blurred along it, to `slopes`."""
    _height, width, _plane_rows, stride = shape
    for k in range(K):
        for i in range(0, stride, lanes(ring)):
            dm, dp, dq = blur_down_three(ring, 3 * k, row, i, stride, taps)
            put(rows, i, stride, ssim_second_dot(seconds_at(second, i, stride), dm, 2.0 * dp, dq))
        blur_along(rows, 3, width, stride, taps, slopes, 3 * k, row)


@kernel
def product_rows(start, stop, shape, taps, V, x, y, target, blurred_sp, kind, eps, pixel, structural, products):
    """The Hessian of the loss times every v in V.  products must not be V: another range may still read it."""
    height, width, plane_rows, stride = shape
    K = len(products)
    each, rows, second = V.size // K, bordered_rows(x, 3, stride), bordered_rows(x, SECONDS, stride)
    own, ring, slopes = ring_buffer(x, 3, stride), ring_buffer(x, 3 * K, stride), ring_buffer(x, 3 * K, stride)
    lead = 2 * REACH if structural != 0 else 0
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_all(V, K, x, y, top, ahead, shape, taps, rows, own, ring)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        seconds_row(own, row, top, shape, taps, target, second)
                        curve(second, ring, K, row, shape, taps, rows, slopes)
                    else:
                        clear(slopes, 0, 3 * K, row, stride)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for k in range(K):
                product = products[k]
                for i in range(0, stride, lanes(x)):
                    aim, tangent = load(y, at + i), load(V, k * each + at + i)
                    residual = load(x, at + i) - aim
                    total = pixel_curvature(residual, kind, eps, broadcast(x, pixel)) * tangent
                    if structural != 0:
                        bm, bp, bq = blur_down_three(slopes, 3 * k, row, i, stride, taps)
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
    K = len(full)
    each, rows, second = V.size // K, bordered_rows(x, 3, stride), bordered_rows(x, SECONDS, stride)
    own, ring, values = ring_buffer(x, 3, stride), ring_buffer(x, 3 * K, stride), bordered_rows(x, 1, stride)
    lead = REACH if structural != 0 else 0
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed_all(V, K, x, y, top, ahead, shape, taps, rows, own, ring)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            if structural != 0:
                seconds_row(own, row, top, shape, taps, target, second)
            for k in range(K):
                for i in range(0, stride, lanes(x)):
                    squared = load(V, k * each + at + i) * load(V, k * each + at + i)
                    residual = load(x, at + i) - load(y, at + i)
                    total = pixel_curvature(residual, kind, eps, broadcast(x, pixel)) * squared
                    if structural != 0:
                        dm, dp, dq = blur_down_three(ring, 3 * k, row, i, stride, taps)
                        bends, bp = seconds_at(second, i, stride), load(blurred_sp, at + i)
                        total -= structural * ssim_quadratic_form(bends, dm, 2.0 * dp, dq, squared, bp)
                    store(rows, BORDER + i, total)
                    store(values, BORDER + i, load(diagonal, at + i) * squared)
                full[k, channel * height + row] = row_sum(rows, width)
                pixelwise[k, channel * height + row] = row_sum(values, width)


@kernel
def diagonal_rows(start, stop, shape, taps, squares, x, y, target, blurred_sp, kind, eps, pixel, structural, diagonal):
    """The diagonal of the loss's Hessian.  squares: the window squared."""
    height, width, plane_rows, stride = shape
    rows, second = bordered_rows(x, 3, stride), bordered_rows(x, SECONDS, stride)
    own, bends = ring_buffer(x, 3, stride), ring_buffer(x, SECONDS, stride)
    lead = 2 * REACH if structural != 0 else 0
    for channel in range(3):
        first, last = channel_part(start, stop, channel, height)
        if first >= last:
            continue
        top = channel * plane_rows * stride
        for ahead in range(first - lead, last + lead):
            if structural != 0:
                feed(None, 0, x, y, top, ahead, shape, taps, rows, own, 0)
                row = ahead - REACH
                if first - REACH <= row < last + REACH:
                    if 0 <= row < height:
                        seconds_row(own, row, top, shape, taps, target, second)
                        blur_along(second, SECONDS, width, stride, squares, bends, 0, row)
                    else:
                        clear(bends, 0, SECONDS, row, stride)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * stride
            for i in range(0, stride, lanes(x)):
                residual, aim = load(x, at + i) - load(y, at + i), load(y, at + i) - CENTRE
                total = pixel_curvature(residual, kind, eps, broadcast(x, pixel))
                if structural != 0:
                    mm, mp, mq = blur_down_three(bends, 0, row, i, stride, squares)
                    pp, pq, qq = blur_down_three(bends, 3, row, i, stride, squares)
                    own_second = (mm, mp, mq, pp, pq, qq)
                    total -= structural * ssim_diag_hessian(own_second, load(blurred_sp, at + i), residual, aim)
                store(diagonal, at + i, total)
            for i in range(width, stride):
                diagonal[at + i] = 0
