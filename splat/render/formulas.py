"""Formulas shared by the compositing kernels of Numba and of Triton: one splat in one pixel, at first and second order.

A prime marks a tangent (in code: d..), v_ a cotangent.  Per pixel, splats in order of depth, with the pixel's offset from the
mean in the splat's whitened coordinates (u, v) (`projection/whitening.py`), opacity o, colour c, transmittance T in front of
the splat:

    l = log2 o - u^2 - v^2      alpha = min(cap, 2^l)
    active where l >= cut (from alpha_min and contour) and the pixel has not stopped; else alpha = 0, and no update below acts.
    It stops in front of the splat that would bring T below floor.

`forward`           w = alpha T;  image += w c;  T <- T - w;  at the end image += T background, alpha plane = 1 - T.

`backward`          given v_image = dloss/dimage and, for the alpha plane, v_alpha.  Back to front; at first T is the
                    final T, and R, the sum of w_j (v_image . c_j) over the splats behind with the background's part, is
                    T (v_image . background - v_alpha):
                    r = 1 / (1 - alpha);  T <- T r;  w = alpha T;  beta = alpha r;  e = v_image . c
                    s = w e - beta R, the derivative in q = ln alpha, 0 where 2^l > free;  R <- R + w e
                    per splat: moments S, Su, Sv, Suu, Suv, Svv of s over the offsets, and G = sum w v_image.

`tangent`           (J u) given tangents of the splats; q' is one quadratic in the offset, 0 where 2^l > free (`Thresholds`):
                    w' = w q' + alpha T';  image' += w' c + w c';  T' <- T' - w';  at the end image' += T' background, and the
                    alpha plane' = -T'.

`backward_tangent`  given q', c' and v_image'.  With tau = T' / T, r, w, beta, R as above:
                    behind all splats R' = (T (v_image . background - v_alpha))'
                    tau <- tau + beta q';  nu = q' + tau;  h = nu v_image + v_image';  z = w (h . c + v_image . c')
                    s' = z - beta (R' + r R q'), 0 where 2^l > free;  R' <- R' + z;  moments of s' and G' = sum w h.
"""

from math import ceil, floor, inf, log2
from typing import NamedTuple

import numpy as np
import torch

from splat.backend.cpu.dual import sqrt
from splat.backend.cpu.exponential import exp2, log
from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import fma, minimum, select
from splat.model.settings import RenderSettings
from splat.projection.whitening import Q0, QU, QUU, QUV, QV, QVV, ROUND

SPLAT = 9  # numbers of a splat, of its tangent (six coefficients of q', colour'), and of its adjoint (six moments, G)
WIDEN = 1e-4  # widening of an ellipse's level, relative and absolute, so that no active pixel is missed

# The sums that make a splat's diagonal block; g, h, the first and second derivatives of the image's loss, and D = dI / dq as
# in `render/cpu/blocks.py`.  Moments of its q q term to degree 4; from CROSS, for each channel c, moments of w g_c + w h_c D_c
# to degree 2; from COLOUR, for each channel, the sum of w^2 h_c.
DEGREE4, DEGREE2 = 15, 6  # numbers of moments u^j v^k with j + k at most 4, and at most 2
CROSS, COLOUR = DEGREE4, DEGREE4 + 3 * DEGREE2
BLOCK_SUMS = COLOUR + 3

LEAST_TRANSMITTANCE = {torch.float32: 1e-30, torch.float64: 1e-290}  # a pixel stops here, before T underflows
LEAST_LOG2_ALPHA = {torch.float32: -126.0, torch.float64: -1022.0}  # the range of exp2


class Thresholds(NamedTuple):
    """Thresholds at which a splat is drawn and a pixel stops.

    alpha_min, alpha_max: bounds of alpha.  contour: largest distance from the mean, in standard deviations, or infinity.
    least: smallest log2 alpha.  free: 2^l above which derivatives in ln alpha are 0, or infinity.  floor: transmittance below
    which a pixel stops.
    """

    alpha_min: float
    contour: float
    least: float
    alpha_max: float
    free: float
    floor: float


def thresholds_of(settings: RenderSettings, dtype: torch.dtype) -> Thresholds:
    """The thresholds for pixels of dtype.

    With transmittance_min = 0 a pixel still stops at LEAST_TRANSMITTANCE, an error of the image far beneath round-off.
    """
    least = max(log2(settings.alpha_min) if settings.alpha_min else -inf, LEAST_LOG2_ALPHA[dtype])
    contour = inf if settings.contour_sigma is None else settings.contour_sigma
    free = inf if settings.gradient_through_cap else settings.alpha_max
    floor = max(settings.floor(dtype), LEAST_TRANSMITTANCE[dtype])
    return Thresholds(settings.alpha_min, contour, least, settings.alpha_max, free, floor)


# --- one splat in one pixel -------------------------------------------------------------------------------------------


@formula
def reciprocal(x):
    return 1.0 / x


