"""What the compositing kernels share: their arrays, and the formulas of one splat in one pixel, at first and second order.

A tile is `lanes` pixels wide and TILE_ROWS high; a row of it is one vector.  Per pixel, splats in order of depth, with the
pixel's offset from the mean in the splat's whitened coordinates (u, v) (`whitening.py`), opacity o, colour c:

    l = log2 alpha = log2 o - u^2 - v^2      alpha = min(cap, 2^l)
    active where l >= cut and the pixel has not stopped; elsewhere alpha = 0 and every update below is a no-op

`forward`     w = alpha T;  image += w c;  T <- T - w;  at the end image += T background, alpha plane = 1 - T.

`backward`    given g = dloss/dimage and, for the alpha plane, g_A.  Back to front, T starts at the final T and R, the
              sum over the splats behind of w_j (g . c_j) plus the background's part, at T (g . background - g_A):
              r = 1 / (1 - alpha);  T <- T r;  w = alpha T;  beta = alpha r;  e = g . c
              s = w e - beta R, the derivative in q = ln alpha, 0 where the cap holds;  R <- R + w e
              per splat: moments S, Su, Sv, Suu, Suv, Svv of s over the offsets, and G = sum w g.

`tangent`     (J u) given tangents of the splats; q' is one quadratic in the offset, 0 where the cap holds:
              w' = w q' + alpha T';  image' += w' c + w c';  T' <- T' - w';  at the end image' += T' background.

`curvature`   (the tangent of `backward`) given q', c' and g' = dg.  With tau = T' / T, r, w, beta, R as above:
              tau <- tau + beta q';  nu = q' + tau;  h = nu g + g';  z = w (h . c + g . c')
              s' = z - beta (R' + r R q'), 0 where the cap holds;  R' <- R' + z;  moments of s' and G' = sum w h.

A dash marks a tangent.  K tangents share the primal quantities of a splat's rows, which stay in L1 between them; for
K = 1 the two loops are one.  Every entry (a splat in a tile) writes its nine sums to its own slot, splat-major, so that no
sum depends on the order in which threads finish.

Every kernel (`compositing.py`, `tangents.py`) takes tiles from a counter until none is left (`threads.over_tiles`).  Arrays are
flat: `params` holds PARAMS floats a splat, `tangents` K x TANGENTS floats a splat, a plane stride x height floats.
"""

from math import ceil, floor, inf, log, sqrt

import numpy as np

from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import exp2, fma, minimum, select
from splat.projection.whitening import ROUND, plain_adjoint, whitened

Q0, QU, QV, QUU, QUV, QVV = range(6)  # q' = Q0 + QU u + QV v + QUU u^2 + QUV u v + QVV v^2
WIDEN = 1e-4  # relative widening of an ellipse's level, so that no active pixel is missed
DEGREE4, DEGREE2 = 15, 6  # how many moments u^j v^k there are up to these degrees
CROSS = DEGREE4  # after the moments of s + v: those of w g_c + w h_c D_c, and the sums of w^2 h_c
COLOUR = DEGREE4 + 3 * DEGREE2
BLOCK_SUMS = COLOUR + 3
TINY = np.finfo(np.float64).tiny  # an opacity below has no weight, and no inverse


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
def behind_all(g, background):
    """What the final transmittance is multiplied by in the loss: g . background - g_A."""
    return g[0] * background[0] + g[1] * background[1] + g[2] * background[2] - g[3]


@formula
def step_back(alpha, T, R, g, colour):
    """A splat undone: T, R in front of it, and its w, beta, r, w e."""
    r = reciprocal(1.0 - alpha)
    T = T * r
    w = alpha * T
    we = w * dot(g, colour)
    return T, R + we, w, alpha * r, r, we


@formula
def step_tangent(dT, dimage, alpha, w, w_dq, colour, dcolour):
    """w' = w q' + alpha T';  T' <- T' - w';  image' += w c' + w' c."""
    dw = w_dq + alpha * dT
    return dT - dw, plus(plus(dimage, w, dcolour), dw, colour)


@formula
def step_curvature(tau, dR, dg, w, beta, rR, dq, g, colour, dcolour):
    """tau and R' after a splat, its s' where the cap does not hold, and h."""
    tau = tau + beta * dq
    h = plus(dg, dq + tau, g)
    z = w * dot_plus(h, colour, dot(g, dcolour))
    return tau, dR + z, z - beta * (rR * dq + dR), h


