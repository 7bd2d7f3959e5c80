"""From splats to what the compositing kernels on the GPU read, and from their sums back to splats: `packing.py` in Triton.

Every thread holds one splat; splats, tangents and totals are in double precision.  A splat's numbers for the kernels are those
of the CPU but for the mean, of which a pixel near by is kept, and the whitened offset from it: an offset between pixels is a
whole number, exact in single precision, so the kernels need no double precision to tell what is left of a needle's v.

    X, Y    the pixel nearest to the mean          U, V    the whitened offset of that pixel from the mean
    CAP     alpha above which derivatives in ln alpha are 0: infinite where the splat cannot reach it
"""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (Triton tells type checkers little of its language)

import triton.language as tl

from splat.backend.gpu.compile import jit, sized, twin, twins
from splat.projection import whitening
from splat.raster import formulas
from splat.raster.cuda.binning import load_splat

PARAMS = 16
X, Y, U, V, ALONG, ACROSS, SHEAR, SHEAR_REST, LO, RED, GREEN, BLUE, CUT, CAP = (tl.constexpr(i) for i in range(14))
TANGENTS = 12
SUMS = 9
FARTHEST = tl.constexpr(2.0**22)  # a pixel farther out is not exact in single precision
# what all pixels share, in double precision
ALPHA_MIN, CONTOUR, LEAST_LOG2_ALPHA, ALPHA_MAX, FREE_CAP, FLOOR = (tl.constexpr(i) for i in range(6))
BACKGROUND = tl.constexpr(6)
FRAME = 9
HALF_LOG2_E = tl.constexpr(whitening.LOG2_E / 2)

whiten = twin(whitening.whitening)
exponent_tangent, first_order, second_order = twins(
    formulas.exponent_tangent, formulas.first_order, formulas.second_order
)


@jit
def nearest(x):
    return tl.minimum(tl.maximum(tl.floor(x + 0.5), -FARTHEST), FARTHEST)


@jit
def load_six(array, at, inside):
    """Six numbers side by side, in double precision."""
    return (
        tl.load(array + at, inside, other=0.0).to(tl.float64),
        tl.load(array + at + 1, inside, other=0.0).to(tl.float64),
        tl.load(array + at + 2, inside, other=0.0).to(tl.float64),
        tl.load(array + at + 3, inside, other=0.0).to(tl.float64),
        tl.load(array + at + 4, inside, other=0.0).to(tl.float64),
        tl.load(array + at + 5, inside, other=0.0).to(tl.float64),
    )


@jit
def store_six(array, at, numbers, inside):
    for j in tl.static_range(6):
        tl.store(array + at + j, numbers[j], inside)


@jit
def copy_colour(target, to, source, at, inside):
    for j in tl.static_range(6, 9):
        tl.store(target + to + j, tl.load(source + at + j, inside, other=0.0), inside)


