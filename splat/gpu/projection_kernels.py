"""Projection and SH on the GPU: kernels over blocks of Gaussians.

The formulas are those of `formulas.py` and `whitening.py`, compiled by `triton_formula`.  The arrays of a `ProjectionJacobian`
have the Gaussians along the last axis here, so that neighbouring threads read neighbouring numbers.  A block of vectors (p, K)
is laid out like the flat vector; `start_of` says where an attribute begins there.

Values and the tangents of the linearisation are in double precision, products with vectors in that of the parameters.
"""

# pyright: reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false, reportGeneralTypeIssues=false
# (in a kernel names mean tensors)

import triton.language as tl

from splat.backend.cpu.dual import value_of
from splat.gpu.language.compile import jit, sized
from splat.gpu.language.formula import select, tangent_of, triton_formula, variable
from splat.projection.antialias import antialiased_adjoint, antialiased_geometry
from splat.projection.formulas import (
    GEOMETRY,
    Lens,
    basis,
    colour_adjoint,
    direction_of,
    geometry,
    geometry_adjoint,
    offset_from,
    to_camera,
)
from splat.projection.whitening import converted, geometry_coefficients, plain_gradient, whitening

LENS = tl.constexpr(22)  # numbers of a lens: rotation 9, centre 3, then the others in order, the near plane last


def lens_from(numbers):
    return Lens(numbers[:9], numbers[9:12], *numbers[12:])


@triton_formula
def depth_of(lens, mean):
    camera = lens_from(lens)
    return to_camera(camera, offset_from(camera, mean))[2]


@triton_formula
def splat_of(lens, mean, log_scales, quat, width, antialiased):
    """Mean x, y and conic, and F where antialiased; and the sixteen harmonics at the view direction."""
    camera = lens_from(lens)
    if antialiased:
        found = antialiased_geometry(camera, mean, log_scales, quat, width)
    else:
        found = geometry(camera, mean, log_scales, quat)
    return found, basis(direction_of(camera, mean)[0])


@triton_formula
def adjoint_of(lens, mean, log_scales, quat, width, antialiased, bar, weight, bands):
    """The adjoints of mean, log-scales and quaternion: of the numbers in bar, and of weight . harmonics in the mean.

    bar: of mean x, y and conic, and of F where antialiased.
    """
    camera = lens_from(lens)
    if antialiased:
        m, s, q = antialiased_adjoint(camera, mean, log_scales, quat, width, bar)
    else:
        m, s, q = geometry_adjoint(camera, mean, log_scales, quat, bar)
    along = colour_adjoint(camera, mean, weight, bands)
    return (m[0] + along[0], m[1] + along[1], m[2] + along[2], *s, *q)


@triton_formula
def linearized_geometry(lens, mean, log_scales, quat, own, width, antialiased, splat, moments, lane):
    """The Jacobian (5 rows) and the Hessian of adjoint . geometry (10 rows), one direction at each place of `lane`.

    Where antialiased the opacity is own F, and the slope ln' F comes third.
    """
    camera = lens_from(lens)
    variables = [variable(number, lane, i) for i, number in enumerate((*mean, *log_scales, *quat))]
    x, s, q = variables[:3], variables[3:6], variables[6:]
    W = whitening(splat)
    bar = plain_gradient(W, splat[5], moments)
    if antialiased:
        *values, F = antialiased_geometry(camera, x, s, q, width)
        bars = antialiased_adjoint(camera, x, s, q, width, (*bar[:5], own * bar[5]))
        more = (tangent_of(F) / select(value_of(F) > 0, value_of(F), 1.0),)
    else:
        values, bars, more = geometry(camera, x, s, q), geometry_adjoint(camera, x, s, q, bar), ()
    jacobian = geometry_coefficients(W, [tangent_of(value) for value in values])
    return jacobian, [tangent_of(row) for part in bars for row in part], *more


@triton_formula
def linearized_colour(lens, mean, weight, bands, lane):
    """The harmonics at the view direction, their slopes in the mean, and the Hessian of weight . harmonics (3 rows)."""
    camera = lens_from(lens)
    x = [variable(number, lane, i) for i, number in enumerate(mean)]
    slopes = [tangent_of(harmonic) for harmonic in basis(direction_of(camera, x)[0])]
    along = [tangent_of(row) for row in colour_adjoint(camera, x, weight, bands)]
    return basis(direction_of(camera, mean)[0]), slopes, along


@triton_formula
def in_other_coordinates(way, splat, numbers):
    return converted(way, splat, numbers)


