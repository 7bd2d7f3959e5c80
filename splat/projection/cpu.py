"""Projection and SH as kernels: stored parameters of Gaussians -> splats of a view, and the adjoint: training's passes.

Values are computed in double precision, so that needles (condition number to 1e6) keep their conics in float32.  Splats are
(n, 9): `whitening.py`.  The second order is in `linear_cpu.py`.

The formulas run on vectors, a Gaussian in each lane; a `block` holds their numbers (`backend/cpu/memory.py`), in rows MEAN, ...
"""

from math import sqrt

import numpy as np

from splat.backend.cpu.dual import exp, select
from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import gather, gather_one, scatter, scatter_one, scratch, store_all, store_where
from splat.backend.cpu.simd import any_lane, broadcast, lanes, load, load_all, store
from splat.backend.cpu.threads import LIGHT, over_range
from splat.model.gaussians import Gaussians, layout
from splat.projection.antialias import antialiased_adjoint, antialiased_geometry, log_sizes, widths_of
from splat.projection.formulas import (
    Lens,
    basis,
    colour_adjoint,
    direction_of,
    dot,
    geometry,
    geometry_adjoint,
    offset_from,
    plus,
    scaled,
    to_camera,
)
from splat.projection.reference import require_sizes
from splat.projection.whitening import converted


