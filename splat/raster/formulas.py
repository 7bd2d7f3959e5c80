"""The formulas that the compositing kernels of both compilers share: one splat in one pixel, at first and second order.

Per pixel, splats in order of depth, with the pixel's offset from the mean in the splat's whitened coordinates (u, v)
(`projection/whitening.py`), opacity o, colour c, transmittance T in front of the splat:

    l = log2 alpha = log2 o - u^2 - v^2      alpha = min(cap, 2^l)
    active where l >= cut and the pixel has not stopped; elsewhere alpha = 0 and every update below is a no-op

`forward`           w = alpha T;  image += w c;  T <- T - w;  at the end image += T background, alpha plane = 1 - T.

`backward`          given v_image = dloss/dimage and, for the alpha plane, v_alpha.  Back to front, T starts at the final T
                    and R, the sum over the splats behind of w_j (v_image . c_j) plus the background's part, at
                    T (v_image . background - v_alpha):
                    r = 1 / (1 - alpha);  T <- T r;  w = alpha T;  beta = alpha r;  e = v_image . c
                    s = w e - beta R, the derivative in q = ln alpha, 0 where the cap holds;  R <- R + w e
                    per splat: moments S, Su, Sv, Suu, Suv, Svv of s over the offsets, and G = sum w v_image.

`tangent`           (J u) given tangents of the splats; q' is one quadratic in the offset, 0 where the cap holds:
                    w' = w q' + alpha T';  image' += w' c + w c';  T' <- T' - w';  at the end image' += T' background.

`backward_tangent`  given q', c' and v_image'.  With tau = T' / T, r, w, beta, R as above:
                    tau <- tau + beta q';  nu = q' + tau;  h = nu v_image + v_image';  z = w (h . c + v_image . c')
                    s' = z - beta (R' + r R q'), 0 where the cap holds;  R' <- R' + z;  moments of s' and G' = sum w h.

A dash marks a tangent, v_ a cotangent.  K tangents share the primal quantities of a splat.
"""

from math import ceil, floor, inf, log, log2, sqrt
from typing import NamedTuple

import numpy as np
import torch

from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import exp2, fma, minimum, select
from splat.model.settings import RenderSettings
from splat.projection.whitening import Q0, QU, QUU, QUV, QV, QVV, ROUND

SPLAT = 9  # numbers of a splat, of its tangent (six coefficients of q', colour'), and of its adjoint (six moments, G)
WIDEN = 1e-4  # relative widening of an ellipse's level, so that no active pixel is missed
DEGREE4, DEGREE2 = 15, 6  # how many moments u^j v^k there are up to these degrees
CROSS = DEGREE4  # after the moments of s + v: those of w g_c + w h_c D_c, and the sums of w^2 h_c
COLOUR = DEGREE4 + 3 * DEGREE2
BLOCK_SUMS = COLOUR + 3

LEAST_TRANSMITTANCE = {torch.float32: 1e-30, torch.float64: 1e-290}  # beneath it T would underflow
LEAST_LOG2_ALPHA = {torch.float32: -126.0, torch.float64: -1022.0}  # the range of exp2


class Thresholds(NamedTuple):
    """Thresholds at which a splat is drawn and a pixel stops.

    alpha_min, alpha_max: bounds of alpha; contour: of the distance in standard deviations, or infinite; least: of log2 alpha;
    free: alpha above which derivatives in ln alpha are 0, or infinite; floor: of the transmittance.
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
    """alpha of a row and 2^l before the cap; running: the mask of the pixels that have not stopped.

    l decides, so it is rounded alike in every kernel: fma.
    """
    l = fma(-v, v, terms[2])
    uncapped = exp2(l)
    return select((l >= terms[3]) & running, minimum(uncapped, cap), 0.0), uncapped


@formula
def along_row(q, u):
    """q' = A + v (B + v C) as (A, B, C), from its six coefficients."""
    return u * (u * q[QUU] + q[QU]) + q[Q0], u * q[QUV] + q[QV], q[QVV]


@formula
def quadratic(v, terms):
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
    """A splat undone: T, R in front of it, and its w, beta, r, w e."""
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
    """Terms of a row in its columns' sums."""
    sv = s * v
    return s, sv, sv * v, w * h[0], w * h[1], w * h[2]


@formula
def column_terms(columns, u):
    """The nine sums' parts of each column, from its sums over rows."""
    S, Sv, Svv, G0, G1, G2 = columns
    Su = S * u
    return S, Su, Sv, Su * u, Sv * u, Svv, G0, G1, G2