@triton_formula
def curved(packed, u, h):
    """h + C u, C symmetric with its lower triangle packed row by row."""
    total, place = list(h), 0
    for j in range(GEOMETRY):
        for k in range(j):
            total[j] = total[j] + packed[place + k] * u[k]
            total[k] = total[k] + packed[place + k] * u[j]
        total[j] = total[j] + packed[place + j] * u[j]
        place += j + 1
    return total


# --- reading ----------------------------------------------------------------------------------------------------------


@jit
def start_of(attribute: tl.constexpr, n):
    """Index of an attribute in the flat vector: 0 means, 1 log-scales, 2 quaternions, 3 opacity logits, 4 SH."""
    return n * (11 if attribute == 4 else 10 if attribute == 3 else 3 * attribute)


@jit
def places(BLOCK: tl.constexpr, WIDTH: tl.constexpr):
    """A program's Gaussians and, for each, WIDTH directions or vectors: one layout for all that it computes."""
    lane = tl.arange(0, BLOCK * WIDTH)
    return tl.program_id(0).to(tl.int64) * BLOCK + lane // WIDTH, lane % WIDTH


@jit
def numbers(pointer, count: tl.constexpr):
    """The first numbers at a pointer."""
    found = ()
    for j in tl.static_range(count):
        found = found + (tl.load(pointer + j),)
    return found


@jit
def row(pointer, i, width: tl.constexpr, count: tl.constexpr, mask):
    """The first numbers of row i of an array of so many columns, in double precision."""
    found = ()
    for j in tl.static_range(count):
        found = found + (tl.load(pointer + i * width + j, mask, other=1.0).to(tl.float64),)
    return found


@jit
def geometry_at(flat, i, n, mask):
    """Means, log-scales and quaternions of Gaussians, in double precision."""
    log_scales, quats = row(flat + start_of(1, n), i, 3, 3, mask), row(flat + start_of(2, n), i, 4, 4, mask)
    return row(flat, i, 3, 3, mask), log_scales, quats