def attribute_arrays(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    """The five attributes as NumPy views."""
    flat = gaussians.flat.detach().numpy()
    return tuple(flat[rows].reshape(shape) for rows, shape in layout(len(gaussians), gaussians.sh_degree).values())


def width_array(gaussians: Gaussians, lens: Lens) -> np.ndarray | None:
    """`widths_of` as a NumPy view."""
    widths = widths_of(gaussians, lens)
    return None if widths is None else widths.numpy()


TINY = float(np.finfo(np.float64).tiny)
# Rows of a block: each has room to a multiple of 8.  SEEN: 1 or 0; BAR, WEIGHT: adjoints of the splat and the harmonics.
MEAN, LOG_SCALES, QUAT, LOGIT, WIDTH, SEEN, SPLAT_AT, BAR = 0, 8, 16, 24, 25, 26, 32, 48
HARMONICS, WEIGHT, SH_AT, ROWS = 64, 80, 96, 144


@formula
def sigmoid(x):
    small = exp(-abs(x))
    return select(x >= 0, small * 0.0 + 1.0, small) / (1.0 + small)


@formula
def point(array, i):
    return np.float64(array[i, 0]), np.float64(array[i, 1]), np.float64(array[i, 2])


@formula
def quaternion(array, i):
    return np.float64(array[i, 0]), np.float64(array[i, 1]), np.float64(array[i, 2]), np.float64(array[i, 3])


@formula
def six_of(row):
    """The first six numbers of a row, in double precision."""
    return (
        np.float64(row[0]), np.float64(row[1]), np.float64(row[2]), np.float64(row[3]), np.float64(row[4]), np.float64(row[5])
    )  # fmt: skip


@formula
def with_factor(bar, own):
    """The adjoint of a splat with that of the antialiased opacity's factor F in place of the opacity's; own: opacity / F."""
    return bar[0], bar[1], bar[2], bar[3], bar[4], own * bar[5]


@kernel
def convert(start, stop, way, splats, numbers, out):
    """`whitening.converted` of tangents or adjoints of splats, (n, 9); their colours are alike in all coordinates."""
    block = scratch(np.empty(0), ROWS * lanes(np.empty(0)))
    for i in range(start, stop, lanes(block)):
        gather(splats, 9, i, stop, block, SPLAT_AT)
        gather(numbers, 9, i, stop, block, BAR)
        splat, old = load_all(block, SPLAT_AT * lanes(block), 6), load_all(block, BAR * lanes(block), 6)
        store_all(block, BAR, converted(way, splat, old))
        scatter(block, BAR, out, 9, i, stop)


@formula
def gather_gaussians(block, i, stop, means, log_scales, quats, logits, sh, widths):
    gather(means, 3, i, stop, block, MEAN)
    gather(log_scales, 3, i, stop, block, LOG_SCALES)
    gather(quats, 4, i, stop, block, QUAT)
    gather_one(logits, i, stop, block, LOGIT)
    gather(sh, 3 * sh.shape[1], i, stop, block, SH_AT)
    if widths is not None:
        gather_one(widths, i, stop, block, WIDTH)


@formula
def geometry_at(block):
    """Mean, log-scales, quaternion, logit and width of the filter: vectors."""
    L = lanes(block)
    mean, log_scale, quat = (
        load_all(block, MEAN * L, 3),
        load_all(block, LOG_SCALES * L, 3),
        load_all(block, QUAT * L, 4),
    )
    return mean, log_scale, quat, load(block, LOGIT * L), load(block, WIDTH * L)


@kernel
def project_splats(start, stop, lens, means, log_scales, quats, logits, sh, widths, splats, depths, drawn):
    """Fill splats (n, 9), depths and drawn; a Gaussian behind the near plane gets an opacity of 0.

    widths: None where nothing is antialiased, for which a kernel of its own is compiled.
    """
    bands, block = sh.shape[1], scratch(np.empty(0), ROWS * lanes(np.empty(0)))
    L = lanes(block)
    for i in range(start, stop, L):
        gather_gaussians(block, i, stop, means, log_scales, quats, logits, sh, widths)
        mean, log_scale, quat, logit, width = geometry_at(block)
        # what is drawn, by the depth as it is kept
        store(block, SEEN * L, to_camera(lens, offset_from(lens, mean))[2])
        scatter_one(block, SEEN, depths, i, stop)
        for l in range(min(L, stop - i)):
            drawn[i + l] = depths[i + l] > lens.near
        gather_one(drawn, i, stop, block, SEEN)
        seen = load(block, SEEN * L) > 0.0
        # mean, conic and opacity
        opacity = sigmoid(logit)
        if widths is None:
            store_where(seen, block, SPLAT_AT, geometry(lens, mean, log_scale, quat))
        else:
            found = antialiased_geometry(lens, mean, log_scale, quat, width)
            store_where(seen, block, SPLAT_AT, found)
            opacity = opacity * found[5]
        # colours
        store_where(seen, block, HARMONICS, basis(direction_of(lens, mean)[0]))
        colour = (broadcast(block, 0.5), broadcast(block, 0.5), broadcast(block, 0.5))
        for k in range(bands):
            colour = plus(colour, scaled(load_all(block, (SH_AT + 3 * k) * L, 3), load(block, (HARMONICS + k) * L)))
        colour = max(colour[0], 0.0), max(colour[1], 0.0), max(colour[2], 0.0)
        store_where(seen, block, SPLAT_AT + 5, (opacity, *colour))
        scatter(block, SPLAT_AT, splats, 9, i, stop)


@kernel
def project_adjoint(
    start, stop, lens, means, log_scales, quats, logits, sh, widths, splats, drawn, bar,
    d_means, d_log_scales, d_quats, d_logits, d_sh,
):  # fmt: skip
    """The adjoints of the stored parameters, given that of the splats, bar (n, 9)."""
    bands, block = sh.shape[1], scratch(np.empty(0), ROWS * lanes(np.empty(0)))
    L = lanes(block)
    for i in range(start, stop, L):
        gather(bar, 9, i, stop, block, BAR)
        gather_one(drawn, i, stop, block, SEEN)
        splat_bar, size = load_all(block, BAR * L, 9), broadcast(block, 0.0)
        for j in range(9):
            size = size + abs(splat_bar[j])
        moves = (size != 0.0) & (load(block, SEEN * L) > 0.0)
        if any_lane(moves):
            gather_gaussians(block, i, stop, means, log_scales, quats, logits, sh, widths)
            gather(splats, 9, i, stop, block, SPLAT_AT)
            mean, log_scale, quat, logit, width = geometry_at(block)
            # the geometry, and the opacity's logit
            if widths is None:
                slope = 1.0 - load(block, (SPLAT_AT + 5) * L)
                m, s, q = geometry_adjoint(lens, mean, log_scale, quat, splat_bar)
            else:
                slope = sigmoid(-logit)
                factor_bar = with_factor(splat_bar, sigmoid(logit))
                m, s, q = antialiased_adjoint(lens, mean, log_scale, quat, width, factor_bar)
            store(block, LOGIT * L, select(moves, load(block, (SPLAT_AT + 5) * L) * slope * splat_bar[5], 0.0))
            # SH and the adjoint of the harmonics; a colour that is clamped at 0 passes nothing on
            colour_bar = clamped_bar(block, moves)
            store_where(moves, block, HARMONICS, basis(direction_of(lens, mean)[0]))
            for k in range(bands):
                at, harmonic = (SH_AT + 3 * k) * L, load(block, (HARMONICS + k) * L)
                store(block, (WEIGHT + k) * L, dot(load_all(block, at, 3), colour_bar))
                store_where(moves, block, SH_AT + 3 * k, scaled(colour_bar, harmonic))
            along = colour_adjoint(lens, mean, load_all(block, WEIGHT * L, 16), bands)
            store_where(moves, block, MEAN, plus(m, along))
            store_where(moves, block, LOG_SCALES, s)
            store_where(moves, block, QUAT, q)
        else:  # zeros
            for row in range(ROWS):
                store(block, row * L, broadcast(block, 0.0))
        scatter(block, MEAN, d_means, 3, i, stop)
        scatter(block, LOG_SCALES, d_log_scales, 3, i, stop)
        scatter(block, QUAT, d_quats, 4, i, stop)
        scatter_one(block, LOGIT, d_logits, i, stop)
        scatter(block, SH_AT, d_sh, 3 * bands, i, stop)


@formula
def clamped_bar(block, moves):
    """The adjoint of the colours before they are clamped at 0, and 0 where the mask does not hold."""
    L = lanes(block)
    colours, bars = load_all(block, (SPLAT_AT + 6) * L, 3), load_all(block, (BAR + 6) * L, 3)
    return (
        select((colours[0] > 0.0) & moves, bars[0], 0.0),
        select((colours[1] > 0.0) & moves, bars[1], 0.0),
        select((colours[2] > 0.0) & moves, bars[2], 0.0),
    )


@kernel
def add_screen_gradients(start, stop, means, conics, drawn, gradient, half_width, half_height, total, renders):
    """`projection.reference.add_screen_gradients`."""
    for i in range(start, stop):
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        det = max(a * c - b * b, TINY)
        x, y = abs(means[i, 0] - half_width), abs(means[i, 1] - half_height)
        if drawn[i] and x < half_width + 3 * sqrt(c / det) and y < half_height + 3 * sqrt(a / det):
            across, down = gradient[i, 0] * half_width, gradient[i, 1] * half_height
            total[i] += sqrt(across * across + down * down)
            renders[i] += 1


def project_arrays(gaussians: Gaussians, lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Splats (n, 9) in double precision, depths (n,) and which are drawn (n,)."""
    arrays = attribute_arrays(gaussians)
    n, dtype = len(gaussians), arrays[0].dtype
    splats, depths, drawn = np.empty((n, 9)), np.empty(n, dtype), np.empty(n, np.bool_)
    over_range(n, project_splats, lens, *arrays, width_array(gaussians, lens), splats, depths, drawn, least=LIGHT)
    require_sizes(lens, log_sizes(gaussians).numpy(), depths, drawn)
    return splats, depths, drawn
