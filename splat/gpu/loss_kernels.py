"""The losses on the GPU: kernels over the values of an image, each thread one pixel of one channel.

The formulas of a pixel are those of `splat/losses/formulas.py`.  A sweep of the CPU is here up to four kernels, with the fields
between them in memory: `feed`, products blurred along the rows; `differentiate`, those blurred down the columns, and partial
derivatives; `blur_along`, these blurred along the rows; `finish_...`, those blurred down the columns, and the result.  Sums
over the window have the CPU's order.

Fields are planes (3, h, w) one after the other; `constants` are the window's WINDOW weights, eps, and the weights of the pixel
loss and of the structural one over the number of values, in the image's precision.  Kernels with vectors take one for each
place along the grid's second axis.
"""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (in a kernel names mean tensors)

import triton.language as tl

from splat.gpu.language.compile import jit
from splat.gpu.language.formula import triton_formula
from splat.losses import formulas, reference

EPS, PIXEL, STRUCTURAL = (tl.constexpr(reference.WINDOW + i) for i in range(3))
REACH, CENTRE = tl.constexpr(reference.REACH), tl.constexpr(formulas.CENTRE)
SECONDS = tl.constexpr(formulas.SECONDS)

ssim_slopes, ssim_seconds = triton_formula(formulas.ssim_slopes), triton_formula(formulas.ssim_seconds)
ssim_adjoint, ssim_second_dot = triton_formula(formulas.ssim_adjoint), triton_formula(formulas.ssim_second_dot)
ssim_quadratic_form = triton_formula(formulas.ssim_quadratic_form)
ssim_uniform = triton_formula(formulas.ssim_uniform)
ssim_diag_hessian = triton_formula(formulas.ssim_diag_hessian)
pixel_slope, pixel_curvature = triton_formula(formulas.pixel_slope), triton_formula(formulas.pixel_curvature)
pair_slopes, pair_adjoint = triton_formula(formulas.pair_slopes), triton_formula(formulas.pair_adjoint)


# --- the window -------------------------------------------------------------------------------------------------------


@jit
def pixels(height, width, BLOCK: tl.constexpr):
    """A program's values: their places in a field, columns, rows, and which of them exist; the size of a field."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    return at, at % width, (at // width) % height, at < 3 * height * width, 3 * height * width


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
def windowed_down(fields, at, y, height, width, constants, here, COUNT: tl.constexpr):
    """The window down the columns, of so many fields."""
    found = ()
    for j in tl.static_range(COUNT):
        field = fields if j == 0 else fields + j * (3 * height * width)  # an offset of 0 would cost registers
        found = found + (windowed(field, at, y, width, height, constants, here),)
    return found


@jit
def moments(pointer, at, place, step, limit, constants, here):
    """The window's mean and variance along an axis."""
    middle = tl.load(pointer + at, here, other=0.0)
    shift, square = middle * 0.0, middle * 0.0
    for k in tl.static_range(1, REACH + 1):
        before = near(pointer, at, place, -k, step, limit, here) - middle
        after = near(pointer, at, place, k, step, limit, here) - middle
        shift += (before + after) * tl.load(constants + REACH + k)
        square += (before * before + after * after) * tl.load(constants + REACH + k)
    return middle + shift, square - shift * shift


@jit
def windowed_moments(along, at, y, height, width, constants, here):
    """The window's mean and variance, from those along the rows: by the law of total variance (`losses/cpu/window.py`)."""
    within = windowed(along + 3 * height * width, at, y, width, height, constants, here)
    mean, variance = moments(along, at, y, width, height, constants, here)
    return mean, within + variance


@jit
def load_all(fields, at, size, here, COUNT: tl.constexpr):
    """The values of so many fields."""
    found = ()
    for j in tl.static_range(COUNT):
        found = found + (tl.load(fields + j * size + at, here, other=0.0),)
    return found


@jit
def store_all(fields, at, size, values, here, COUNT: tl.constexpr):
    for j in tl.static_range(COUNT):
        tl.store(fields + j * size + at, values[j], here)


@jit
def partial_sum(values, here, out):
    """A program's sum in double precision, to its place in out."""
    tl.store(out + tl.program_id(0), tl.sum(tl.where(here, values.to(tl.float64), 0.0), 0))


@jit
def blur_along(fields, out, constants, height, width, BLOCK: tl.constexpr):
    """Every field blurred along its rows."""
    at, x, _y, here, size = pixels(height, width, BLOCK)
    first = tl.program_id(1).to(tl.int64) * size
    tl.store(out + first + at, windowed(fields + first, at, x, 1, width, constants, here), here)


@jit
def product(value, residual, aim, FIELD: tl.constexpr):
    """v, r v or (y - c) v."""
    return value if FIELD == 0 else value * residual if FIELD == 1 else value * aim