@jit
def place_of(j: tl.constexpr, i, n):
    """Index in the flat vector of number j of the ten of mean, log-scales and quaternion."""
    return start_of(2, n) + i * 4 + (j - 6) if j >= 6 else start_of(j // 3, n) + i * 3 + j % 3


@jit
def columns(pointer, e, m, count: tl.constexpr, mask):
    """The numbers at place e of so many arrays of m, one after the other."""
    found = ()
    for j in tl.static_range(count):
        found = found + (tl.load(pointer + j * m + e, mask, other=0.0),)
    return found


@jit
def sigmoid(x):
    smaller = tl.exp(-tl.abs(x))
    return tl.where(x >= 0, 1.0, smaller) / (1.0 + smaller)


@sized("n")
def convert(splats, numbers, out, n, WAY: tl.constexpr, BLOCK: tl.constexpr):
    """`whitening.converted` of tangents or adjoints of splats, (n, 9); their colours are alike in all coordinates."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    found = in_other_coordinates(WAY, row(splats, i, 9, 6, here), row(numbers, i, 9, 6, here))
    for j in tl.static_range(6):
        tl.store(out + i * 9 + j, found[j], here)
    for c in tl.static_range(6, 9):
        tl.store(out + i * 9 + c, tl.load(numbers + i * 9 + c, here, other=0.0), here)


# --- values and adjoint -----------------------------------------------------------------------------------------------


@sized("n")
def project_splats(
    flat, widths, lens, splats, depths, drawn, n,
    BANDS: tl.constexpr, ANTIALIASED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Splats (n, 9), depths and drawn; a Gaussian behind the near plane gets zeros."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    camera = numbers(lens, LENS)
    mean, log_scales, quat = geometry_at(flat, i, n, here)
    depth = depth_of(camera, mean).to(depths.dtype.element_ty)
    ahead = here & (depth.to(tl.float64) > camera[LENS - 1])
    tl.store(depths + i, depth, here)
    tl.store(drawn + i, ahead, here)
    logit = tl.load(flat + start_of(3, n) + i, here, other=0.0).to(tl.float64)
    found, harmonic = splat_of(camera, mean, log_scales, quat, row(widths, i, 1, 1, here)[0], ANTIALIASED)
    for j in tl.static_range(5):
        tl.store(splats + i * 9 + j, tl.where(ahead, found[j], 0.0), here)
    opacity = sigmoid(logit)
    if ANTIALIASED:
        opacity = opacity * found[5]
    tl.store(splats + i * 9 + 5, tl.where(ahead, opacity, 0.0), here)
    for c in tl.static_range(3):
        colour = logit * 0.0 + 0.5
        for b in tl.static_range(BANDS):
            sh = tl.load(flat + start_of(4, n) + (i * BANDS + b) * 3 + c, here, other=0.0)
            colour += harmonic[b] * sh.to(tl.float64)
        tl.store(splats + i * 9 + 6 + c, tl.where(ahead, tl.maximum(colour, 0.0), 0.0), here)


@jit
def colour_bars(bar, splats, i, mask):
    """The adjoints of the three colours before their clamp at 0, and 1 where that does not hold."""
    found, visible = (), ()
    for c in tl.static_range(3):
        lit = tl.where(tl.load(splats + i * 9 + 6 + c, mask, other=0.0) > 0, 1.0, 0.0).to(tl.float64)
        visible = visible + (lit,)
        found = found + (lit * tl.load(bar + i * 9 + 6 + c, mask, other=0.0).to(tl.float64),)
    return found, visible


@jit
def harmonic_weights(flat, colour_bar, i, n, BANDS: tl.constexpr, mask):
    """sum_c sh[k, c] colour_bar[c], sixteen of them."""
    found = ()
    for b in tl.static_range(16):
        weight = colour_bar[0] * 0.0
        if b < BANDS:
            for c in tl.static_range(3):
                sh = tl.load(flat + start_of(4, n) + (i * BANDS + b) * 3 + c, mask, other=0.0)
                weight += sh.to(tl.float64) * colour_bar[c]
        found = found + (weight,)
    return found


@sized("n")
def project_adjoint(
    flat, widths, lens, splats, drawn, bar, gradient, n,
    BANDS: tl.constexpr, ANTIALIASED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradient in the flat vector, given the adjoint of the splats, bar (n, 9)."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    ahead = here & (tl.load(drawn + i, here, other=0) != 0)
    camera = numbers(lens, LENS)
    mean, log_scales, quat = geometry_at(flat, i, n, here)
    # the adjoints of colours, and of the harmonics' weights
    colour_bar, _visible = colour_bars(bar, splats, i, here)
    weight = harmonic_weights(flat, colour_bar, i, n, BANDS, here)
    # the adjoint of mean, conic and, where antialiased, of the opacity's factor
    opacity = tl.load(splats + i * 9 + 5, here, other=0.0)
    logit_slope = 1.0 - opacity
    splat_bar = row(bar, i, 9, 5, here)
    if ANTIALIASED:
        logit = tl.load(flat + start_of(3, n) + i, here, other=0.0).to(tl.float64)
        logit_slope = sigmoid(-logit)
        splat_bar = splat_bar + (sigmoid(logit) * tl.load(bar + i * 9 + 5, here, other=0.0),)
    width = row(widths, i, 1, 1, here)[0]
    # pulled back to mean, log-scales and quaternion
    pulled = adjoint_of(camera, mean, log_scales, quat, width, ANTIALIASED, splat_bar, weight, BANDS)
    for j in tl.static_range(10):
        tl.store(gradient + place_of(j, i, n), tl.where(ahead, pulled[j], 0.0), here)
    # the logit
    logit_bar = opacity * logit_slope * tl.load(bar + i * 9 + 5, here, other=0.0)
    tl.store(gradient + start_of(3, n) + i, tl.where(ahead, logit_bar, 0.0), here)
    # SH
    _found, harmonic = splat_of(camera, mean, log_scales, quat, width, False)
    for b in tl.static_range(BANDS):
        for c in tl.static_range(3):
            value = tl.where(ahead, harmonic[b] * colour_bar[c], 0.0)
            tl.store(gradient + start_of(4, n) + (i * BANDS + b) * 3 + c, value, here)


# --- the linearisation ------------------------------------------------------------------------------------------------


@sized("n", "m")
def linearize_geometry(
    flat, lens, splats, moments, index, widths, jacobian, curvature, logit_slope, logit_curvature, opacity_slope,
    opacity_curvature, n, m, ANTIALIASED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The derivatives of geometry and opacity of the Gaussians at index (m,), one direction a lane."""
    e, lane = places(BLOCK, 16)
    here = e < m
    i = tl.load(index + e, here, other=0)
    camera = numbers(lens, LENS)
    mean, log_scales, quat = geometry_at(flat, i, n, here)  # Triton 3.6 reads no nested names on the left
    splat, adjoint = row(splats, i, 9, 6, here), row(moments, i, 9, 6, here)
    S = tl.load(moments + i * 9, here, other=0.0).to(tl.float64)
    logit, width = tl.load(flat + start_of(3, n) + i, here, other=0.0).to(tl.float64), row(widths, i, 1, 1, here)[0]
    # a row of P' and of (a . P'') in each lane
    found = linearized_geometry(
        camera, mean, log_scales, quat, sigmoid(logit), width, ANTIALIASED, splat, adjoint, lane
    )
    rows, bends = found[0], found[1]
    # the opacity: its slope in the logit and, antialiased, its factor's in the geometry
    if ANTIALIASED:
        slope = sigmoid(-logit)
        tl.store(opacity_slope + lane * m + e, found[2], here & (lane < 10))
        tl.store(opacity_curvature + lane * m + e, S * slope * found[2], here & (lane < 10))
    else:
        slope = 1.0 - tl.load(splats + i * 9 + 5, here, other=0.0)
    tl.store(logit_slope + e, slope, here & (lane == 0))
    tl.store(logit_curvature + e, slope * (2.0 * slope - 1.0) * S, here & (lane == 0))
    # P' whole, of (a . P'') the lower triangle
    for r in tl.static_range(5):
        tl.store(jacobian + (r * 10 + lane) * m + e, rows[r], here & (lane < 10))
    for j in tl.static_range(10):
        tl.store(curvature + (j * (j + 1) // 2 + lane) * m + e, bends[j], here & (lane <= j))


@sized("n", "m")
def linearize_colour(
    flat, lens, splats, moments, index, curvature, harmonic, slope, colour_bar, visible, colour_slope, n, m,
    BANDS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The derivatives of the colours, one direction a lane; what they add to the curvature is added."""
    e, lane = places(BLOCK, 16)
    here = e < m
    i = tl.load(index + e, here, other=0)
    bars, lit = colour_bars(moments, splats, i, here)
    weight = harmonic_weights(flat, bars, i, n, BANDS, here)
    values, slopes, along = linearized_colour(numbers(lens, LENS), row(flat, i, 3, 3, here), weight, BANDS, lane)
    for j in tl.static_range(3):
        at, lower = curvature + (j * (j + 1) // 2 + lane) * m + e, here & (lane <= j)
        tl.store(at, tl.load(at, lower, other=0.0) + along[j], lower)
    for k in tl.static_range(16):
        tl.store(harmonic + k * m + e, values[k], here & (lane == 0))
        tl.store(slope + (k * 3 + lane) * m + e, slopes[k], here & (lane < 3))
    for c in tl.static_range(3):
        tl.store(colour_bar + c * m + e, bars[c], here & (lane == 0))
        tl.store(visible + c * m + e, lit[c], here & (lane == 0))
        total = slopes[0] * 0.0
        for b in tl.static_range(BANDS):
            sh = tl.load(flat + start_of(4, n) + (i * BANDS + b) * 3 + c, here, other=0.0)
            total += sh.to(tl.float64) * slopes[b]
        tl.store(colour_slope + (c * 3 + lane) * m + e, total, here & (lane < 3))


# --- products with a block of vectors: Gaussians by rows, vectors by columns ------------------------------------------


@jit
def tangents_at(block, i, k, K, n, here):
    """The ten tangents of mean, log-scales and quaternion."""
    found = ()
    for j in tl.static_range(10):
        found = found + (tl.load(block + place_of(j, i, n) * K + k, here, other=0.0),)
    return found


@sized("n", "m", "K")
def push_forward(
    block, index, jacobian, harmonic, visible, colour_slope, logit_slope, opacity_slope, out, n, m, K,
    ANTIALIASED: tl.constexpr, BANDS: tl.constexpr, BLOCK: tl.constexpr, VECTORS: tl.constexpr,
):  # fmt: skip
    """P' u: rows of out (n, K, 9)."""
    e, k = places(BLOCK, VECTORS)
    k += tl.program_id(1) * VECTORS
    kept, here = e < m, (e < m) & (k < K)
    i = tl.load(index + e, kept, other=0)
    u = tangents_at(block, i, k, K, n, here)
    at = out + (i * K + k) * 9
    logit = tl.load(block + (start_of(3, n) + i) * K + k, here, other=0.0)
    # ln opacity
    change = tl.load(logit_slope + e, kept, other=0.0) * logit
    if ANTIALIASED:
        for j in tl.static_range(10):
            change += tl.load(opacity_slope + j * m + e, kept, other=0.0) * u[j]
    tl.store(at, change, here)
    # the five whitened coefficients of mean and conic
    for r in tl.static_range(5):
        total = u[0] * 0.0
        for j in tl.static_range(10):
            total += tl.load(jacobian + (r * 10 + j) * m + e, kept, other=0.0) * u[j]
        tl.store(at + 1 + r, total, here)
    # colours: by the direction to the mean, and by SH
    for c in tl.static_range(3):
        total = u[0] * 0.0
        for j in tl.static_range(3):
            total += tl.load(colour_slope + (c * 3 + j) * m + e, kept, other=0.0) * u[j]
        for b in range(BANDS):
            sh = tl.load(block + (start_of(4, n) + (i * BANDS + b) * 3 + c) * K + k, here, other=0.0)
            total += tl.load(harmonic + b * m + e, kept, other=0.0) * sh
        tl.store(at + 6 + c, tl.load(visible + c * m + e, kept, other=0.0) * total, here)


@sized("n", "m", "K")
def pull_back(
    cotangents, block, index, jacobian, curvature, harmonic, slope, colour_bar, visible, colour_slope, logit_slope,
    logit_curvature, opacity_slope, opacity_curvature, out, n, m, K, SECOND_ORDER: tl.constexpr,
    ANTIALIASED: tl.constexpr, BANDS: tl.constexpr, BLOCK: tl.constexpr, VECTORS: tl.constexpr,
):  # fmt: skip
    """P'^T of cotangents (n, K, 9), plus (a . P'') u where SECOND_ORDER: rows of out (p, K)."""
    e, k = places(BLOCK, VECTORS)
    k += tl.program_id(1) * VECTORS
    kept, here = e < m, (e < m) & (k < K)
    i = tl.load(index + e, kept, other=0)
    # y: the cotangents of the splat's nine numbers, those of clamped colours 0
    bars = ()
    for j in tl.static_range(9):
        bars = bars + (tl.load(cotangents + (i * K + k) * 9 + j, here, other=0.0),)
    colour = ()
    for c in tl.static_range(3):
        colour = colour + (tl.load(visible + c * m + e, kept, other=0.0) * bars[6 + c],)
    # P'^T y in the geometry: by mean and conic, by the colours' direction, by the opacity's factor
    h = ()
    for j in tl.static_range(10):
        total = tl.load(jacobian + j * m + e, kept, other=0.0) * bars[1]
        for r in tl.static_range(1, 5):
            total += tl.load(jacobian + (r * 10 + j) * m + e, kept, other=0.0) * bars[1 + r]
        for c in tl.static_range(3):
            if j < 3:
                total += tl.load(colour_slope + (c * 3 + j) * m + e, kept, other=0.0) * colour[c]
        if ANTIALIASED:
            total += tl.load(opacity_slope + j * m + e, kept, other=0.0) * bars[0]
        h = h + (total,)
    # and in the logit
    logit_bar = tl.load(logit_slope + e, kept, other=0.0) * bars[0]
    u = tangents_at(block, i, k, K, n, here)
    if SECOND_ORDER:
        # (a . P'') u of the geometry, and of the logit
        h = curved(columns(curvature, e, m, 55, kept), u, h)
        logit = tl.load(block + (start_of(3, n) + i) * K + k, here, other=0.0)
        logit_bar += tl.load(logit_curvature + e, kept, other=0.0) * logit
        if ANTIALIASED:
            # the opacity's factor mixes both
            bent = ()
            for j in tl.static_range(10):
                across = tl.load(opacity_curvature + j * m + e, kept, other=0.0)
                bent = bent + (h[j] + across * logit,)
                logit_bar += across * u[j]
            h = bent
    mean = (h[0], h[1], h[2])
    # SH: P'^T y, and the mixed second derivatives of SH and mean both ways
    for b in range(BANDS):
        at = (start_of(4, n) + (i * BANDS + b) * 3) * K + k
        s = columns(slope + b * 3 * m, e, m, 3, kept)
        along = s[0] * u[0] + s[1] * u[1] + s[2] * u[2]
        weight = u[0] * 0.0
        for c in tl.static_range(3):
            value = tl.load(harmonic + b * m + e, kept, other=0.0) * colour[c]
            if SECOND_ORDER:
                coloured = tl.load(colour_bar + c * m + e, kept, other=0.0)
                weight += coloured * tl.load(block + at + c * K, here, other=0.0)
                value += coloured * along
            tl.store(out + at + c * K, value, here)
        mean = (mean[0] + s[0] * weight, mean[1] + s[1] * weight, mean[2] + s[2] * weight)
    for j in tl.static_range(10):
        tl.store(out + place_of(j, i, n) * K + k, mean[j] if j < 3 else h[j], here)
    tl.store(out + (start_of(3, n) + i) * K + k, logit_bar, here)
