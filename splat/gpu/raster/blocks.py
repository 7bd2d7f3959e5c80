"""Every splat's diagonal block of the Hessian, on the GPU: `render/cpu/blocks.py`, whose glossary and formulas hold here."""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (Triton tells type checkers little of its language)

import torch
import triton.language as tl
from jaxtyping import Float, Float64
from torch import Tensor

from splat.gpu.language.compile import jit
from splat.gpu.language.formula import triton_formula
from splat.gpu.raster.compositing import (
    alpha_row,
    any_lit,
    clear_sums,
    exponent_terms,
    load3,
    load_background,
    load_planes,
    tile_of,
)
from splat.gpu.raster.packing import ALPHA_MAX, CAP, RED
from splat.render import formulas

step_block, cross_terms = triton_formula(formulas.step_block), triton_formula(formulas.cross_terms)
reciprocal = triton_formula(formulas.reciprocal)
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
    order, start, reached, splat_of, accumulators, packed, frame, transmittance, stop, v_planes, curvature, sums, columns,
    width, height, WIDTH: tl.constexpr, HEIGHT: tl.constexpr, ATOMIC: tl.constexpr,
):  # fmt: skip
    """The 36 sums of every intersection or, added up, of every splat.  v_planes: g, 4 planes; curvature: h, 3 planes."""
    real: tl.constexpr = packed.dtype.element_ty
    tile, place, p, inside = tile_of(order, columns, width, height, real, WIDTH, HEIGHT)
    cap, size = tl.load(frame + ALPHA_MAX).to(real), width * height
    first, count = tl.load(start + tile), tl.load(reached + tile)
    stopped = tl.load(stop + p, inside, other=0)
    T, g = tl.load(transmittance + p, inside, other=1.0), load_planes(v_planes, p, size, inside)
    h, background = load_planes(curvature, p, size, inside, 3), load_background(frame, real)
    R = (T * background[0], T * background[1], T * background[2])
    if not (any_lit(g) | any_lit((h[0], h[1], h[2], h[2]))):
        if not ATOMIC:
            clear_sums(accumulators, first, count, sums, 36)
        count = 0
    for back in range(0, count):
        k = count - 1 - back
        s_index = tl.load(splat_of + first + k)
        splat = packed + s_index.to(tl.int64) * 16
        u, v, terms = exponent_terms(splat, place)
        alpha, uncapped = alpha_row(v, terms, k < stopped, cap)
        r = reciprocal(1.0 - alpha)
        T = T * r
        w = alpha * T
        below = uncapped <= tl.load(splat + CAP)
        free, beta = tl.where(below, w, 0.0), tl.where(below, alpha * r, 0.0)
        D, R, weight = step_block(w, free, beta, R, g, h, load3(splat, RED))
        total = block_sums(u, v, w, free, D, weight, g, h)
        at = (s_index if ATOMIC else tl.load(accumulators + first + k)).to(tl.int64) * 36
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
    total: Float[Tensor, "m 36"], moments: Float[Tensor, "m 9"], second_order: bool
) -> Float64[Tensor, "m 9 9"]:
    """The diagonal blocks of splats over coefficients and colour, from their sums; moments: the gradient's."""
    index = torch.from_numpy(formulas.BLOCK_INDEX).to(total.device, non_blocking=True)
    blocks = torch.nn.functional.pad(total.double(), (0, 1))[:, index]
    if second_order:
        factors = torch.from_numpy(formulas.D2Q).to(total.device, non_blocking=True)
        blocks += torch.einsum("mj,jpq->mpq", moments[:, :3].double(), factors)
    return blocks