@jit
def feed(v, v_stride, residual, target, out, constants, height, width, FIELDS: tl.constexpr, BLOCK: tl.constexpr):
    """The first so many of v, r v and (y - c) v, blurred along the rows, of every vector."""
    at, x, _y, here, size = pixels(height, width, BLOCK)
    vector = tl.program_id(1).to(tl.int64)
    v += vector * v_stride
    out += vector * FIELDS * size
    for field in tl.static_range(FIELDS):
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


@jit
def moments_along(image, out, constants, height, width, BLOCK: tl.constexpr):
    """The window's mean and variance along the rows: two fields."""
    at, x, _y, here, size = pixels(height, width, BLOCK)
    store_all(out, at, size, moments(image, at, x, 1, width, constants, here), here, 2)


@jit
def moments_down(along, out, constants, height, width, BLOCK: tl.constexpr):
    """The window's mean and variance, from those along the rows: two fields."""
    at, _x, y, here, size = pixels(height, width, BLOCK)
    store_all(out, at, size, windowed_moments(along, at, y, height, width, constants, here), here, 2)


# --- one image against a target ---------------------------------------------------------------------------------------


@jit
def counted(values, x, y, height, width, MARGIN: tl.constexpr):
    """The values, 0 so near to the image's edges."""
    inside = (x >= MARGIN) & (x < width - MARGIN) & (y >= MARGIN) & (y < height - MARGIN)
    found = ()
    for j in tl.static_range(len(values)):
        found = found + (tl.where(inside, values[j], 0.0),)
    return found if MARGIN > 0 else values


