"""The sweeps of the losses: value, gradient, Hessian-vector product, quadratic form and diagonal.

A sweep is one pass down the rows with up to three stages, each REACH rows behind the one before:

    feed            products of v, r and y at a row, blurred along it (`window.py`)
    differentiate   those blurred down, and from them partial derivatives at a row (`formulas.py`), blurred along it
    finish          those blurred down, and the result at a row

So the only arrays of the size of the image that a sweep writes are its results.  Products need the two images, and what the
gradient's sweep leaves: blur(S_p) and S's second derivatives.  A quadratic form has no third stage, as the window is its own
adjoint.  Two images that both depend on the parameters (a pair) take four blurs in and four out, where a loss against each as
the other's target takes sixteen.

The kernels' arguments: x, y image and target, or a pair; target: mu and var of y (2 plane sets); loss: see `Loss`; seconds:
S's second derivatives at every window's centre (SECONDS plane sets), 0 where no window counts and in the padding.
"""

from typing import NamedTuple

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import broadcast, lanes, load, store
from splat.losses.cpu.window import (
    BORDER,
    REACH,
    blur_along,
    blur_down,
    blur_down_three,
    bordered_rows,
    clear,
    clear_padding,
    counts,
    leave_margin,
    moments_along,
    moments_down,
    part_of,
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
    ssim_uniform,
)

PRODUCT_FIELDS = 6  # rings of rows that a sweep of products keeps for a vector
PAIR_FIELDS = 4  # m, p, M, V; after differentiation what is blurred for the gradients in r (2) and in a (2)


class Loss(NamedTuple):
    """The pixel loss and its eps, and the weights of it and of 1 - S over the number of values; no SSIM if structural is 0.

    margin: pixels at every side round which no window counts.
    """

    kind: int
    eps: float
    pixel: float
    structural: float
    margin: int


@formula
def feed(v, less, x, y, top, row, frame, rows, ring, field):
    """Stage one: row `row` of v, r v and (y - c) v, blurred along itself, to three fields of the ring.

    v: a flat plane set, taken less a number, or r if None.  top: where the channel begins.
    """
    if row < 0 or row >= frame.height:
        clear(ring, field, 3, row, frame)
        return
    at = top + row * frame.stride
    for i in range(0, frame.stride, lanes(x)):
        target = load(y, at + i)
        residual = load(x, at + i) - target
        if v is None:
            value = residual
        else:
            value = load(v, at + i) - less
        put(rows, i, frame, (value, value * residual, value * (target - CENTRE)))
    blur_along(rows, 3, frame, ring, field, row)


@formula
def window_at(own, row, i, at, frame, target):
    """m, p, q, mu and var at the lanes at i of a row; own: the ring of the residual's stage one."""
    m, p, q = blur_down_three(own, 0, row, i, frame)
    return m, p, q, load(target, at + i), load(target, 3 * frame.plane_rows * frame.stride + at + i)


@formula
def differentiate(own, row, top, frame, margin, target, rows, values, slopes, gradient, seconds, keep):
    """Stage two of the gradient, if any: S_m, S_p, S_q of a row, blurred along it, to `slopes`; the sum of 1 - S.

    keep: whether to write the row of `seconds`, over all its columns: those where no window counts are cleared afterwards.
    """
    at, size = top + row * frame.stride, 3 * frame.plane_rows * frame.stride
    if not counts(row, margin, frame):
        clear(slopes, 0, 3, row, frame)
        return 0.0
    for i in range(0, frame.stride, lanes(own)):
        m, p, q, mu, var = window_at(own, row, i, at, frame, target)
        distance, sm, sp, sq = ssim_slopes(m, p, q, mu, var)
        store(values, BORDER + i, distance)
        if gradient is not None:
            put(rows, i, frame, (sm, sp, sq))
            if keep:
                found = ssim_seconds(m, p, q, mu, var)
                for j in range(SECONDS):
                    store(seconds, j * size + at + i, found[j])
    leave_margin(values, 1, margin, frame)
    if gradient is not None:
        leave_margin(rows, 3, margin, frame)
        blur_along(rows, 3, frame, slopes, 0, row)
    return row_sum(values, frame.width)


@formula
def finish_gradient(x, y, at, row, frame, slopes, loss, gradient, blurred_sp, values):
    """Stage three of the gradient, if any; the sum of the pixel loss over the row at `at`."""
    for i in range(0, frame.stride, lanes(x)):
        target = load(y, at + i)
        residual = load(x, at + i) - target
        value, slope = pixel_slope(residual, loss.kind, loss.eps)
        store(values, BORDER + i, value)
        if gradient is not None:
            slope = slope * loss.pixel
            if loss.structural != 0:
                bm, bp, bq = blur_down_three(slopes, 0, row, i, frame)
                slope -= loss.structural * ssim_adjoint(residual, target - CENTRE, bm, bp, bq)
                if blurred_sp.size > 0:
                    store(blurred_sp, at + i, bp)
            store(gradient, at + i, slope)
    if gradient is not None:
        clear_padding(gradient, at, frame)
    return row_sum(values, frame.width)


