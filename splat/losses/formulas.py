"""The losses at one pixel: the pixel losses, and SSIM with its first and second derivatives, for both compilers.

SSIM of an image x and a target y is written in the residual r = x - y, because the variances of the usual formula cancel: in
float32 its second derivatives lose two digits more.  With mu and var the window's mean and variance of y, c = 1/2 (the middle
of the range of intensities), and m, p, q the window's means of r, r^2 and (y - c) r at a pixel and channel,

    1 - S = 1 - l s       l = 1 - m^2 / B1     B1 = (mu + m)^2 + mu^2 + C1
                          s = 1 - w / B2       w = p - m^2, the variance of r
                                               B2 = 2 (var + q - (mu - c) m) + w + C2

A uniform tangent v0 leaves s and its slopes as they are, which m', p', q' below give as the difference of numbers that are
1 / B2 times as large: a splat that fills the picture would lose three digits in float32.  So a tangent is taken less its mean
v0, and v0 times the product of an image of ones is added.  Of the latter's terms those that cancel are left out; d, the
window's weight beyond the edges of the image, is what remains of them:

    m' = 1 - d     B2' = 2 d (mu + m)     w' = 2 d m

The window's blur is its own adjoint.  So with S_m, S_p, S_q the partial derivatives of S,

    gradient of sum S      blur(S_m) + 2 r blur(S_p) + (y - c) blur(S_q)
    its tangent for v      the same of S_m', S_p', S_q', plus 2 v blur(S_p): a dash is the second derivative of S applied to
                           m' = blur(v), p' = 2 blur(r v), q' = blur((y - c) v)

Where both images depend on the parameters, the loss is symmetric and is written in r and a = (x + y) / 2.  With M and V the
window's mean and variance of a, and D = 1 - S of the same l and s,

    B1 = 2 M^2 + m^2 / 2 + C1         (2 M^2 + m^2 / 2 = mu_x^2 + mu_y^2)
    B2 = 2 V + w / 2 + C2             (2 V + w / 2 = var_x + var_y)

    gradient of sum D in r      blur(D_m) + 2 r blur(D_p)
                     in a       blur(D_M - 2 (M - c) D_V) + 2 (a - c) blur(D_V)

The gradient in x is half the one in a plus the one in r; that in y is half the one in a minus the one in r.
"""

from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import maximum, select, sqrt
from splat.losses.reference import C1, C2, PixelLoss

L1, CHARBONNIER, L2 = range(3)
KINDS: dict[PixelLoss, int] = {"l1": L1, "charbonnier": CHARBONNIER, "l2": L2}
CENTRE = 0.5
SECONDS = 5  # S_mm, S_mp, S_mq, S_pp, S_qq; S_pq is S_pp + S_qq / 4


@formula
def similarity(m, p, q, mu, var):
    """1 - l and 1 - s, their first derivatives l_m and s_m, s_p, s_q, and what the second derivatives need."""
    mean = mu + m
    r1 = 1.0 / (mean * mean + mu * mu + C1)
    variance, centred = p - m * m, mean - CENTRE
    r2 = 1.0 / (2.0 * (var + q - (mu - CENTRE) * m) + variance + C2)
    not_l, not_s = m * m * r1, variance * r2
    dl = 2.0 * (mean * not_l - m) * r1
    sm, sp, sq = 2.0 * (m - centred * not_s) * r2, -((1.0 - not_s) * r2), 2.0 * not_s * r2
    return not_l, not_s, dl, sm, sp, sq, mean, centred, r1, r2


@formula
def ssim_slopes(m, p, q, mu, var):
    """1 - S, and S_m, S_p, S_q."""
    not_l, not_s, dl, sm, sp, sq, _mean, _centred, _r1, _r2 = similarity(m, p, q, mu, var)
    l = 1.0 - not_l
    return not_l + not_s - not_l * not_s, dl * (1.0 - not_s) + l * sm, l * sp, l * sq


@formula
def ssim_seconds(m, p, q, mu, var):
    """The SECONDS second derivatives of S."""
    not_l, not_s, dl, sm, sp, sq, mean, centred, r1, r2 = similarity(m, p, q, mu, var)
    l, s = 1.0 - not_l, 1.0 - not_s
    ddl = -((2.0 * l + 4.0 * mean * dl) * r1)
    smm, smp = (2.0 * s + 4.0 * centred * sm) * r2, (2.0 * centred * sp - sm) * r2
    smq = 2.0 * (centred * sq - sm) * r2
    return (
        ddl * s + 2.0 * dl * sm + l * smm,
        dl * sp + l * smp,
        dl * sq + l * smq,
        -2.0 * l * sp * r2,
        -4.0 * l * sq * r2,
    )


