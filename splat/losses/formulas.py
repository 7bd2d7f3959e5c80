"""The losses of a pixel: the pixel losses, and SSIM with its first and second derivatives.

SSIM of an image x against a target y is taken in the residual r = x - y, because the variances of the usual formula cancel:
in float32 its curvature is wrong by 3e-5 (in r: 3e-7).  With mu and var the window's mean and variance of y, c = 1/2 (which
centres pictures), and m, p, q the window's means of r, r^2 and (y - c) r, at a pixel and channel:

    1 - S = 1 - l s       l = 1 - m^2 / B1     B1 = (mu + m)^2 + mu^2 + C1
                          s = 1 - w / B2       w = p - m^2, the variance of r
                                               B2 = 2 (var + q - (mu - c) m) + w + C2

The window's blur is its own adjoint, so with S_m, S_p, S_q the partial derivatives

    gradient of sum S      blur(S_m) + 2 r blur(S_p) + (y - c) blur(S_q)
    its tangent for v      the same of S_m', S_p', S_q', plus 2 v blur(S_p), a dash the second derivative of S applied to
                           m' = blur(v), p' = 2 blur(r v), q' = blur((y - c) v)
"""

from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import maximum, select, sqrt
from splat.losses.reference import C1, C2


@formula
def pair_slopes(m, p, mean, variance):
    """1 - S, and what is blurred for the gradients in r (2) and in a (2)."""
    w = p - m * m
    r1 = 1.0 / (2.0 * mean * mean + 0.5 * m * m + C1)
    r2 = 1.0 / (2.0 * variance + 0.5 * w + C2)
    far, apart = m * m * r1, w * r2
    l, s = 1.0 - far, 1.0 - apart
    dp, dv = l * (1.0 - 0.5 * apart) * r2, -2.0 * l * apart * r2
    in_m = m * (s * (2.0 - far) * r1 - 2.0 * dp)
    in_mean = -4.0 * s * far * mean * r1 - 2.0 * (mean - CENTRE) * dv
    return far + apart - far * apart, in_m, dp, in_mean, dv


L1, CHARBONNIER, L2 = range(3)
CENTRE = 0.5
SECONDS = 6  # S_mm, S_mp, S_mq, S_pp, S_pq, S_qq


@formula
def similarity(m, p, q, mu, var):
    """1 - l and 1 - s, their first derivatives l_m and s_m, s_p, s_q, and what the second ones need."""
    mean = mu + m
    r1 = 1.0 / (mean * mean + mu * mu + C1)
    variance, centred = p - m * m, mean - CENTRE
    r2 = 1.0 / (2.0 * (var + q - (mu - CENTRE) * m) + variance + C2)
    far, apart = m * m * r1, variance * r2
    dl = 2.0 * (mean * far - m) * r1
    sm, sp, sq = 2.0 * (m - centred * apart) * r2, -((1.0 - apart) * r2), 2.0 * apart * r2
    return far, apart, dl, sm, sp, sq, mean, centred, r1, r2


@formula
def slopes_of(found):
    """1 - S, and S_m, S_p, S_q, from `similarity`."""
    far, apart, dl, sm, sp, sq, _mean, _centred, _r1, _r2 = found
    l = 1.0 - far
    return far + apart - far * apart, dl * (1.0 - apart) + l * sm, l * sp, l * sq


@formula
def seconds_of(found):
    """The SECONDS second derivatives of S, from `similarity`."""
    far, apart, dl, sm, sp, sq, mean, centred, r1, r2 = found
    l, s = 1.0 - far, 1.0 - apart
    ddl = -((2.0 * l + 4.0 * mean * dl) * r1)
    smm, smp = (2.0 * s + 4.0 * centred * sm) * r2, (2.0 * centred * sp - sm) * r2
    smq = 2.0 * (centred * sq - sm) * r2
    return (
        ddl * s + 2.0 * dl * sm + l * smm,
        dl * sp + l * smp,
        dl * sq + l * smq,
        -2.0 * l * sp * r2,
        -(l * (sq + 2.0 * sp) * r2),
        -4.0 * l * sq * r2,
    )


@formula
def ssim_second_dot(second, dm, dp, dq):
    """S_m', S_p', S_q': the second derivatives applied to m', p', q'."""
    mm, mp, mq, pp, pq, qq = second
    return mm * dm + mp * dp + mq * dq, mp * dm + pp * dp + pq * dq, mq * dm + pq * dp + qq * dq


@formula
def ssim_quadratic_form(second, dm, dp, dq, squared, blurred_sp):
    """What a pixel has of the second derivative of sum S along v: (m', p', q') . S'' (m', p', q') + 2 v^2 blur(S_p)."""
    sm, sp, sq = ssim_second_dot(second, dm, dp, dq)
    return sm * dm + sp * dp + sq * dq + 2.0 * squared * blurred_sp


@formula
def ssim_adjoint(residual, aim, bm, bp, bq):
    """blur(S_m) + 2 r blur(S_p) + (y - c) blur(S_q), or the same of other fields; aim: y - c."""
    return bm + 2.0 * residual * bp + aim * bq


@formula
def ssim_diag_hessian(second, blurred_sp, residual, aim):
    """The diagonal of the Hessian of sum S, from its second derivatives blurred by the squared window."""
    mm, mp, mq, pp, pq, qq = second
    coupled = mm + 4.0 * residual * (mp + residual * pp + aim * pq) + aim * (2.0 * mq + aim * qq)
    return coupled + 2.0 * blurred_sp


@formula
def pixel_slope(residual, kind, eps):
    """The pixel loss of a residual and its derivative."""
    if kind == L1:
        return maximum(residual, -residual), select(residual > 0.0, 1.0, select(residual < 0.0, -1.0, residual * 0.0))
    if kind == L2:
        return residual * residual, 2.0 * residual
    length = sqrt(residual * residual + eps * eps)
    return length, residual / length


@formula
def pixel_curvature(residual, kind, eps, weight):
    """The second derivative of the pixel loss, times weight; 0 for L1 (its kink at 0 has none)."""
    if kind == L1:
        return residual * 0.0
    if kind == L2:
        return 2.0 * weight
    squared = residual * residual + eps * eps
    return weight * (eps * eps) / (squared * sqrt(squared))