@formula
def feed_pair(x, y, top, row, frame, rows, ring):
    """Stage one of a pair: r, r^2 and the moments of a."""
    if row < 0 or row >= frame.height:
        clear(ring, 0, PAIR_FIELDS, row, frame)
        return
    at = top + row * frame.stride
    for i in range(0, frame.stride, lanes(x)):
        one, other = load(x, at + i), load(y, at + i)
        r = one - other
        put(rows, i, frame, (r, r * r, 0.5 * (one + other)))
    blur_along(rows, 2, frame, ring, 0, row)
    moments_along(rows, 2, frame, ring, 2, row)


@formula
def differentiate_pair(ring, row, frame, margin, rows, values, slopes):
    """Stage two of a pair: the fields of `pair_slopes`, blurred along the row; the sum of 1 - S."""
    if not counts(row, margin, frame):
        clear(slopes, 0, PAIR_FIELDS, row, frame)
        return 0.0
    for i in range(0, frame.stride, lanes(ring)):
        m, p = blur_down(ring, 0, row, i, frame), blur_down(ring, 1, row, i, frame)
        mean, variance = moments_down(ring, 2, row, i, frame)
        distance, in_m, in_p, in_mean, in_variance = pair_slopes(m, p, mean, variance)
        store(values, BORDER + i, distance)
        put(rows, i, frame, (in_m, in_p, in_mean, in_variance))
    leave_margin(values, 1, margin, frame)
    leave_margin(rows, PAIR_FIELDS, margin, frame)
    blur_along(rows, PAIR_FIELDS, frame, slopes, 0, row)
    return row_sum(values, frame.width)


@formula
def finish_pair(x, y, at, row, frame, slopes, loss, in_x, in_y, values):
    """Stage three of a pair, if any; the sum of the pixel loss over the row at `at`."""
    for i in range(0, frame.stride, lanes(x)):
        one, other = load(x, at + i), load(y, at + i)
        value, slope = pixel_slope(one - other, loss.kind, loss.eps)
        store(values, BORDER + i, value)
        if in_x is not None:
            slope = slope * loss.pixel
            one_bar, other_bar = slope, -slope
            if loss.structural != 0:
                bm, bp, ba = blur_down_three(slopes, 0, row, i, frame)
                bv = blur_down(slopes, 3, row, i, frame)
                one_bar, other_bar = pair_adjoint(one, other, slope, loss.structural, bm, bp, ba, bv)
            store(in_x, at + i, one_bar)
            store(in_y, at + i, other_bar)
    if in_x is not None:
        clear_padding(in_x, at, frame)
        clear_padding(in_y, at, frame)
    return row_sum(values, frame.width)


@kernel
def gradient_rows(start, stop, frame, loss, x, y, target, gradient, other, seconds, pixels, distances):
    """The gradient in x, unless None, of a loss against a target; or, where target is None, the gradients in both of a pair.

    other: where the gradient in y goes or, against a target, blur(S_p), unless empty, as `seconds` may be.  pixels, distances:
    sums over each row of the pixel loss and of 1 - S.
    """
    rows, values = bordered_rows(x, PAIR_FIELDS, frame), bordered_rows(x, 1, frame)
    ring, slopes = ring_buffer(x, PAIR_FIELDS, frame), ring_buffer(x, PAIR_FIELDS, frame)
    reach = 0 if gradient is None else REACH  # rows beyond the range that are differentiated
    lead = reach + REACH if loss.structural != 0 else 0
    for channel in range(3):
        top, first, last, rows_ahead = part_of(start, stop, channel, lead, frame)
        for ahead in rows_ahead:
            # stage one: the row that comes in, blurred along itself
            if loss.structural != 0:
                if target is None:
                    feed_pair(x, y, top, ahead, frame, rows, ring)
                else:
                    feed(None, 0, x, y, top, ahead, frame, rows, ring, 0)
                row = ahead - REACH
                # stage two, REACH rows later: the window is whole; S and its slopes, blurred along the row
                if first - reach <= row < last + reach:
                    if target is None:
                        distance = differentiate_pair(ring, row, frame, loss.margin, rows, values, slopes)
                    else:
                        keep = seconds.size > 0 and first <= row < last
                        distance = differentiate(
                            ring, row, top, frame, loss.margin, target, rows, values, slopes, gradient, seconds, keep
                        )
                    if first <= row < last:
                        distances[channel * frame.height + row] = distance
            row = ahead - lead
            if row < first:
                continue
            # stage three, REACH rows later again: blurred down the columns, with the pixel loss
            at = top + row * frame.stride
            if target is None:
                total = finish_pair(x, y, at, row, frame, slopes, loss, gradient, other, values)
            else:
                total = finish_gradient(x, y, at, row, frame, slopes, loss, gradient, other, values)
            pixels[channel * frame.height + row] = total