@jit
def differentiate(
    fed, target_moments, out, second, distances, constants, height, width,
    SLOPES: tl.constexpr, SECOND: tl.constexpr, MARGIN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums of 1 - S; with SLOPES also S_m, S_p, S_q, with SECOND the second derivatives of S."""
    at, x, y, here, size = pixels(height, width, BLOCK)
    m, p, q = windowed_down(fed, at, y, height, width, constants, here, 3)
    mu, var = load_all(target_moments, at, size, here, 2)
    distance, sm, sp, sq = counted(ssim_slopes(m, p, q, mu, var), x, y, height, width, MARGIN)
    partial_sum(distance, here, distances)
    if SLOPES:
        store_all(out, at, size, (sm, sp, sq), here, 3)
    if SECOND:
        found = counted(ssim_seconds(m, p, q, mu, var), x, y, height, width, MARGIN)
        store_all(second, at, size, found, here, SECONDS)


@jit
def differentiate_uniform(
    fed, target_moments, columns, lines, out, constants, height, width, MARGIN: tl.constexpr, BLOCK: tl.constexpr
):
    """S_m', S_p', S_q' for an image of ones; columns, lines: the window's weight beyond the edges (`losses/cpu/sweeps.py`)."""
    at, x, y, here, size = pixels(height, width, BLOCK)
    m, p, q = windowed_down(fed, at, y, height, width, constants, here, 3)
    mu, var = load_all(target_moments, at, size, here, 2)
    aside = tl.load(columns + x)
    found = ssim_uniform(m, p, q, mu, var, aside + tl.load(lines + y) * (1.0 - aside))
    store_all(out, at, size, counted(found, x, y, height, width, MARGIN), here, 3)


@jit
def finish_gradient(
    blurred, residual, target, gradient, blurred_sp, losses, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, SLOPES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums of the pixel loss; with SLOPES the gradient, and blur(S_p)."""
    at, _x, y, here, _size = pixels(height, width, BLOCK)
    r = tl.load(residual + at, here, other=0.0)
    value, slope = pixel_slope(r, KIND, tl.load(constants + EPS))
    partial_sum(value, here, losses)
    if SLOPES:
        total = slope * tl.load(constants + PIXEL)
        if SSIM:
            aim = tl.load(target + at, here, other=0.0) - CENTRE
            bm, bp, bq = windowed_down(blurred, at, y, height, width, constants, here, 3)
            total -= tl.load(constants + STRUCTURAL) * ssim_adjoint(r, aim, bm, bp, bq)
            tl.store(blurred_sp + at, bp, here)
        tl.store(gradient + at, total, here)


@jit
def curve(fed, second, out, constants, height, width, BLOCK: tl.constexpr):
    """S_m', S_p', S_q' of every vector."""
    at, _x, y, here, size = pixels(height, width, BLOCK)
    first = tl.program_id(1).to(tl.int64) * 3 * size
    dm, dp, dq = windowed_down(fed + first, at, y, height, width, constants, here, 3)
    found = ssim_second_dot(load_all(second, at, size, here, SECONDS), dm, 2.0 * dp, dq)
    store_all(out + first, at, size, found, here, 3)


@jit
def finish_product(
    v, v_stride, blurred, residual, target, blurred_sp, out, out_stride, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The Hessian of the loss times every vector; out may be v."""
    at, _x, y, here, size = pixels(height, width, BLOCK)
    vector = tl.program_id(1).to(tl.int64)
    r, tangent = tl.load(residual + at, here, other=0.0), tl.load(v + vector * v_stride + at, here, other=0.0)
    total = pixel_curvature(r, KIND, tl.load(constants + EPS), tl.load(constants + PIXEL)) * tangent
    if SSIM:
        aim = tl.load(target + at, here, other=0.0) - CENTRE
        bm, bp, bq = windowed_down(blurred + vector * 3 * size, at, y, height, width, constants, here, 3)
        turned = 2.0 * tangent * tl.load(blurred_sp + at, here, other=0.0)
        total -= tl.load(constants + STRUCTURAL) * (ssim_adjoint(r, aim, bm, bp, bq) + turned)
    tl.store(out + vector * out_stride + at, total, here)


@jit
def forms(
    v, v_stride, fed, second, residual, blurred_sp, diagonal, full, pixelwise, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums of v . l'' v and of v . D v, D the diagonal of l'', of every vector: one a program."""
    at, _x, y, here, size = pixels(height, width, BLOCK)
    vector = tl.program_id(1).to(tl.int64)
    r, tangent = tl.load(residual + at, here, other=0.0), tl.load(v + vector * v_stride + at, here, other=0.0)
    squared = tangent * tangent
    total = pixel_curvature(r, KIND, tl.load(constants + EPS), tl.load(constants + PIXEL)) * squared
    if SSIM:
        dm, dp, dq = windowed_down(fed + vector * 3 * size, at, y, height, width, constants, here, 3)
        bends, bp = load_all(second, at, size, here, SECONDS), tl.load(blurred_sp + at, here, other=0.0)
        total -= tl.load(constants + STRUCTURAL) * ssim_quadratic_form(bends, dm, 2.0 * dp, dq, squared, bp)
    partial_sum(total, here, full + vector * tl.num_programs(0))
    partial_sum(tl.load(diagonal + at, here, other=0.0) * squared, here, pixelwise + vector * tl.num_programs(0))


@jit
def finish_diagonal(
    along, residual, target, blurred_sp, out, constants, squared, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The diagonal of the loss's Hessian.  along: the second derivatives blurred along the rows by the window squared."""
    at, _x, y, here, _size = pixels(height, width, BLOCK)
    r = tl.load(residual + at, here, other=0.0)
    total = r * 0.0 + pixel_curvature(r, KIND, tl.load(constants + EPS), tl.load(constants + PIXEL))
    if SSIM:
        bends = windowed_down(along, at, y, height, width, squared, here, SECONDS)
        aim = tl.load(target + at, here, other=0.0) - CENTRE
        own = ssim_diag_hessian(bends, tl.load(blurred_sp + at, here, other=0.0), r, aim)
        total -= tl.load(constants + STRUCTURAL) * own
    tl.store(out + at, total, here)


# --- two images that both depend on the parameters --------------------------------------------------------------------


@jit
def differentiate_pair(fed, along, out, distances, constants, height, width, MARGIN: tl.constexpr, BLOCK: tl.constexpr):
    """Sums of 1 - S, and the four fields of `pair_slopes`."""
    at, x, y, here, size = pixels(height, width, BLOCK)
    m, p = windowed_down(fed, at, y, height, width, constants, here, 2)
    mean, variance = windowed_moments(along, at, y, height, width, constants, here)
    found = counted(pair_slopes(m, p, mean, variance), x, y, height, width, MARGIN)
    partial_sum(found[0], here, distances)
    store_all(out, at, size, found[1:], here, 4)


@jit
def finish_pair(
    blurred, x, y, in_x, in_y, losses, constants, height, width,
    KIND: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums of the pixel loss, and the gradients of the loss in x and in y."""
    at, _column, row, here, _size = pixels(height, width, BLOCK)
    one, other = tl.load(x + at, here, other=0.0), tl.load(y + at, here, other=0.0)
    value, slope = pixel_slope(one - other, KIND, tl.load(constants + EPS))
    partial_sum(value, here, losses)
    slope = slope * tl.load(constants + PIXEL)
    one_bar, other_bar = slope, -slope
    if SSIM:
        bm, bp, ba, bv = windowed_down(blurred, at, row, height, width, constants, here, 4)
        one_bar, other_bar = pair_adjoint(one, other, slope, tl.load(constants + STRUCTURAL), bm, bp, ba, bv)
    tl.store(in_x + at, one_bar, here)
    tl.store(in_y + at, other_bar, here)
