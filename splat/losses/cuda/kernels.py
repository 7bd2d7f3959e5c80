"""The losses on the GPU: kernels over the values of an image, each thread one pixel of one channel.

The formulas of a pixel are those of `losses_formulas.py` and `consistency_kernels.py`, run by `traced.py`.  A sweep of the CPU
is here up to four kernels, with the fields between them in memory: products blurred along the rows; blurred down the columns
and differentiated; that blurred along the rows; down the columns, and the result.  Sums over the window have the CPU's order.

Fields are planes (3, h, w) one after the other; `constants` are the window's WINDOW weights, eps, and the weights of the pixel
loss and of the structural one over the number of values, in the image's precision.  Kernels with vectors take one for each
place along the grid's second axis.
"""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (in a kernel names mean tensors)

import triton.language as tl

from splat.backend.gpu.compile import jit
from splat.backend.gpu.traced import digest, traced
from splat.losses import formulas as losses_formulas
from splat.losses.formulas import seconds_of, similarity, slopes_of
from splat.losses.reference import WINDOW

EPS, PIXEL, STRUCTURAL = tl.constexpr(WINDOW), tl.constexpr(WINDOW + 1), tl.constexpr(WINDOW + 2)
REACH = tl.constexpr(WINDOW // 2)
CENTRE = tl.constexpr(losses_formulas.CENTRE)
SECONDS = tl.constexpr(losses_formulas.SECONDS)

pixel_slope = traced(losses_formulas.pixel_slope)
pixel_curvature = traced(losses_formulas.pixel_curvature)
ssim_adjoint = traced(losses_formulas.ssim_adjoint)
ssim_second_dot = traced(losses_formulas.ssim_second_dot)
ssim_quadratic_form = traced(losses_formulas.ssim_quadratic_form)
ssim_diag_hessian = traced(losses_formulas.ssim_diag_hessian)
pair_slopes = traced(losses_formulas.pair_slopes)


@traced
def slopes(m, p, q, mu, var):
    """1 - S, and S_m, S_p, S_q."""
    return slopes_of(similarity(m, p, q, mu, var))


@traced
def seconds(m, p, q, mu, var):
    return seconds_of(similarity(m, p, q, mu, var))


FORMULAS = digest()


# --- the window -------------------------------------------------------------------------------------------------------


@jit
def pixels(height, width, BLOCK: tl.constexpr):
    """A program's values, their columns and rows, and which of them exist."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    return at, at % width, (at // width) % height, at < 3 * height * width


@jit
def near(pointer, at, place, distance, step, limit, here):
    """The value so far along an axis, at `place` of `limit` there; 0 outside the image."""
    return tl.load(
        pointer + at + distance * step, here & (place + distance >= 0) & (place + distance < limit), other=0.0
    )


@jit
def windowed(pointer, at, place, step, limit, constants, here):
    """The window along an axis."""
    total = tl.load(pointer + at, here, other=0.0) * tl.load(constants + REACH)
    for k in tl.static_range(1, REACH + 1):
        before, after = near(pointer, at, place, -k, step, limit, here), near(pointer, at, place, k, step, limit, here)
        total += (before + after) * tl.load(constants + REACH + k)
    return total


@jit
def product(value, residual, aim, FIELD: tl.constexpr):
    """v, r v or (y - c) v."""
    return value if FIELD == 0 else value * residual if FIELD == 1 else value * aim


@jit
def partial_sum(values, here, out):
    """A program's sum in double precision, to its place in out."""
    tl.store(out + tl.program_id(0), tl.sum(tl.where(here, values.to(tl.float64), 0.0), 0))


@jit
def blur_along(fields, out, constants, height, width, BLOCK: tl.constexpr):
    """Every field blurred along its rows."""
    at, x, _y, here = pixels(height, width, BLOCK)
    first = tl.program_id(1).to(tl.int64) * 3 * height * width
    tl.store(out + first + at, windowed(fields + first, at, x, 1, width, constants, here), here)


@jit
def feed(v, v_stride, residual, target, out, constants, height, width, BLOCK: tl.constexpr):
    """v, r v and (y - c) v blurred along the rows: three fields a vector."""
    at, x, _y, here = pixels(height, width, BLOCK)
    size, vector = 3 * height * width, tl.program_id(1).to(tl.int64)
    v += vector * v_stride
    out += vector * 3 * size
    for field in tl.static_range(3):
        total = tl.load(constants) * 0.0
        for k in tl.static_range(REACH + 1):
            pair = total * 0.0
            for side in tl.static_range(2 if k > 0 else 1):
                distance = k if side == 1 else -k
                value = near(v, at, x, distance, 1, width, here)
                r = near(residual, at, x, distance, 1, width, here)
                pair += product(value, r, near(target, at, x, distance, 1, width, here) - CENTRE, field)
            total += pair * tl.load(constants + REACH + k)
        tl.store(out + field * size + at, total, here)


# --- one image against a target ---------------------------------------------------------------------------------------


@jit
def moments_of(middle, shift, square):
    return middle + shift, square - shift * shift


@jit
def moments_along(x, y, out, constants, height, width, BLOCK: tl.constexpr):
    """The window's mean and variance of (x + y) / 2 along the rows: two fields."""
    at, column, _row, here = pixels(height, width, BLOCK)
    middle = 0.5 * (tl.load(x + at, here, other=0.0) + tl.load(y + at, here, other=0.0))
    shift, square = middle * 0.0, middle * 0.0
    for k in tl.static_range(1, REACH + 1):
        before = 0.5 * (near(x, at, column, -k, 1, width, here) + near(y, at, column, -k, 1, width, here)) - middle
        after = 0.5 * (near(x, at, column, k, 1, width, here) + near(y, at, column, k, 1, width, here)) - middle
        shift += (before + after) * tl.load(constants + REACH + k)
        square += (before * before + after * after) * tl.load(constants + REACH + k)
    mean, variance = moments_of(middle, shift, square)
    tl.store(out + at, mean, here)
    tl.store(out + 3 * height * width + at, variance, here)


@jit
def moments(along, at, y, height, width, constants, here):
    """The window's mean and variance, from those along the rows."""
    size = 3 * height * width
    middle = tl.load(along + at, here, other=0.0)
    within = windowed(along + size, at, y, width, height, constants, here)
    shift, square = middle * 0.0, middle * 0.0
    for k in tl.static_range(1, REACH + 1):
        before = near(along, at, y, -k, width, height, here) - middle
        after = near(along, at, y, k, width, height, here) - middle
        shift += (before + after) * tl.load(constants + REACH + k)
        square += (before * before + after * after) * tl.load(constants + REACH + k)
    mean, variance = moments_of(middle, shift, square)
    return mean, within + variance


@jit
def moments_down(along, out, constants, height, width, BLOCK: tl.constexpr):
    """mu and var: two fields."""
    at, _x, y, here = pixels(height, width, BLOCK)
    mean, variance = moments(along, at, y, height, width, constants, here)
    tl.store(out + at, mean, here)
    tl.store(out + 3 * height * width + at, variance, here)


@jit
def differentiate(
    fed, target_moments, out, second, distances, constants, height, width,
    SLOPES: tl.constexpr, SECOND: tl.constexpr, BLOCK: tl.constexpr, FORMULAS: tl.constexpr,
):  # fmt: skip
    """Sums of 1 - S; with SLOPES also S_m, S_p, S_q, with SECOND the second derivatives of S."""
    at, _x, y, here = pixels(height, width, BLOCK)
    size = 3 * height * width
    m = windowed(fed, at, y, width, height, constants, here)
    p = windowed(fed + size, at, y, width, height, constants, here)
    q = windowed(fed + 2 * size, at, y, width, height, constants, here)
    mu = tl.load(target_moments + at, here, other=0.0)
    var = tl.load(target_moments + size + at, here, other=0.0)
    found = slopes(m, p, q, mu, var)
    partial_sum(found[0], here, distances)
    if SLOPES:
        for j in tl.static_range(3):
            tl.store(out + j * size + at, found[1 + j], here)
    if SECOND:
        bends = seconds(m, p, q, mu, var)
        for j in tl.static_range(SECONDS):
            tl.store(second + j * size + at, bends[j], here)


@jit
def finish_gradient(
    blurred, residual, target, gradient, blurred_sp, losses, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, SLOPES: tl.constexpr, BLOCK: tl.constexpr, FORMULAS: tl.constexpr,
):  # fmt: skip
    """Sums of the pixel loss; with SLOPES the gradient, and blur(S_p)."""
    at, _x, y, here = pixels(height, width, BLOCK)
    size = 3 * height * width
    r = tl.load(residual + at, here, other=0.0)
    value, slope = pixel_slope(r, KIND, tl.load(constants + EPS))
    partial_sum(value, here, losses)
    if SLOPES:
        total = slope * tl.load(constants + PIXEL)
        if SSIM:
            aim = tl.load(target + at, here, other=0.0) - CENTRE
            bm = windowed(blurred, at, y, width, height, constants, here)
            bp = windowed(blurred + size, at, y, width, height, constants, here)
            bq = windowed(blurred + 2 * size, at, y, width, height, constants, here)
            total -= tl.load(constants + STRUCTURAL) * ssim_adjoint(r, aim, bm, bp, bq)
            tl.store(blurred_sp + at, bp, here)
        tl.store(gradient + at, total, here)


@jit
def changes(fed, at, y, height, width, constants, here):
    """m', p' and q' of a vector."""
    size = 3 * height * width
    dm = windowed(fed, at, y, width, height, constants, here)
    dp = windowed(fed + size, at, y, width, height, constants, here)
    return dm, 2.0 * dp, windowed(fed + 2 * size, at, y, width, height, constants, here)


@jit
def second_derivatives(second, at, size, here):
    bends = ()
    for j in tl.static_range(SECONDS):
        bends = bends + (tl.load(second + j * size + at, here, other=0.0),)
    return bends


@jit
def curve(fed, second, out, constants, height, width, BLOCK: tl.constexpr, FORMULAS: tl.constexpr):
    """S_m', S_p', S_q' of every vector."""
    at, _x, y, here = pixels(height, width, BLOCK)
    size = 3 * height * width
    first = tl.program_id(1).to(tl.int64) * 3 * size
    dm, dp, dq = changes(fed + first, at, y, height, width, constants, here)
    found = ssim_second_dot(second_derivatives(second, at, size, here), dm, dp, dq)
    for j in tl.static_range(3):
        tl.store(out + first + j * size + at, found[j], here)


@jit
def finish_product(
    v, v_stride, blurred, residual, target, blurred_sp, out, out_stride, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr, FORMULAS: tl.constexpr,
):  # fmt: skip
    """The Hessian of the loss times every vector; out may be v."""
    at, _x, y, here = pixels(height, width, BLOCK)
    size, vector = 3 * height * width, tl.program_id(1).to(tl.int64)
    r, tangent = tl.load(residual + at, here, other=0.0), tl.load(v + vector * v_stride + at, here, other=0.0)
    total = pixel_curvature(r, KIND, tl.load(constants + EPS), tl.load(constants + PIXEL)) * tangent
    if SSIM:
        aim = tl.load(target + at, here, other=0.0) - CENTRE
        blurred += vector * 3 * size
        bm = windowed(blurred, at, y, width, height, constants, here)
        bp = windowed(blurred + size, at, y, width, height, constants, here)
        bq = windowed(blurred + 2 * size, at, y, width, height, constants, here)
        turned = 2.0 * tangent * tl.load(blurred_sp + at, here, other=0.0)
        total -= tl.load(constants + STRUCTURAL) * (ssim_adjoint(r, aim, bm, bp, bq) + turned)
    tl.store(out + vector * out_stride + at, total, here)


@jit
def forms(
    v, v_stride, fed, second, residual, blurred_sp, diagonal, full, pixelwise, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr, FORMULAS: tl.constexpr,
):  # fmt: skip
    """Sums of v . l'' v and of v . D v, D the diagonal of l'', of every vector: one a program."""
    at, _x, y, here = pixels(height, width, BLOCK)
    size, vector = 3 * height * width, tl.program_id(1).to(tl.int64)
    r, tangent = tl.load(residual + at, here, other=0.0), tl.load(v + vector * v_stride + at, here, other=0.0)
    squared = tangent * tangent
    total = pixel_curvature(r, KIND, tl.load(constants + EPS), tl.load(constants + PIXEL)) * squared
    if SSIM:
        dm, dp, dq = changes(fed + vector * 3 * size, at, y, height, width, constants, here)
        bends, blurred = second_derivatives(second, at, size, here), tl.load(blurred_sp + at, here, other=0.0)
        total -= tl.load(constants + STRUCTURAL) * ssim_quadratic_form(bends, dm, dp, dq, squared, blurred)
    partial_sum(total, here, full + vector * tl.num_programs(0))
    partial_sum(tl.load(diagonal + at, here, other=0.0) * squared, here, pixelwise + vector * tl.num_programs(0))


@jit
def finish_diagonal(
    along, residual, target, blurred_sp, out, constants, squared, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr, FORMULAS: tl.constexpr,
):  # fmt: skip
    """The diagonal of the loss's Hessian.  along: the second derivatives blurred along the rows by the window squared."""
    at, _x, y, here = pixels(height, width, BLOCK)
    size = 3 * height * width
    r = tl.load(residual + at, here, other=0.0)
    total = r * 0.0 + pixel_curvature(r, KIND, tl.load(constants + EPS), tl.load(constants + PIXEL))
    if SSIM:
        bends = ()
        for j in tl.static_range(SECONDS):
            bends = bends + (windowed(along + j * size, at, y, width, height, squared, here),)
        aim = tl.load(target + at, here, other=0.0) - CENTRE
        own = ssim_diag_hessian(bends, tl.load(blurred_sp + at, here, other=0.0), r, aim)
        total -= tl.load(constants + STRUCTURAL) * own
    tl.store(out + at, total, here)


# --- two images that both depend on the parameters --------------------------------------------------------------------


@jit
def feed_pair(x, y, out, constants, height, width, BLOCK: tl.constexpr):
    """r and r^2 blurred along the rows, r = x - y: two fields."""
    at, column, _row, here = pixels(height, width, BLOCK)
    for field in tl.static_range(2):
        total = tl.load(constants) * 0.0
        for k in tl.static_range(REACH + 1):
            pair = total * 0.0
            for side in tl.static_range(2 if k > 0 else 1):
                distance = k if side == 1 else -k
                r = near(x, at, column, distance, 1, width, here) - near(y, at, column, distance, 1, width, here)
                pair += r if field == 0 else r * r
            total += pair * tl.load(constants + REACH + k)
        tl.store(out + field * 3 * height * width + at, total, here)


@jit
def differentiate_pair(
    fed, along, out, distances, constants, height, width, BLOCK: tl.constexpr, FORMULAS: tl.constexpr
):  # fmt: skip
    """Sums of 1 - S, and its slopes: four fields."""
    at, _x, y, here = pixels(height, width, BLOCK)
    size = 3 * height * width
    m = windowed(fed, at, y, width, height, constants, here)
    p = windowed(fed + size, at, y, width, height, constants, here)
    mean, variance = moments(along, at, y, height, width, constants, here)
    found = pair_slopes(m, p, mean, variance)
    partial_sum(found[0], here, distances)
    for j in tl.static_range(4):
        tl.store(out + j * size + at, found[1 + j], here)


@jit
def finish_pair(
    blurred, x, y, in_x, in_y, losses, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr, FORMULAS: tl.constexpr,
):  # fmt: skip
    """Sums of the pixel loss, and the gradients of the loss in x and in y."""
    at, _column, row, here = pixels(height, width, BLOCK)
    size = 3 * height * width
    one, other = tl.load(x + at, here, other=0.0), tl.load(y + at, here, other=0.0)
    r = one - other
    value, slope = pixel_slope(r, KIND, tl.load(constants + EPS))
    partial_sum(value, here, losses)
    apart, along = slope * tl.load(constants + PIXEL), r * 0.0
    if SSIM:
        structural = tl.load(constants + STRUCTURAL)
        bm = windowed(blurred, at, row, width, height, constants, here)
        bp = windowed(blurred + size, at, row, width, height, constants, here)
        ba = windowed(blurred + 2 * size, at, row, width, height, constants, here)
        bv = windowed(blurred + 3 * size, at, row, width, height, constants, here)
        apart += structural * (bm + 2.0 * r * bp)
        along = structural * (0.5 * ba + (0.5 * (one + other) - CENTRE) * bv)
    tl.store(in_x + at, along + apart, here)
    tl.store(in_y + at, along - apart, here)
