"""The compositing kernels on the GPU: `render/formulas.py`, whose glossary and formulas hold here, in Triton.

A program is one warp.  It has one tile of 16 x 16 pixels, eight a thread, and goes through the tile's intersections (splats
that touch it) one by one:

- the sums of an intersection over a tile cost a warp the same instructions whatever the tile's size, and several warps to a
  tile would have to wait for one another at every splat; with one there is no barrier and no shared memory
- a thread's eight pixels are independent, which hides the latency that more warps would
- a splat's numbers are the same for all threads: the loads are uniform, from one cache line of 64 bytes a splat, and the index
  of the next splat is loaded one step ahead
- K tangents are the first axis of every array, in registers: one code for every K, and a splat's primal quantities are
  computed once for all.  K = 2 takes all 255 registers; K = 4 would spill (`raster.TOGETHER`)
- sums as products with a matrix of ones are for the tensor cores, which round to 10 bits; in full precision they would take
  more instructions than the exchanges of `nine_sums`

For deterministic accumulation every intersection writes its sums to an accumulator of its own, to be added in a fixed order
(`packing.reduce_sums`); for atomic accumulation they are added to those of the splat, in whatever order they come.

Decisions are those of the CPU up to the last bits of l and alpha: the exponential is the hardware's (2 units in the last
place), u and v are rounded at other places (`exponent_terms`).

What an intersection costs: operations are counted from the formulas a pixel as `analysis/bench/speed/scene.py` does; bytes, in
single precision, come from and go to memory or a cache:

                            operations a pixel   bytes an intersection      bytes a pixel of the image
    forward                 17                   4 + 64                     24
    backward                30                   8 + 64 + 36                24
    tangent K = 1           25                   4 + 64 + 36                4 + 20
    tangent K = 2           36                   4 + 64 + 72                4 + 40
    backward_tangent K = 1  46                   8 + 64 + 36 + 36           24 + 20
    backward_tangent K = 2  70                   8 + 64 + 72 + 72           24 + 40

Deterministic accumulation reads the 36 bytes (a tangent) of an intersection once more.  Around that a splat costs 72 + 64 bytes
to pack.
"""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (Triton tells type checkers little of its language)

import triton.language as tl

from splat.gpu.language.compile import jit, sized
from splat.gpu.language.formula import triton_formula
from splat.gpu.raster.packing import (
    ACROSS,
    ALONG,
    ALPHA_MAX,
    BACKGROUND,
    CAP,
    CUT,
    FLOOR,
    LO,
    RED,
    SHEAR,
    SHEAR_REST,
    U,
    V,
    X,
    Y,
)
from splat.render import formulas

NEVER = tl.constexpr(2**31 - 1)  # the stop index of a pixel that does not stop
CHUNK = tl.constexpr(16)  # intersections between two looks whether all pixels of a tile have stopped

alpha_row = triton_formula(formulas.alpha_row)
quadratic = triton_formula(formulas.quadratic)
along_row = triton_formula(formulas.along_row)
plus = triton_formula(formulas.plus)
behind_all = triton_formula(formulas.behind_all)
step_back = triton_formula(formulas.step_back)
step_tangent = triton_formula(formulas.step_tangent)
step_backward_tangent = triton_formula(formulas.step_backward_tangent)
row_terms = triton_formula(formulas.row_terms)
column_terms = triton_formula(formulas.column_terms)


# --- what the kernels share -------------------------------------------------------------------------------------------


@jit
def tile_of(order, columns, width, height, real: tl.constexpr, WIDTH: tl.constexpr, HEIGHT: tl.constexpr):
    """A program's tile: which; its first pixel and its pixels' offsets from there; their places in a plane; which exist."""
    tile = tl.load(order + tl.program_id(0))
    x0, y0 = tile % columns * WIDTH, tile // columns * HEIGHT
    x, y = tl.arange(0, WIDTH)[None, None, :], tl.arange(0, HEIGHT)[None, :, None]
    inside = (x0 + x < width) & (y0 + y < height)
    return tile, (x0.to(real), y0.to(real), x.to(real), y.to(real)), (y0 + y) * width + (x0 + x), inside