# --- a splat's sums ---------------------------------------------------------------------------------------------------


@formula
def second_order(q, moments, total):
    """The tangent of a splat's six moments along the coefficients q, as the splat itself moves.

    moments: those of the gradient, over offsets from the splat; total: of s' over the offsets from where it was.
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
    """Half-extents of a splat's ellipse and its widened level; a level of 0 where it is nowhere drawn."""
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
    """First and last pixel index whose centre lies within reach, clipped to the image; empty if first > last."""
    first = ceil(min(max(centre - reach, 0.0), size))
    last = floor(max(min(centre + reach, size - 1.0), -1.0))
    return int(first), int(last)


@formula
def rows_in_strip(splat, level, det, ey, left, right):
    """Lowest and highest y, relative to the mean, of a bounded ellipse in the strip left <= x <= right (relative too)."""
    b, c = splat[3], splat[4]
    x_top = -b * ey / splat[2]  # where the ellipse is highest; it is lowest at -x_top
    x = min(max(x_top, left), right)
    high = (-b * x + sqrt(max(0.0, c * level - det * x * x))) / c
    x = min(max(-x_top, left), right)
    low = (-b * x - sqrt(max(0.0, c * level - det * x * x))) / c
    return low, high


@formula
def rows_of_strip(splat, ellipse, column, tile, width, height):
    """First and last pixel row of a splat's ellipse in a column of tiles; empty if first > last."""
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


def _moment_index() -> np.ndarray:
    """Index of the moment of u^j v^k among the fifteen, by [j, k]: powers of v outermost, as `store_powers` leaves them."""
    index = np.full((5, 5), -1, np.int64)
    place = 0
    for k in range(5):
        for j in range(5 - k):
            index[j, k] = place
            place += 1
    return index


MOMENT = _moment_index()
MOMENT2 = np.array([[0, 3, 5], [1, 4, -1], [2, -1, -1]])  # of the six of degree 2, stored alike: 1, u, u^2, v, u v, v^2


def _block_index() -> np.ndarray:
    """Index of a splat's sum for each entry of its diagonal block, (9, 9) over coefficients and colour; BLOCK_SUMS: 0."""
    powers = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # of u and v in q', by Q0, QU, ...
    index = np.full((9, 9), BLOCK_SUMS, np.int64)
    for p, (j, k) in enumerate(powers):
        for r, (j2, k2) in enumerate(powers):
            index[p, r] = MOMENT[j + j2, k + k2]
        for c in range(3):
            index[6 + c, p] = index[p, 6 + c] = CROSS + DEGREE2 * c + MOMENT2[j, k]
    for c in range(3):
        index[6 + c, 6 + c] = COLOUR + c
    return index


def _bends() -> np.ndarray:
    """sum s d2q of a splat, (3, 9, 9) over its coefficients: factors of its moments S, Su, Sv (`second_order`)."""
    bends = np.zeros((3, 9, 9))
    terms = (
        (0, Q0, Q0, -1.0), (0, QU, QU, -1 / ROUND), (0, QV, QV, -1 / ROUND), (1, QU, QUU, -2 / ROUND),
        (2, QU, QUV, -1 / ROUND), (1, QV, QUV, -1 / ROUND), (2, QV, QVV, -2 / ROUND),
    )  # fmt: skip
    for moment, p, r, factor in terms:
        bends[moment, p, r] = bends[moment, r, p] = factor
    return bends


BLOCK_INDEX, BENDS = _block_index(), _bends()


@formula
def colour_slopes(free, beta, R, colour):
    """D, the colours' derivatives in q.  free: w where the cap does not hold, else 0; beta likewise."""
    return free * colour[0] - beta * R[0], free * colour[1] - beta * R[1], free * colour[2] - beta * R[2]


@formula
def step_block(w, free, beta, R, g, h, colour):
    """D, R in front of the splat, and s + v."""
    D = colour_slopes(free, beta, R, colour)
    weight = D[0] * (g[0] + h[0] * D[0]) + D[1] * (g[1] + h[1] * D[1]) + D[2] * (g[2] + h[2] * D[2])
    return D, plus(R, w, colour), weight


@formula
def cross_terms(w, free, D, g, h):
    """w g_c + w h_c D_c and w^2 h_c of a channel."""
    wh = w * h
    return free * g + wh * D, w * wh