@formula
def row_terms(v, s, w, h):
    """What a row adds to its columns' sums."""
    sv = s * v
    return s, sv, sv * v, w * h[0], w * h[1], w * h[2]


@formula
def column_terms(columns, u):
    """The nine sums' parts of each column, from its sums over rows."""
    S, Sv, Svv, G0, G1, G2 = columns
    Su = S * u
    return S, Su, Sv, Su * u, Sv * u, Svv, G0, G1, G2


# --- between a splat's numbers and its sums (W: `projection/whitening.py`) --------------------------------------------


@formula
def exponent_tangent(W, opacity, y):
    """The coefficients Q0, QU, ... of q' along a splat's tangent y."""
    u, v, uu, uv, vv = whitened(W, y)
    return ratio(y[5], opacity), ROUND * u, ROUND * v, -0.5 * uu, -uv, -0.5 * vv


@formula
def ratio(x, opacity):
    """x / opacity, 0 where nothing is drawn."""
    return select(opacity > 0, x / opacity, 0.0)


@formula
def first_order(W, opacity, total):
    """The gradient in mean, conic and opacity from a splat's sums."""
    S, Su, Sv, Suu, Suv, Svv = total[0], total[1], total[2], total[3], total[4], total[5]
    x, y, a, b, c = plain_adjoint(W, (ROUND * Su, ROUND * Sv, -0.5 * Suu, -Suv, -0.5 * Svv))
    return x, y, a, b, c, ratio(S, opacity)


@formula
def second_order(W, opacity, y, moments, total):
    """The gradient's tangent in mean, conic and opacity along a splat's tangent y; moments: S, Su, Sv of the gradient."""
    S, Su, Sv = moments[0], moments[1], moments[2]
    mu, mv, uu, uv, vv = whitened(W, y)
    white = (
        ROUND * (total[1] - mu * S) + uu * Su + uv * Sv,
        ROUND * (total[2] - mv * S) + uv * Su + vv * Sv,
        -0.5 * (total[3] - 2 * mu * Su),
        -(total[4] - mu * Sv - mv * Su),
        -0.5 * (total[5] - 2 * mv * Sv),
    )
    x, y_bar, a, b, c = plain_adjoint(W, white)
    return x, y_bar, a, b, c, ratio(total[0] - S * ratio(y[5], opacity), opacity)


# --- the pixels that a splat reaches ----------------------------------------------------------------------------------


@formula
def ellipse_of(splat, alpha_min, contour):
    """Half-extents of a splat's ellipse and its widened level; a level of 0 where it is nowhere drawn."""
    a, b, c, opacity = splat[2], splat[3], splat[4], splat[5]
    drawn = (opacity >= alpha_min) & (opacity > 0)
    level = min(contour * contour, 2 * log(select(drawn, opacity, 1.0) / alpha_min))
    level = level * (1 + WIDEN) + WIDEN
    det = a * c - b * b
    level = select((level == inf) | (det <= 0), inf, level)
    level = select(drawn, level, 0.0)
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


# --- a splat's own block of the Hessian -------------------------------------------------------------------------------


def _moment_index() -> np.ndarray:
    """Where the moment of u^j v^k lies among the fifteen, by [j, k]: powers of v outermost, as `store_powers` leaves them."""
    index = np.full((5, 5), -1, np.int64)
    place = 0
    for k in range(5):
        for j in range(5 - k):
            index[j, k] = place
            place += 1
    return index


MOMENT = _moment_index()
MOMENT2 = np.array([[0, 3, 5], [1, 4, -1], [2, -1, -1]])  # of the six of degree 2, stored alike: 1, u, u^2, v, u v, v^2


@formula
def step_block(w, free, beta, R, g, h, colour):
    """D, R in front of the splat, and s + v.  free: w where the cap does not hold, else 0; beta likewise."""
    D = (free * colour[0] - beta * R[0], free * colour[1] - beta * R[1], free * colour[2] - beta * R[2])
    weight = D[0] * (g[0] + h[0] * D[0]) + D[1] * (g[1] + h[1] * D[1]) + D[2] * (g[2] + h[2] * D[2])
    return D, plus(R, w, colour), weight


@formula
def cross_terms(w, free, D, g, h):
    """w g_c + w h_c D_c and w^2 h_c of a channel."""
    wh = w * h
    return free * g + wh * D, w * wh