@jit
def exponent_terms(params, place):
    """u of a tile's columns, v of its pixels, and what log2 alpha is made of: `alpha_terms` and `row_v` of the CPU.

    place: first pixel and offsets, as of `tile_of`.  Between pixels offsets are exact, so what the first fma leaves of a
    needle's v has its digits.
    """
    x0, y0, x, y = place
    along, across, shear = tl.load(params + ALONG), tl.load(params + ACROSS), tl.load(params + SHEAR)
    dx, dy = x0 - tl.load(params + X), y0 - tl.load(params + Y)
    u = tl.fma(x, along, tl.fma(along, dx, tl.load(params + U)))
    corner = tl.fma(across, tl.fma(tl.load(params + SHEAR_REST), dx, tl.fma(shear, dx, dy)), tl.load(params + V))
    v = tl.fma(y, across, tl.fma(x, across * shear, corner))
    return u, v, (v, across, tl.fma(-u, u, tl.load(params + LO)), tl.load(params + CUT))


@jit
def load3(array, at):
    return tl.load(array + at), tl.load(array + at + 1), tl.load(array + at + 2)


@jit
def load_planes(planes, p, size, inside, COUNT: tl.constexpr = 4):
    """Planes of a tile, 0 outside the image."""
    found = ()
    for j in tl.static_range(COUNT):
        found = found + (tl.load(planes + j * size + p, inside, other=0.0),)
    return found


@jit
def store_planes(planes, p, size, image, alpha, inside):
    tl.store(planes + p, image[0], inside)
    tl.store(planes + size + p, image[1], inside)
    tl.store(planes + 2 * size + p, image[2], inside)
    tl.store(planes + 3 * size + p, alpha, inside)


@jit
def any_lit(g):
    """Whether a cotangent's four planes are not all exactly 0 in a tile; NaN is not 0."""
    lit = (g[0] != 0) | (g[1] != 0) | (g[2] != 0) | (g[3] != 0)
    return tl.max(tl.max(tl.max(lit.to(tl.int32), 2), 1), 0) > 0


@jit
def side_by_side(one, other, lane, axis: tl.constexpr):
    """The sums of two arrays over an axis of length 2, one at either place of it."""
    first = (lane >> (5 - axis)) % 2 == 0
    return tl.where(first, tl.sum(one, axis, True), tl.sum(other, axis, True))


