"""Packing of splats for the compositing kernels on the GPU, and reduction of their sums back to splats.

Every thread holds one splat, in double precision.  A splat's numbers for the kernels are those of the CPU but for the mean, of
which a pixel near by is kept, and the whitened offset from it: an offset between pixels is a whole number, exact in single
precision, so the kernels need no double precision to tell what is left of a needle's v.

    X, Y    the pixel nearest to the mean          U, V    the whitened offset from the mean to it
    CAP     alpha above which derivatives in ln alpha are 0: infinite where the splat cannot reach it
"""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (Triton tells type checkers little of its language)

import triton.language as tl

from splat.gpu.language.compile import jit, sized
from splat.gpu.language.formula import triton_formula
from splat.gpu.raster.binning import load_six, load_splat
from splat.projection import whitening
from splat.render import formulas

PARAMS = 16
X, Y, U, V, ALONG, ACROSS, SHEAR, SHEAR_REST, LO, RED, GREEN, BLUE, CUT, CAP = (tl.constexpr(i) for i in range(14))
FARTHEST = tl.constexpr(2.0**22)  # a pixel farther out is not exact in single precision
# what all pixels share, in double precision: `formulas.Thresholds`, and the background
CONTOUR, LEAST, ALPHA_MAX, FREE, FLOOR, BACKGROUND = (tl.constexpr(i) for i in range(1, 7))
HALF_LOG2_E = tl.constexpr(whitening.LOG2_E / 2)

whiten, second_order = triton_formula(whitening.whitening), triton_formula(formulas.second_order)


@jit
def nearest(x):
    return tl.minimum(tl.maximum(tl.floor(x + 0.5), -FARTHEST), FARTHEST)


@jit
def load_double(array, at, inside):
    """Six numbers side by side, in double precision."""
    found, six = (), load_six(array, at, inside)
    for j in tl.static_range(6):
        found = found + (six[j].to(tl.float64),)
    return found


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
    cut = tl.maximum(tl.load(frame + LEAST), level - HALF_LOG2_E * contour * contour)
    cap = tl.load(frame + FREE)
    tl.store(p + LO, level, inside)
    tl.store(p + CUT, cut, inside)
    tl.store(p + CAP, tl.where(opacity > cap, cap, float("inf")), inside)
    copy_colour(p, RED - 6, splats, i.to(tl.int64) * 9, inside)


@sized("n", "K")
def reduce_sums(
    first,
    last,
    sums,
    totals,
    n,
    K,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TOGETHER: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """totals (n, K, WIDTH) in double precision of the sums (accumulators, K, WIDTH): in a fixed order.

    A splat's accumulators lie side by side and are read TOGETHER at a time: a splat in thousands of tiles would have the others
    wait.  A row of threads has the sums of one, so that it reads whole sectors.  PADDED: WIDTH rounded up to a power of 2.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    ahead, j = tl.arange(0, TOGETHER)[None, :, None], tl.arange(0, PADDED)[None, None, :]
    start, stop = tl.load(first + i, i < n, other=0), tl.load(last + i, i < n, other=0)
    k = tl.program_id(1)
    total = tl.zeros((BLOCK, TOGETHER, PADDED), tl.float64)
    longest = tl.max(stop - start, 0)
    for s in range(0, longest, TOGETHER):
        place = (start + s)[:, None, None] + ahead
        inside = (place < stop[:, None, None]) & (j < WIDTH)
        total += tl.load(sums + (place * K + k) * WIDTH + j, inside, other=0.0).to(tl.float64)
    at, j = (i.to(tl.int64)[:, None] * K + k) * WIDTH, tl.arange(0, PADDED)[None, :]
    tl.store(totals + at + j, tl.sum(total, 1), (i < n)[:, None] & (j < WIDTH))


@sized("n", "K", "begin", "size")
def reduce_tangents(tangents, moments, totals, product, n, K, begin, size, BLOCK: tl.constexpr):
    """product (n, K, 9) along the tangents begin, begin + 1, ... of (n, K, 9) from totals (n, size, 9).

    moments: (n, 9), the adjoints.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    k = tl.program_id(1)
    at, source = (i.to(tl.int64) * K + begin + k) * 9, (i.to(tl.int64) * size + k) * 9
    q, total = load_double(tangents, at, inside), load_double(totals, source, inside)
    found = second_order(q, load_double(moments, i.to(tl.int64) * 9, inside), total)
    for j in tl.static_range(6):
        tl.store(product + at + j, found[j], inside)
    copy_colour(product, at, totals, source, inside)