@formula
def seconds_at(seconds, at, frame):
    """The second derivatives at the lanes at `at` of a plane set."""
    size = 3 * frame.plane_rows * frame.stride
    mm, mp, mq = load(seconds, at), load(seconds, at + size), load(seconds, at + 2 * size)
    return mm, mp, mq, load(seconds, at + 3 * size), load(seconds, at + 4 * size)


@formula
def curve(seconds, at, ring, field, row, frame, rows, slopes):
    """Stage two of a vector's product: S_m', S_p', S_q' at a row of the image, blurred along it, to three of `slopes`."""
    for i in range(0, frame.stride, lanes(ring)):
        dm, dp, dq = blur_down_three(ring, field, row, i, frame)
        put(rows, i, frame, ssim_second_dot(seconds_at(seconds, at + i, frame), dm, 2.0 * dp, dq))
    blur_along(rows, 3, frame, slopes, field, row)


@formula
def finish_product(v, mean, x, y, at, row, field, frame, slopes, loss, blurred_sp, uniform, product):
    """Stage three of a vector's product."""
    for i in range(0, frame.stride, lanes(x)):
        aim, tangent = load(y, at + i), load(v, at + i) - mean
        residual = load(x, at + i) - aim
        total = pixel_curvature(residual, loss.kind, loss.eps, broadcast(x, loss.pixel)) * tangent
        if loss.structural != 0:
            bm, bp, bq = blur_down_three(slopes, field, row, i, frame)
            turned = 2.0 * tangent * load(blurred_sp, at + i)
            total -= loss.structural * (ssim_adjoint(residual, aim - CENTRE, bm, bp, bq) + turned)
            total += mean * load(uniform, at + i)
        store(product, at + i, total)
    clear_padding(product, at, frame)


@formula
def finish_forms(v, x, y, at, row, field, frame, ring, seconds, loss, blurred_sp, diagonal, values, rows):
    """A row's sums of v . l'' v and v . D v."""
    for i in range(0, frame.stride, lanes(x)):
        squared = load(v, at + i) * load(v, at + i)
        residual = load(x, at + i) - load(y, at + i)
        total = pixel_curvature(residual, loss.kind, loss.eps, broadcast(x, loss.pixel)) * squared
        if loss.structural != 0:
            dm, dp, dq = blur_down_three(ring, field, row, i, frame)
            bends, bp = seconds_at(seconds, at + i, frame), load(blurred_sp, at + i)
            total -= loss.structural * ssim_quadratic_form(bends, dm, 2.0 * dp, dq, squared, bp)
        store(values, BORDER + i, total)
        store(rows, BORDER + i, load(diagonal, at + i) * squared)
    return row_sum(values, frame.width), row_sum(rows, frame.width)


@kernel
def product_rows(start, stop, frame, loss, x, y, blurred_sp, seconds, V, means, uniform, products, diagonal, forms):
    """Multiply every v in V (k, plane sets) by l'', the Hessian of the loss; products and forms may be None.

    means: of v, (k, 3), or any other numbers; 0 for forms.  uniform: l'' times an image of ones, a plane set, with SSIM.
    products: l'' v, (k, plane sets); not V itself, which another range may still read.  forms: sums over each row of v . l'' v
    and of v . D v, D the diagonal of l'', (2, k, 3 height).
    """
    K, rows, values = len(V), bordered_rows(x, 3, frame), bordered_rows(x, 1, frame)
    ring, slopes = ring_buffer(x, 3 * K, frame), ring_buffer(x, 3 * K, frame)
    reach = 0 if products is None else REACH  # rows beyond the range that are differentiated
    lead = reach + REACH if loss.structural != 0 else 0
    for channel in range(3):
        top, first, last, rows_ahead = part_of(start, stop, channel, lead, frame)
        for ahead in rows_ahead:
            row = ahead - REACH
            if loss.structural != 0:
                # stages one and two of every vector: its fields blurred, then S_m', S_p', S_q'
                inside = first - reach <= row < last + reach and 0 <= row < frame.height
                for k in range(K):
                    feed(V[k], means[k, channel], x, y, top, ahead, frame, rows, ring, 3 * k)
                    if products is not None and inside:
                        curve(seconds, top + row * frame.stride, ring, 3 * k, row, frame, rows, slopes)
                    elif products is not None:
                        clear(slopes, 3 * k, 3, row, frame)
            row = ahead - lead
            if row < first:
                continue
            # stage three: l'' v, or the sums of v . l'' v
            at = top + row * frame.stride
            for k in range(K):
                if products is not None:
                    finish_product(
                        V[k], means[k, channel], x, y, at, row, 3 * k, frame, slopes, loss, blurred_sp, uniform, products[k]
                    )  # fmt: skip
                if forms is not None:
                    place = channel * frame.height + row
                    forms[0, k, place], forms[1, k, place] = finish_forms(
                        V[k], x, y, at, row, 3 * k, frame, ring, seconds, loss, blurred_sp, diagonal, values, rows
                    )