@sized("n")
def pack_splats(splats, frame, packed, n, BLOCK: tl.constexpr):
    """packed (n, 16) of splats (n, 9)."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    splat = load_splat(splats, i, inside)
    along, across, shear = whiten(splat)
    mx, my = splat[0] - 0.5, splat[1] - 0.5
    x, y = nearest(mx), nearest(my)
    p = packed + i.to(tl.int64) * 16
    tl.store(p + X, x, inside)
    tl.store(p + Y, y, inside)
    tl.store(p + U, along * (x - mx), inside)
    tl.store(p + V, across * (shear * (x - mx) + (y - my)), inside)
    tl.store(p + ALONG, along, inside)
    tl.store(p + ACROSS, across, inside)
    rounded = shear.to(packed.dtype.element_ty)
    tl.store(p + SHEAR, rounded, inside)
    tl.store(p + SHEAR_REST, shear - rounded.to(tl.float64), inside)
    opacity = splat[5]
    level = tl.where(opacity > 0, tl.log2(tl.where(opacity > 0, opacity, 1.0)), float("-inf"))
    contour = tl.load(frame + CONTOUR)
    cut = tl.maximum(tl.load(frame + LEAST_LOG2_ALPHA), level - HALF_LOG2_E * contour * contour)
    cap = tl.load(frame + FREE_CAP)
    tl.store(p + LO, level, inside)
    tl.store(p + CUT, cut, inside)
    tl.store(p + CAP, tl.where(opacity > cap, cap, float("inf")), inside)
    copy_colour(p, RED - 6, splats, i.to(tl.int64) * 9, inside)


@sized("n", "K", "begin", "size")
def pack_tangents(splats, directions, tangents, moved, n, K, begin, size, BLOCK: tl.constexpr):
    """tangents (n, size, 12) of the directions begin, begin + 1, ... of (n, K, 9); a program has one of them.

    moved: (n, size), whether the direction moves the splat.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    splat = load_splat(splats, i, inside)
    k = tl.program_id(1)
    at, to = (i.to(tl.int64) * K + begin + k) * 9, (i.to(tl.int64) * size + k) * 12
    direction = load_six(directions, at, inside)
    store_six(tangents, to, exponent_tangent(whiten(splat), splat[5], direction), inside)
    copy_colour(tangents, to, directions, at, inside)
    some = direction[0] != 0
    for j in tl.static_range(1, 6):
        some = some | (direction[j] != 0)
    for j in tl.static_range(6, 9):
        some = some | (tl.load(directions + at + j, inside, other=0.0) != 0)
    tl.store(moved + i.to(tl.int64) * size + k, some.to(tl.int8), inside)


@sized("n", "K")
def sum_slots(
    first, last, sums, totals, n, K, WIDTH: tl.constexpr, PADDED: tl.constexpr, SLOTS: tl.constexpr, BLOCK: tl.constexpr
):
    """totals (n, K, WIDTH) in double precision of the sums (slots, K, WIDTH): in a fixed order.

    A splat's slots lie side by side and are read SLOTS at a time: a splat in thousands of tiles would have the others wait.  A
    row of threads has a slot's sums, so that it reads whole sectors.  PADDED: WIDTH rounded up to a power of 2.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    ahead, j = tl.arange(0, SLOTS)[None, :, None], tl.arange(0, PADDED)[None, None, :]
    start, stop = tl.load(first + i, i < n, other=0), tl.load(last + i, i < n, other=0)
    k = tl.program_id(1)
    total = tl.zeros((BLOCK, SLOTS, PADDED), tl.float64)
    longest = tl.max(stop - start, 0)
    for s in range(0, longest, SLOTS):
        slot = (start + s)[:, None, None] + ahead
        inside = (slot < stop[:, None, None]) & (j < WIDTH)
        total += tl.load(sums + (slot * K + k) * WIDTH + j, inside, other=0.0).to(tl.float64)
    at, j = (i.to(tl.int64)[:, None] * K + k) * WIDTH, tl.arange(0, PADDED)[None, :]
    tl.store(totals + at + j, tl.sum(total, 1), (i < n)[:, None] & (j < WIDTH))


@sized("n")
def reduce_gradient(splats, totals, gradient, n, BLOCK: tl.constexpr):
    """gradient (n, 9) from totals (n, 9)."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    splat, at = load_splat(splats, i, inside), i.to(tl.int64) * 9
    store_six(gradient, at, first_order(whiten(splat), splat[5], load_six(totals, at, inside)), inside)
    copy_colour(gradient, at, totals, at, inside)


@sized("n", "K", "begin", "size")
def reduce_curvature(splats, directions, moments, totals, product, n, K, begin, size, BLOCK: tl.constexpr):
    """product (n, K, 9) along the directions begin, begin + 1, ... from totals (n, size, 9); moments: the gradient's totals."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    splat = load_splat(splats, i, inside)
    k = tl.program_id(1)
    at, source = (i.to(tl.int64) * K + begin + k) * 9, (i.to(tl.int64) * size + k) * 9
    y, total = load_six(directions, at, inside), load_six(totals, source, inside)
    moment = load_six(moments, i.to(tl.int64) * 9, inside)
    store_six(product, at, second_order(whiten(splat), splat[5], y, moment, total), inside)
    copy_colour(product, at, totals, source, inside)