@jit
def nine_sums(v, u, s, w, h, K: tl.constexpr, HEIGHT: tl.constexpr):
    """The nine sums over a tile, (K, 16): sum j at `place_of_sums` j.

    A thread adds up its rows.  Then the threads of a warp, five axes of length 2, halve the number of sums with every exchange:
    20 exchanges for nine sums instead of 45.
    """
    rows = row_terms(v, s, w, h)
    columns = ()
    for j in tl.static_range(6):
        columns = columns + (tl.sum(tl.reshape(rows[j], (K, HEIGHT // 2, 2, 16)), 1),)
    nine = column_terms(columns, u)
    lane = tl.reshape(tl.arange(0, 32), (1, 2, 2, 2, 2, 2))
    a = side_by_side(threads(nine[0], K), threads(nine[1], K), lane, 1)
    b = side_by_side(threads(nine[2], K), threads(nine[3], K), lane, 1)
    c = side_by_side(threads(nine[4], K), threads(nine[5], K), lane, 1)
    d = side_by_side(threads(nine[6], K), threads(nine[7], K), lane, 1)
    ninth = tl.sum(tl.sum(tl.sum(threads(nine[8], K), 1, True), 2, True), 3, True)
    eight = side_by_side(side_by_side(a, b, lane, 2), side_by_side(c, d, lane, 2), lane, 3)
    return tl.reshape(tl.sum(side_by_side(eight, ninth, lane, 4), 5), (K, 16))


@jit
def threads(x, K: tl.constexpr):
    return tl.reshape(x, (K, 2, 2, 2, 2, 2))


@jit
def place_of_sums():
    """Index of the sum at each of the 16 places that `nine_sums` fills, (1, 16), and where it is no copy."""
    place = tl.arange(0, 16)[None, :]
    even = place % 2 == 0
    return tl.where(even, place // 8 + place // 4 % 2 * 2 + place // 2 % 2 * 4, 8), even | (place == 1)


@jit
def put_sums(sums, at, total, K: tl.constexpr, ATOMIC: tl.constexpr):
    """Write or add the sums of an intersection, K times nine from at * K * 9."""
    j, kept = place_of_sums()
    k = tl.arange(0, K)[:, None]
    place = sums + (at.to(tl.int64) * K + k) * 9 + j
    if ATOMIC:
        tl.atomic_add(place, total, kept & (k < K), sem="relaxed")
    else:
        tl.store(place, total, kept & (k < K))


@jit
def clear_sums(accumulators, first, count, sums, WIDTH: tl.constexpr):
    """Zeros for the sums, WIDTH an intersection, of a tile."""
    j = tl.arange(0, 16)
    for e in range(first, first + count):
        at = tl.load(accumulators + e).to(tl.int64) * WIDTH
        for start in range(0, WIDTH, 16):
            tl.store(sums + at + start + j, tl.zeros((16,), sums.dtype.element_ty), start + j < WIDTH)


# --- forward and backward ---------------------------------------------------------------------------------------------


@jit
def forward(
    order, start, splat_of, packed, frame, planes, transmittance, stop, reached, columns, width, height,
    WIDTH: tl.constexpr, HEIGHT: tl.constexpr,
):  # fmt: skip
    """Render planes (4, h, w), the final T and where each pixel stopped; how many intersections each tile reached."""
    real: tl.constexpr = packed.dtype.element_ty
    tile, place, p, inside = tile_of(order, columns, width, height, real, WIDTH, HEIGHT)
    cap, floor = tl.load(frame + ALPHA_MAX).to(real), tl.load(frame + FLOOR).to(real)
    first = tl.load(start + tile)
    count = tl.load(start + tile + 1) - first
    T = tl.where(inside, 1.0, -1.0).to(real)  # negative once stopped
    stopped = tl.where(inside, NEVER, 0)
    zero = tl.zeros((1, HEIGHT, WIDTH), real)
    red, green, blue = zero, zero, zero
    # front to back; the next splat's index is loaded ahead of its use
    following = tl.load(splat_of + first, count > 0, other=0)
    done = 0
    while done < count:
        for k in range(done, tl.minimum(done + CHUNK, count)):
            splat = packed + following.to(tl.int64) * 16
            following = tl.load(splat_of + first + tl.minimum(k + 1, count - 1))
            _u, v, terms = exponent_terms(splat, place)
            alpha, _uncapped = alpha_row(v, terms, T > 0, cap)
            w, after = alpha * T, tl.fma(-alpha, T, T)
            # a pixel stops in front of the splat that would take T below the floor
            ends = (after < floor) & (T > 0)
            w, T = tl.where(ends, 0.0, w), tl.where(ends, -T, after)
            stopped = tl.where(ends, k, stopped)
            red, green, blue = plus((red, green, blue), w, load3(splat, RED))
        # until all pixels of the tile have stopped
        running = tl.max(tl.max(tl.max(T, 2), 1), 0)
        done = tl.where(running > 0, done + CHUNK, count)
    T = tl.abs(T)
    image = plus((red, green, blue), T, load_background(frame, real))
    store_planes(planes, p, width * height, image, 1.0 - T, inside)
    tl.store(transmittance + p, T, inside)
    tl.store(stop + p, stopped, inside)
    furthest = tl.max(tl.max(tl.max(stopped, 2), 1), 0)
    tl.store(reached + tile, tl.minimum(count, furthest))


@jit
def backward(
    order, start, reached, splat_of, accumulators, packed, frame, transmittance, stop, v_planes, sums, columns, width, height,
    WIDTH: tl.constexpr, HEIGHT: tl.constexpr, ATOMIC: tl.constexpr,
):  # fmt: skip
    """The nine sums of every intersection or, added up, of every splat, from the cotangent of the planes."""
    real: tl.constexpr = packed.dtype.element_ty
    tile, place, p, inside = tile_of(order, columns, width, height, real, WIDTH, HEIGHT)
    cap, size = tl.load(frame + ALPHA_MAX).to(real), width * height
    first, count = tl.load(start + tile), tl.load(reached + tile)
    T, v_pixel = tl.load(transmittance + p, inside, other=1.0), load_planes(v_planes, p, size, inside)
    stopped = tl.load(stop + p, inside, other=0)
    # R behind all splats: the background's part of the loss's slope
    R = T * behind_all(v_pixel, load_background(frame, real))
    # a tile without cotangent adds nothing
    if not any_lit(v_pixel):
        if not ATOMIC:
            clear_sums(accumulators, first, count, sums, 9)
        count = 0
    following = tl.load(splat_of + first + count - 1, count > 0, other=0)
    for back in range(0, count):
        k, s_index = count - 1 - back, following
        following = tl.load(splat_of + first + tl.maximum(k - 1, 0))
        splat = packed + s_index.to(tl.int64) * 16
        u, v, terms = exponent_terms(splat, place)
        # undo the splat: T and R in front of it
        alpha, uncapped = alpha_row(v, terms, k < stopped, cap)
        T, after, w, beta, _r, we = step_back(alpha, T, R, v_pixel, load3(splat, RED))
        # s = dL/dq, 0 where the cap holds
        s = tl.where(uncapped <= tl.load(splat + CAP), we - beta * R, 0.0)
        R = after
        at = s_index if ATOMIC else tl.load(accumulators + first + k)
        put_sums(sums, at, nine_sums(v, u, s, w, v_pixel, 1, HEIGHT), 1, ATOMIC)


@jit
def load_background(frame, real: tl.constexpr):
    background = load3(frame, BACKGROUND)
    return background[0].to(real), background[1].to(real), background[2].to(real)


# --- second order -----------------------------------------------------------------------------------------------------


@jit
def tangents_of(tangents, splat, k, stride):
    """Tangents k of a splat, which has `stride` in all: the coefficients of q', and of its colour."""
    at = tangents + (splat.to(tl.int64) * stride + k) * 9
    q = (tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3), tl.load(at + 4), tl.load(at + 5))
    return q, load3(at, 6)


@jit
def any_moved(moved, splat_of, first, count, begin, stride, K: tl.constexpr):
    """Whether any of K tangents moves a splat of a tile; a look at the first few, unless few splats are moved."""
    k, lane = tl.arange(0, K)[:, None], tl.arange(0, 32)[None, :]
    done, found = 0, 0
    while done < count:
        e = done + lane
        splat = tl.load(splat_of + first + e, e < count, other=0).to(tl.int64)
        some = tl.load(moved + splat * stride + begin + k, e < count, other=0)
        found = tl.max(tl.max(some.to(tl.int32), 1), 0)
        done = tl.where(found > 0, count, done + 32)
    return found > 0


@sized("begin", "stride")
def tangent(
    order, start, reached, splat_of, packed, frame, stop, tangents, moved, planes, transmittances, moves, begin, stride,
    columns, width, height, K: tl.constexpr, WIDTH: tl.constexpr, HEIGHT: tl.constexpr,
):  # fmt: skip
    """J u for K tangents: their planes (K, 4, h, w) and the tangents of the final transmittance (K, h, w).

    tangents: begin, begin + 1, ... of (n, stride, 9); moved: (n, stride), which splats they move; moves: whether they move
    any in a tile.  Where none, all is 0.
    """
    real: tl.constexpr = packed.dtype.element_ty
    tile, place, p, inside = tile_of(order, columns, width, height, real, WIDTH, HEIGHT)
    cap, size = tl.load(frame + ALPHA_MAX).to(real), width * height
    first, count = tl.load(start + tile), tl.load(reached + tile)
    stopped = tl.load(stop + p, inside, other=0)
    i = tl.arange(0, K)[:, None, None]
    T = tl.full((1, HEIGHT, WIDTH), 1.0, real)
    dT = tl.zeros((K, HEIGHT, WIDTH), real)
    red, green, blue = dT, dT, dT
    # a tile in which no tangent moves a splat stays 0
    some = any_moved(moved, splat_of, first, count, begin, stride, K)
    tl.store(moves + tile, some.to(tl.int32))
    count = tl.where(some, count, 0)
    following = tl.load(splat_of + first, count > 0, other=0)
    for k in range(0, count):
        s_index = following
        following = tl.load(splat_of + first + tl.minimum(k + 1, count - 1))
        splat = packed + s_index.to(tl.int64) * 16
        u, v, terms = exponent_terms(splat, place)
        alpha, uncapped = alpha_row(v, terms, k < stopped, cap)
        # primal: w and T
        w = alpha * T
        T = tl.fma(-alpha, T, T)
        # tangents: q', 0 where the cap holds; then T' and image'
        q, dcolour = tangents_of(tangents, s_index, begin + i, stride)
        w_dq = tl.where(uncapped <= tl.load(splat + CAP), w, 0.0) * quadratic(v, along_row(q, u))
        dT, image = step_tangent(dT, (red, green, blue), alpha, w, w_dq, load3(splat, RED), dcolour)
        red, green, blue = image
    at = i * 4 * size + p
    image = plus((red, green, blue), dT, load_background(frame, real))
    store_planes(planes, at, size, image, -dT, inside & (i < K))
    tl.store(transmittances + i * size + p, dT, inside & (i < K))


@sized("begin", "stride")
def backward_tangent(
    order, start, reached, splat_of, accumulators, packed, frame, transmittance, stop, v_planes, tangents, moves,
    transmittances, dv_planes, begin, stride, sums, columns, width, height,
    K: tl.constexpr, WIDTH: tl.constexpr, HEIGHT: tl.constexpr, ATOMIC: tl.constexpr,
):  # fmt: skip
    """The nine sums of the tangent of `backward`, K times nine an intersection or, added up, a splat.

    v_planes: the cotangent, 4 planes; dv_planes: its tangents, (K, 4, h, w); moves, transmittances: as `tangent` left them.
    """
    real: tl.constexpr = packed.dtype.element_ty
    tile, place, p, inside = tile_of(order, columns, width, height, real, WIDTH, HEIGHT)
    cap, size = tl.load(frame + ALPHA_MAX).to(real), width * height
    first, count = tl.load(start + tile), tl.load(reached + tile)
    stopped = tl.load(stop + p, inside, other=0)
    i = tl.arange(0, K)[:, None, None]
    T, v_pixel = tl.load(transmittance + p, inside, other=1.0), load_planes(v_planes, p, size, inside)
    dT = tl.load(transmittances + i * size + p, inside & (i < K), other=0.0)
    dv_pixel = load_planes(dv_planes, i * 4 * size + p, size, inside & (i < K))
    background = load_background(frame, real)
    # behind all splats: R, R' and tau = T' / T
    behind = behind_all(v_pixel, background)
    R = T * behind
    dR = dT * behind + T * behind_all(dv_pixel, background)
    tau = dT / T
    # nothing to do where neither a moved splat meets a cotangent nor the cotangent moves
    if not ((any_lit(v_pixel) & (tl.load(moves + tile) != 0)) | any_lit(dv_pixel)):
        if not ATOMIC:
            clear_sums(accumulators, first, count, sums, 9 * K)
        count = 0
    following = tl.load(splat_of + first + count - 1, count > 0, other=0)
    for back in range(0, count):
        k, s_index = count - 1 - back, following
        following = tl.load(splat_of + first + tl.maximum(k - 1, 0))
        splat = packed + s_index.to(tl.int64) * 16
        u, v, terms = exponent_terms(splat, place)
        alpha, uncapped = alpha_row(v, terms, k < stopped, cap)
        free = uncapped <= tl.load(splat + CAP)
        colour = load3(splat, RED)
        # undo the splat in T and R, then in tau and R'
        T, after, w, beta, r, _we = step_back(alpha, T, R, v_pixel, colour)
        q, dcolour = tangents_of(tangents, s_index, begin + i, stride)
        dq = tl.where(free, quadratic(v, along_row(q, u)), 0.0)
        tau, dR, ds, h = step_backward_tangent(
            tau, dR, (dv_pixel[0], dv_pixel[1], dv_pixel[2]), w, beta, r * R, dq, v_pixel, colour, dcolour
        )
        R = after
        at = s_index if ATOMIC else tl.load(accumulators + first + k)
        put_sums(sums, at, nine_sums(v, u, tl.where(free, ds, 0.0), w, h, K, HEIGHT), K, ATOMIC)