@kernel
def uniform_rows(start, stop, frame, loss, x, y, target, columns, lines, uniform):
    """The Hessian of a loss with SSIM times an image of ones.

    columns, lines: the weights of the window beyond the image's left and right edges, (stride,), and beyond the others.
    """
    rows, own, slopes = bordered_rows(x, 3, frame), ring_buffer(x, 3, frame), ring_buffer(x, 3, frame)
    for channel in range(3):
        top, first, _last, rows_ahead = part_of(start, stop, channel, 2 * REACH, frame)
        for ahead in rows_ahead:
            feed(None, 0, x, y, top, ahead, frame, rows, own, 0)
            row = ahead - REACH
            if counts(row, loss.margin, frame) and row >= first - REACH:
                for i in range(0, frame.stride, lanes(x)):
                    m, p, q, mu, var = window_at(own, row, i, top + row * frame.stride, frame, target)
                    aside = load(columns, i)
                    put(rows, i, frame, ssim_uniform(m, p, q, mu, var, aside + lines[row] * (1.0 - aside)))
                leave_margin(rows, 3, loss.margin, frame)
                blur_along(rows, 3, frame, slopes, 0, row)
            else:
                clear(slopes, 0, 3, row, frame)
            row = ahead - 2 * REACH
            if row < first:
                continue
            at = top + row * frame.stride
            for i in range(0, frame.stride, lanes(x)):
                aim = load(y, at + i)
                residual = load(x, at + i) - aim
                total = pixel_curvature(residual, loss.kind, loss.eps, broadcast(x, loss.pixel))
                bm, bp, bq = blur_down_three(slopes, 0, row, i, frame)
                store(uniform, at + i, total - loss.structural * ssim_adjoint(residual, aim - CENTRE, bm, bp, bq))
            clear_padding(uniform, at, frame)


@kernel
def diagonal_rows(start, stop, frame, loss, x, y, blurred_sp, seconds, squared, diagonal):
    """The diagonal of the loss's Hessian.  squared: the frame with the window's weights squared."""
    rows, bends = bordered_rows(x, SECONDS, frame), ring_buffer(x, SECONDS, frame)
    lead = REACH if loss.structural != 0 else 0
    for channel in range(3):
        top, first, _last, rows_ahead = part_of(start, stop, channel, lead, frame)
        for ahead in rows_ahead:
            if loss.structural != 0:
                if 0 <= ahead < frame.height:
                    for i in range(0, frame.stride, lanes(x)):
                        put(rows, i, frame, seconds_at(seconds, top + ahead * frame.stride + i, frame))
                    blur_along(rows, SECONDS, squared, bends, 0, ahead)
                else:
                    clear(bends, 0, SECONDS, ahead, frame)
            row = ahead - lead
            if row < first:
                continue
            at = top + row * frame.stride
            for i in range(0, frame.stride, lanes(x)):
                residual, aim = load(x, at + i) - load(y, at + i), load(y, at + i) - CENTRE
                total = pixel_curvature(residual, loss.kind, loss.eps, broadcast(x, loss.pixel))
                if loss.structural != 0:
                    mm, mp, mq = blur_down_three(bends, 0, row, i, squared)
                    own = mm, mp, mq, blur_down(bends, 3, row, i, squared), blur_down(bends, 4, row, i, squared)
                    total -= loss.structural * ssim_diag_hessian(own, load(blurred_sp, at + i), residual, aim)
                store(diagonal, at + i, total)
            clear_padding(diagonal, at, frame)


@kernel
def uncoupled_rows(start, stop, frame, loss, x, y, blurred_sp, uncoupled):
    """What a loss with SSIM adds to v . l'' v for a pixel's v^2: its pixel loss's curvature, and SSIM's by blur(S_p)."""
    for channel in range(3):
        top, first, last, _ahead = part_of(start, stop, channel, 0, frame)
        for row in range(first, last):
            at = top + row * frame.stride
            for i in range(0, frame.stride, lanes(x)):
                curvature = pixel_curvature(
                    load(x, at + i) - load(y, at + i), loss.kind, loss.eps, broadcast(x, loss.pixel)
                )
                store(uncoupled, at + i, curvature - 2.0 * loss.structural * load(blurred_sp, at + i))
            clear_padding(uncoupled, at, frame)
