"""Every splat's own block of the Hessian on the GPU: `blocks.py`, whose glossary and formulas hold here."""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (Triton tells type checkers little of its language)

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from splat.backend.gpu.compile import jit, reciprocal, twins
from splat.projection.whitening import LEAST_RATIO, LOG2_E, ROUND, plain_adjoint
from splat.raster import formulas
from splat.raster.cuda.compositing import (
    alpha_row,
    any_lit,
    clear_slots,
    exponent_terms,
    load3,
    load_background,
    load_planes,
    pixels_of,
)
from splat.raster.cuda.packing import ALPHA_MAX, CAP, RED

step_block, cross_terms = twins(formulas.step_block, formulas.cross_terms)
BLOCK_SUMS = formulas.BLOCK_SUMS
PADDED = 64
CROSS, COLOUR, DEGREE2 = tl.constexpr(formulas.CROSS), tl.constexpr(formulas.COLOUR), tl.constexpr(formulas.DEGREE2)


@jit
def powers_of_columns(total, j, place, rows, u, degree: tl.constexpr):
    """The moments to a degree, to their places of `total`, from the sums over rows of a weight times v^k."""
    for b in tl.static_range(degree + 1):
        column = rows[b]
        for a in tl.static_range(degree + 1 - b):
            total = tl.where(j == place + b * (degree + 1) - b * (b - 1) // 2 + a, tl.sum(column, 1)[:, None], total)
            column = column * u
    return total


@jit
def block_moments(
    order, start, reached, splat_of, slots, packed, frame, transmittance, stop, gradient, curvature, sums, columns, width,
    height, WIDTH: tl.constexpr, HEIGHT: tl.constexpr, ATOMIC: tl.constexpr,
):  # fmt: skip
    """The 36 sums of every entry or, added up, of every splat.  gradient: g, 4 planes; curvature: h, 3 planes."""
    real: tl.constexpr = packed.dtype.element_ty
    tile = tl.load(order + tl.program_id(0))
    x0, y0, x, y, p, inside = pixels_of(tile, columns, width, height, WIDTH, HEIGHT)
    x0, y0, x, y = x0.to(real), y0.to(real), x.to(real), y.to(real)
    cap, size = tl.load(frame + ALPHA_MAX).to(real), width * height
    first, count = tl.load(start + tile), tl.load(reached + tile)
    stopped = tl.load(stop + p, inside, other=0)
    T, g = tl.load(transmittance + p, inside, other=1.0), load_planes(gradient, p, size, inside)
    h0 = tl.load(curvature + p, inside, other=0.0)
    h1 = tl.load(curvature + size + p, inside, other=0.0)
    h2 = tl.load(curvature + 2 * size + p, inside, other=0.0)
    background = load_background(frame, real)
    R0, R1, R2 = T * background[0], T * background[1], T * background[2]
    if not (any_lit(g) | any_lit((h0, h1, h2, h2))):
        if not ATOMIC:
            clear_slots(slots, first, count, sums, 36)
        count = 0
    for back in range(0, count):
        k = count - 1 - back
        s_index = tl.load(splat_of + first + k)
        splat = packed + s_index.to(tl.int64) * 16
        u, v, terms = exponent_terms(splat, x0, y0, x, y)
        alpha, uncapped = alpha_row(v, terms, k < stopped, cap)
        r = reciprocal(1.0 - alpha)
        T = T * r
        w = alpha * T
        below = uncapped <= tl.load(splat + CAP)
        free, beta = tl.where(below, w, 0.0), tl.where(below, alpha * r, 0.0)
        D, R, weight = step_block(w, free, beta, (R0, R1, R2), g, (h0, h1, h2), load3(splat, RED))
        R0, R1, R2 = R
        total = block_sums(u, v, w, free, D, weight, g, (h0, h1, h2))
        at = (s_index if ATOMIC else tl.load(slots + first + k)).to(tl.int64) * 36
        j = tl.arange(0, 64)[None, :]
        if ATOMIC:
            tl.atomic_add(sums + at + j, total, j < 36, sem="relaxed")
        else:
            tl.store(sums + at + j, total, j < 36)


@jit
def block_sums(u, v, w, free, D, weight, g, h):
    """The 36 sums over a tile, (1, 64) with zeros after them."""
    j, u, vv = tl.arange(0, 64)[None, :], tl.sum(u, 1), v * v
    rows = (
        tl.sum(weight, 1),
        tl.sum(weight * v, 1),
        tl.sum(weight * vv, 1),
        tl.sum(weight * vv * v, 1),
        tl.sum(weight * vv * vv, 1),
    )
    total = powers_of_columns(tl.zeros((1, 64), u.dtype), j, 0, rows, u, 4)
    for c in tl.static_range(3):
        cross, square = cross_terms(w, free, D[c], g[c], h[c])
        rows = (tl.sum(cross, 1), tl.sum(cross * v, 1), tl.sum(cross * vv, 1))
        total = powers_of_columns(total, j, CROSS + DEGREE2 * c, rows, u, 2)
        total = tl.where(j == COLOUR + c, tl.sum(tl.sum(square, 1), 1)[:, None], total)
    return total


def gaussian_blocks(
    splats: Float[Tensor, "m 9"], total: Float[Tensor, "m 36"], S: Float[Tensor, "m 3"]
) -> Float[Tensor, "m 9 9"]:
    """`blocks.splat_block` of every splat, in plain coordinates; S: its moments S, Su, Sv, 0 for the Gauss-Newton part."""
    inverse = 1 / splats[:, 5].clamp_min(formulas.TINY)
    first = ((1, 0, ROUND), (0, 1, ROUND), (2, 0, -0.5), (1, 1, -1.0), (0, 2, -0.5), (0, 0, inverse))
    block = splats.new_zeros(len(splats), 9, 9)
    for p, (j, k, factor) in enumerate(first):
        for q, (j2, k2, factor2) in enumerate(first):
            block[:, p, q] = factor * (factor2 * total[:, formulas.MOMENT[j + j2, k + k2]])
        for c in range(3):
            cross = factor * total[:, formulas.CROSS + formulas.DEGREE2 * c + formulas.MOMENT2[j, k]]
            block[:, 6 + c, p] = block[:, p, 6 + c] = cross
    for c in range(3):
        block[:, 6 + c, 6 + c] = total[:, formulas.COLOUR + c]
    for p, q, moment in ((0, 2, 1), (0, 3, 2), (1, 3, 1), (1, 4, 2)):  # sum s d2q
        block[:, p, q] += S[:, moment]
        block[:, q, p] += S[:, moment]
    block[:, 0, 0] -= S[:, 0] * ROUND
    block[:, 1, 1] -= S[:, 0] * ROUND
    block[:, 5, 5] = inverse * (inverse * (total[:, 0] - S[:, 0]))
    return _plain(splats, _plain(splats, block).mT.contiguous())


def _plain(splats: Float[Tensor, "m 9"], block: Float[Tensor, "m 9 9"]) -> Float[Tensor, "m 9 9"]:
    """The adjoints in a splat's numbers, column by column, in plain coordinates: W as `whitening.whitening` has it."""
    a, b, c = splats[:, 2:5, None].unbind(1)
    c = torch.where(c > 0, c, 1.0)  # where a splat is not drawn its block is 0, whatever W
    shear = b / c
    along = (LOG2_E / 2 * torch.maximum(a - b * shear, LEAST_RATIO * a)).sqrt()
    along = torch.where(along > 0, along, 1.0)
    rows = plain_adjoint.py_func((along, (LOG2_E / 2 * c).sqrt(), shear), block[:, :5].unbind(1))
    return torch.cat([torch.stack(rows, 1), block[:, 5:]], 1)