@formula
def alpha_row(v, terms, running, cap):
    """alpha of a row of pixels, and 2^l, its value before the cap; running: mask of the pixels that have not stopped, or None.

    terms: v of row 0, its step per row, log2 o - u^2, cut.  An explicit fma gives l the same rounding in every kernel, so that
    all kernels agree on which pixels are active.
    """
    l = fma(-v, v, terms[2])
    uncapped, active = exp2(l), l >= terms[3]
    if running is not None:
        active = active & running
    return select(active, minimum(uncapped, cap), 0.0), uncapped


@formula
def along_row(q, u):
    """(A, B, C) of q' = A + v (B + v C) at the column offset u, from its six coefficients q."""
    return u * (u * q[QUU] + q[QU]) + q[Q0], u * q[QUV] + q[QV], q[QVV]


@formula
def quadratic(v, terms):
    """A + v (B + v C) for terms = (A, B, C)."""
    return terms[0] + v * (terms[1] + v * terms[2])


@formula
def dot(x, y):
    return x[0] * y[0] + (x[1] * y[1] + x[2] * y[2])


@formula
def dot_plus(x, y, z):
    """x . y + z, as a chain of fused multiply-adds."""
    return x[0] * y[0] + (x[1] * y[1] + (x[2] * y[2] + z))


@formula
def plus(x, y, c):
    """x + y c, for colours x and c."""
    return x[0] + y * c[0], x[1] + y * c[1], x[2] + y * c[2]


@formula
def behind_all(v_pixel, background):
    """Factor of the final transmittance in the loss: v_image . background - v_alpha."""
    return v_pixel[0] * background[0] + v_pixel[1] * background[1] + v_pixel[2] * background[2] - v_pixel[3]


@formula
def step_back(alpha, T, R, v_image, colour):
    """T and R in front of a splat, given those behind it; its w, beta, r and w e."""
    r = reciprocal(1.0 - alpha)
    T = T * r
    w = alpha * T
    we = w * dot(v_image, colour)
    return T, R + we, w, alpha * r, r, we


@formula
def step_tangent(dT, dimage, alpha, w, w_dq, colour, dcolour):
    """w' = w q' + alpha T';  T' <- T' - w';  image' += w c' + w' c."""
    dw = w_dq + alpha * dT
    return dT - dw, plus(plus(dimage, w, dcolour), dw, colour)


@formula
def step_backward_tangent(tau, dR, dv_image, w, beta, rR, dq, v_image, colour, dcolour):
    """tau and R' after a splat, its s' where the cap does not hold, and h."""
    tau = tau + beta * dq
    h = plus(dv_image, dq + tau, v_image)
    z = w * dot_plus(h, colour, dot(v_image, dcolour))
    return tau, dR + z, z - beta * (rR * dq + dR), h


@formula
def row_terms(v, s, w, h):
    """A row's terms s, s v, s v^2 and w h of the sums over rows, which each column has for itself."""
    sv = s * v
    return s, sv, sv * v, w * h[0], w * h[1], w * h[2]


@formula
def column_terms(columns, u):
    """Each column's part of a splat's nine sums, from the column's sums over rows."""
    S, Sv, Svv, G0, G1, G2 = columns
    Su = S * u
    return S, Su, Sv, Su * u, Sv * u, Svv, G0, G1, G2


# --- a splat's sums ---------------------------------------------------------------------------------------------------


@formula
def second_order(q, moments, total):
    """Tangent of a splat's adjoint along the coefficients q, as six moments at the old whitening W and opacity o.

    moments: of s; total: moments of s' at fixed offsets.  The other terms: the offset d moves with the mean; and the gradients
    sum s Q d of the mean and S / o of o change with Q and o.
    """
    S, Su, Sv = moments[0], moments[1], moments[2]
    u, v = q[QU] / ROUND, q[QV] / ROUND
    return (
        total[0] - q[Q0] * S,
        total[1] - u * S - (2 * q[QUU] * Su + q[QUV] * Sv) / ROUND,
        total[2] - v * S - (q[QUV] * Su + 2 * q[QVV] * Sv) / ROUND,
        total[3] - 2 * u * Su,
        total[4] - u * Sv - v * Su,
        total[5] - 2 * v * Sv,
    )


# --- the pixels that a splat reaches ----------------------------------------------------------------------------------


@formula
def ellipse_of(splat, alpha_min, contour):
    """Half-extents (px) in x and y of the ellipse in which a splat is drawn, its level and the conic's determinant.

    level: bound of d . Q d for offsets d from the mean, slightly widened; 0 where the splat is drawn nowhere.
    """
    a, b, c, opacity = splat[2], splat[3], splat[4], splat[5]
    drawn = (opacity >= alpha_min) & (opacity > 0)
    level = min(contour * contour, 2 * log(select(drawn, opacity, 1.0) / alpha_min))
    level = level * (1 + WIDEN) + WIDEN
    det = a * c - b * b
    flat = det <= 0  # by rounding
    level = select((level == inf) | flat, inf, level)
    level, det = select(drawn, level, 0.0), select(flat, 1.0, det)
    bounded = level < inf
    return select(bounded, sqrt(level * c / det), inf), select(bounded, sqrt(level * a / det), inf), level, det


