"""The opacities of antialiased Gaussians: the two filters of Mip-Splatting (Yu et al., CVPR 2024) and their relatives.

    3-D filter   of a constant width f (world units, `filter_widths`): every scale s becomes s' = sqrt(s^2 + f^2), and the
                 opacity is multiplied by prod s / s', over the three axes
    2-D filter   the opacity is multiplied by C because the blur makes the splat wider:
                 C^2 = max(floor, D / (D' + epsilon) + epsilon), and floor where D <= epsilon;
                 D, D' determinants of the 2-D covariance without and with the blur.  C is constant where the floor holds

                  floor    epsilon   blur, px^2   whose
    mip           2.5e-5   0         0.3          3DGS with --antialiasing, gsplat 1.6
    mip-plain     0 (*)    0         0.3, 0.1     gsplat to 1.5 and nerfstudio; Brush
    mip-splatting 0        1e-6      0.1          Mip-Splatting
    *: 1e-30 here, so that 1 / D stays in range

F, the product of both factors, makes opacities depend on the view.  With r1, r2, n = r1 x r2 and beta as in `formulas.py`,
D = n.n and D' = D + k, k = beta (r1.r1 + r2.r2) + beta^2 + epsilon, nothing cancels in

    d ln C = [(k r2 x n - beta D r1) . dr1 + (k n x r1 - beta D r2) . dr2] / (D' (D + epsilon D'))
    d ln s' / d ln s = s^2 / s'^2         d ln(s / s') / d ln s = f^2 / s'^2

These are formulas for floats and for dual numbers, like those of `formulas.py`, whose place they take where something is
antialiased.
"""

from collections.abc import Sequence
from math import sqrt as sqrt_of

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from splat.backend.cpu.dual import select, sqrt, value_of
from splat.backend.cpu.jit import formula
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.projection.formulas import (
    Lens,
    axes_adjoint,
    conic_of,
    cross,
    dot,
    plus,
    projected_axes,
    rows_adjoint,
    scaled,
    scales_of,
)

FILTER_AREA = 0.2  # of Mip-Splatting's 3-D filter, in squared sampling intervals
FILTER_NEAR, FILTER_BORDER = (
    0.2,
    0.15,
)  # which cameras count: those that have the mean beyond this, in the image widened by this


@formula
def smoothed_scales(log_scales, width):
    """The three s', s^2 / s'^2, f^2 / s'^2, and prod s / s'."""
    s0, s1, s2 = scales_of(log_scales)
    ff = width * width
    v0, v1, v2 = s0 * s0 + ff, s1 * s1 + ff, s2 * s2 + ff
    wide = (sqrt(v0), sqrt(v1), sqrt(v2))
    kept = (s0 * s0 / v0, s1 * s1 / v1, s2 * s2 / v2)
    return wide, kept, (ff / v0, ff / v1, ff / v2), (s0 / wide[0]) * (s1 / wide[1]) * (s2 / wide[2])


@formula
def compensation(lens, r1, r2, shrink):
    """C, and d ln C / d(r1, r2) for the shrunken rows."""
    beta = lens.blur * shrink * shrink
    epsilon = lens.epsilon * shrink * shrink * (shrink * shrink)
    normal = cross(r1, r2)
    D = dot(normal, normal)
    k = beta * (dot(r1, r1) + dot(r2, r2)) + (beta * beta + epsilon)
    whole = D + k
    squared = D / whole + lens.epsilon
    free = (value_of(squared) > lens.floor) & (value_of(D) > value_of(epsilon))
    C = select(free, sqrt(select(free, squared, squared * 0.0 + 1.0)), squared * 0.0 + sqrt(lens.floor))
    inverse, above = 1.0 / whole, 1.0 / select(free, D + lens.epsilon * whole, whole)
    long, lift = k * inverse, -(beta * D * inverse)
    g1 = scaled(plus(scaled(cross(r2, normal), long), scaled(r1, lift)), above)
    g2 = scaled(plus(scaled(cross(normal, r1), long), scaled(r2, lift)), above)
    off = value_of(D) * 0.0
    on = select(free, off + 1.0, off)
    return C, scaled(g1, on), scaled(g2, on)


@formula
def antialiased_geometry(lens, mean, log_scales, quat, width):
    """Mean x, y (px), conic a, b, c, and F."""
    scales, _kept, _blurred, thinned = smoothed_scales(log_scales, width)
    (x, y, _z), depth, _uv, _unit, _inverse, _scales, _axes, shrink, r1, r2 = projected_axes(lens, mean, scales, quat)
    (a, b, c), _q1, _q2 = conic_of(r1, r2, lens.blur, shrink)
    C, _g1, _g2 = compensation(lens, r1, r2, shrink)
    return lens.fx * x * depth + lens.cx, lens.fy * y * depth + lens.cy, a, b, c, C * thinned