@formula
def ssim_second_dot(second, dm, dp, dq):
    """S_m', S_p', S_q': the second derivatives applied to m', p', q'."""
    mm, mp, mq, pp, qq = second
    pq = pp + 0.25 * qq
    return mm * dm + mp * dp + mq * dq, mp * dm + pp * dp + pq * dq, mq * dm + pq * dp + qq * dq


@formula
def ssim_uniform(m, p, q, mu, var, outside):
    """S_m', S_p', S_q' for an image of ones, with S_m' less 2 l s / B2, which blurred is the term -2 blur(S_p).

    outside: the window's weight beyond the image.
    """
    not_l, not_s, dl, sm, sp, sq, mean, centred, r1, r2 = similarity(m, p, q, mu, var)
    l, s, inside = 1.0 - not_l, 1.0 - not_s, 1.0 - outside
    ddl = -((2.0 * l + 4.0 * mean * dl) * r1)
    widened, ds = 2.0 * outside * mean * r2, 2.0 * outside * (mean * not_s - m) * r2  # B2' / B2, s'
    dsm = 2.0 * r2 * (centred * ds - outside * s) - sm * widened
    return (
        inside * (ddl * s + dl * sm) + dl * ds + l * dsm,
        inside * dl * sp - l * (ds * r2 + sp * widened),
        inside * dl * sq - l * (2.0 * ds * r2 + sq * widened),
    )


@formula
def ssim_quadratic_form(second, dm, dp, dq, squared, blurred_sp):
    """A pixel's term of v . (second derivative of sum S) v: (m', p', q') . S'' (m', p', q') + 2 v^2 blur(S_p)."""
    sm, sp, sq = ssim_second_dot(second, dm, dp, dq)
    return sm * dm + sp * dp + sq * dq + 2.0 * squared * blurred_sp


@formula
def ssim_adjoint(residual, aim, bm, bp, bq):
    """blur(S_m) + 2 r blur(S_p) + (y - c) blur(S_q), or the same of other fields; aim: y - c."""
    return bm + 2.0 * residual * bp + aim * bq


@formula
def ssim_diag_hessian(second, blurred_sp, residual, aim):
    """The diagonal of the Hessian of sum S, from its second derivatives blurred by the squared window."""
    mm, mp, mq, pp, qq = second
    coupled = mm + 4.0 * residual * (mp + residual * pp + aim * (pp + 0.25 * qq)) + aim * (2.0 * mq + aim * qq)
    return coupled + 2.0 * blurred_sp


@formula
def pair_slopes(m, p, mean, variance):
    """1 - S of two images, and the fields that are blurred for the gradients in r (two) and in a (two)."""
    w = p - m * m
    r1 = 1.0 / (2.0 * mean * mean + 0.5 * m * m + C1)
    r2 = 1.0 / (2.0 * variance + 0.5 * w + C2)
    not_l, not_s = m * m * r1, w * r2
    l, s = 1.0 - not_l, 1.0 - not_s
    dp, dv = l * (1.0 - 0.5 * not_s) * r2, -2.0 * l * not_s * r2
    in_m = m * (s * (2.0 - not_l) * r1 - 2.0 * dp)
    in_mean = -4.0 * s * not_l * mean * r1 - 2.0 * (mean - CENTRE) * dv
    return not_l + not_s - not_l * not_s, in_m, dp, in_mean, dv


@formula
def pair_adjoint(x, y, slope, structural, bm, bp, ba, bv):
    """The gradients in x and y, from the pixel loss's slope in r and the four blurred fields; structural: weight of 1 - S."""
    apart = slope + structural * (bm + 2.0 * (x - y) * bp)
    along = structural * (0.5 * ba + (0.5 * (x + y) - CENTRE) * bv)
    return along + apart, along - apart


@formula
def pixel_slope(residual, kind, eps):
    """The pixel loss of a residual and its derivative."""
    if kind == L1:
        return maximum(residual, -residual), select(residual > 0.0, 1.0, select(residual < 0.0, -1.0, residual * 0.0))
    if kind == L2:
        return residual * residual, 2.0 * residual
    length = sqrt(residual * residual + eps * eps)
    return length, residual * (1.0 / length)


@formula
def pixel_curvature(residual, kind, eps, weight):
    """The second derivative of the pixel loss, times weight; 0 for L1 (its kink at 0 has none)."""
    if kind == L1:
        return residual * 0.0
    if kind == L2:
        return 2.0 * weight
    squared = residual * residual + eps * eps
    return weight * (eps * eps) / (squared * sqrt(squared))