@formula
def pixels_within(centre, reach, size):
    """First and last pixel index within reach of centre (in pixel indices), clipped to the image; empty if first > last.

    Whole numbers; integers from floats on the CPU, floats from vectors and Triton's tensors.
    """
    return ceil(min(max(centre - reach, 0.0), size * 1.0)), floor(max(min(centre + reach, size - 1.0), -1.0))


@formula
def rows_in_strip(splat, level, det, ey, left, right):
    """Lowest and highest y, relative to the mean, of a bounded ellipse in the strip left <= x <= right (relative too)."""
    b, c = splat[3], splat[4]
    x_top = -b * ey / splat[2]  # where the ellipse is highest; it is lowest at -x_top
    x, r = min(max(x_top, left), right), reciprocal(c)
    high = (sqrt(max(0.0, c * level - det * x * x)) - b * x) * r
    x = min(max(-x_top, left), right)
    low = (sqrt(max(0.0, c * level - det * x * x)) + b * x) * -r
    return low, high


@formula
def rows_of_strip(splat, ellipse, column, tile, width, height):
    """First and last pixel row of a splat's ellipse in a column of tiles, `tile` pixels wide; empty if first > last."""
    ex, ey, level, det = ellipse
    mx, my = splat[0] - 0.5, splat[1] - 0.5
    x0, x1 = pixels_within(mx, ex, width)
    left, right = max(column * tile, x0) - mx, min(column * tile + tile - 1, x1) - mx
    low, high = rows_in_strip(splat, level, det, ey, left, right)
    bounded = level < inf
    return pixels_within(select(bounded, my + (low + high) / 2, my), select(bounded, (high - low) / 2, inf), height)


@formula
def box_of(splat, ellipse, width, height):
    """First and last pixel column and row of the box of a splat's ellipse; empty if a first > its last."""
    ex, ey, level, _det = ellipse
    x0, x1 = pixels_within(splat[0] - 0.5, ex, width)
    y0, y1 = pixels_within(splat[1] - 0.5, ey, height)
    return x0, select(level > 0, x1, x0 - 1), y0, y1


# --- a splat's diagonal block of the Hessian --------------------------------------------------------------------------


def _moment_index(degree: int) -> np.ndarray:
    """Place [j, k] of the moment of u^j v^k among those to a degree, in the order of `store_powers`: 1, u, ..., v, u v, ..."""
    index, powers = np.full((degree + 1, degree + 1), -1), range(degree + 1)
    for place, (j, k) in enumerate((j, k) for k in powers for j in powers if j + k <= degree):
        index[j, k] = place
    return index


def _block_index() -> np.ndarray:
    """Place of each entry of a splat's diagonal block (9, 9) among its BLOCK_SUMS sums; the place BLOCK_SUMS stands for 0.

    Rows and columns: the coefficients Q0, QU, ..., then the three channels of the colour.
    """
    powers = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # of u and v, in the order Q0, QU, QV, QUU, QUV, QVV
    degree4, degree2 = _moment_index(4), _moment_index(2)
    index = np.full((9, 9), BLOCK_SUMS, np.int64)
    for p, (j, k) in enumerate(powers):
        for r, (j2, k2) in enumerate(powers):
            index[p, r] = degree4[j + j2, k + k2]
        for c in range(3):
            index[6 + c, p] = index[p, 6 + c] = CROSS + DEGREE2 * c + degree2[j, k]
    for c in range(3):
        index[6 + c, 6 + c] = COLOUR + c
    return index


def _d2q() -> np.ndarray:
    """Factors (3, 9, 9) of the moments S, Su, Sv in sum s d2q, the curvature of q in its coefficients (`second_order`)."""
    factors = np.zeros((3, 9, 9))
    terms = (
        (0, Q0, Q0, -1.0), (0, QU, QU, -1 / ROUND), (0, QV, QV, -1 / ROUND), (1, QU, QUU, -2 / ROUND),
        (2, QU, QUV, -1 / ROUND), (1, QV, QUV, -1 / ROUND), (2, QV, QVV, -2 / ROUND),
    )  # fmt: skip
    for moment, p, r, factor in terms:
        factors[moment, p, r] = factors[moment, r, p] = factor
    return factors


BLOCK_INDEX, D2Q = _block_index(), _d2q()


@formula
def colour_slopes(free, beta, R, colour):
    """D_c = dI_c / dq of the three channels; free, beta: w and beta where the cap does not hold, else 0; R: colour behind."""
    return free * colour[0] - beta * R[0], free * colour[1] - beta * R[1], free * colour[2] - beta * R[2]


@formula
def step_block(w, free, beta, R, g, h, colour):
    """D (three channels), the colour R in front of the splat, and its q q term; g, h: dl/dI and the diagonal of l''."""
    D = colour_slopes(free, beta, R, colour)
    weight = D[0] * (g[0] + h[0] * D[0]) + D[1] * (g[1] + h[1] * D[1]) + D[2] * (g[2] + h[2] * D[2])
    return D, plus(R, w, colour), weight


@formula
def cross_terms(w, free, D, g, h):
    """w g_c + w h_c D_c and w^2 h_c of a channel c."""
    wh = w * h
    return free * g + wh * D, w * wh