@formula
def antialiased_adjoint(lens, mean, log_scales, quat, width, bar):
    """The adjoints of mean, log_scales and quat (ten numbers), given those of mean x, y, conic a, b, c and F (six)."""
    scales, kept, blurred, thinned = smoothed_scales(log_scales, width)
    shared = projected_axes(lens, mean, scales, quat)
    r1, r2, shrink = shared[8], shared[9], shared[7]
    conic, q1, q2 = conic_of(r1, r2, lens.blur, shrink)
    r1_bar, r2_bar = rows_adjoint(conic, q1, q2, bar)
    C, g1, g2 = compensation(lens, r1, r2, shrink)
    F_bar = (C * thinned) * bar[5]  # of ln F
    rows_bar = (plus(r1_bar, scaled(g1, F_bar)), plus(r2_bar, scaled(g2, F_bar)))
    m, s, q = axes_adjoint(lens, shared, rows_bar, bar)
    log_scales_bar = (
        s[0] * kept[0] + F_bar * blurred[0],
        s[1] * kept[1] + F_bar * blurred[1],
        s[2] * kept[2] + F_bar * blurred[2],
    )
    return m, log_scales_bar, q


def is_antialiased(gaussians: Gaussians, lens: Lens) -> bool:
    """Whether a factor of opacities differs from 1."""
    return lens.floor < 1 or gaussians.filter_widths is not None


def widths_of(gaussians: Gaussians, lens: Lens) -> Float[Tensor, " n"] | None:
    """The widths of the 3-D filter, 0 where there is none; None where nothing is antialiased."""
    if not is_antialiased(gaussians, lens):
        return None
    widths = gaussians.filter_widths
    return gaussians.flat.new_zeros(len(gaussians)) if widths is None else widths


@torch.no_grad()
def log_sizes(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """Logarithms of the standard deviations under the 3-D filter: ln s'."""
    log_scales = gaussians.log_scales.detach()
    if gaussians.filter_widths is None:
        return log_scales
    return torch.logaddexp(2 * log_scales, 2 * gaussians.filter_widths.log()[:, None]) / 2


@torch.no_grad()
def filter_factor(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """Factor of the 3-D filter on opacities: prod s / s'."""
    return (gaussians.log_scales.detach() - log_sizes(gaussians)).sum(dim=1).exp()


@torch.no_grad()
def baked(gaussians: Gaussians) -> Gaussians:
    """Gaussians of the same images that need no 3-D filter: s' and the opacity times its factor are their parameters."""
    if gaussians.filter_widths is None:
        return gaussians
    found = gaussians.with_flat(gaussians.flat.detach().clone()).with_filter(None)
    opacity = gaussians.opacity_logits.detach().double().sigmoid() * filter_factor(gaussians.to(torch.float64))
    found.log_scales.copy_(log_sizes(gaussians))
    found.opacity_logits.copy_(torch.logit(opacity.clamp_min(torch.finfo(found.flat.dtype).tiny)))
    return found


@torch.no_grad()
def sampling_widths(gaussians: Gaussians, cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """The width of each Gaussian's 3-D filter by Mip-Splatting's training: sqrt(0.2) z / f.

    z: the least depth of the mean among the cameras that have it in sight; for those that none has, the largest of the others.
    f: the largest focal length.  InputError where no camera has any in sight.
    """
    means = gaussians.means
    nearest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        x, y, z = ((means - camera.centre.to(means)) @ camera.rotation.to(means).T).unbind(-1)
        seen = z > FILTER_NEAR
        for tangent, focal, middle, size in (
            (x / z, camera.fx, camera.cx, camera.width),
            (y / z, camera.fy, camera.cy, camera.height),
        ):
            place = tangent * focal + middle
            seen &= (place >= -FILTER_BORDER * size) & (place <= (1 + FILTER_BORDER) * size)
        nearest = torch.where(seen, torch.minimum(nearest, z), nearest)
    finite = nearest.isfinite()
    if not finite.any():
        raise InputError("expected a camera that has a Gaussian in sight, got none; its 3-D filter has no width")
    farthest = torch.where(finite, nearest, 0).amax()
    return sqrt_of(FILTER_AREA) / max(camera.fx for camera in cameras) * torch.where(finite, nearest, farthest)
