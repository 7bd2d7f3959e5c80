"""Projection and SH as kernels: stored parameters of Gaussians -> splats of a view, and the adjoint: training's passes.

Values are computed in double precision, so that needles (condition number to 1e6) keep their conics in float32.  Splats are
(n, 9): `whitening.py`.  The second order is in `linear_cpu.py`.
"""

from math import exp

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.threads import over_range
from splat.model.gaussians import Gaussians
from splat.projection.antialias import antialiased_adjoint, antialiased_geometry, log_sizes, widths_of
from splat.projection.formulas import (
    Lens,
    basis,
    colour_adjoint,
    direction_of,
    geometry,
    geometry_adjoint,
    offset_from,
    to_camera,
)
from splat.projection.reference import require_sizes
from splat.projection.whitening import converted, put


def attribute_arrays(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    """The five attributes as NumPy views."""
    return tuple(value.detach().numpy() for value in gaussians.attributes.values())


def width_array(gaussians: Gaussians, lens: Lens) -> np.ndarray | None:
    """`widths_of` as a NumPy view."""
    widths = widths_of(gaussians, lens)
    return None if widths is None else widths.numpy()


@formula
def sigmoid(x):
    return 1.0 / (1.0 + exp(-x)) if x >= 0 else exp(x) / (1.0 + exp(x))


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
    for i in range(start, stop):
        put(out[i], converted(way, splats[i], six_of(numbers[i])))
        for c in range(6, 9):
            out[i, c] = numbers[i, c]


@kernel
def project_splats(start, stop, lens, means, log_scales, quats, logits, sh, widths, splats, depths, drawn):
    """Fill splats (n, 9), depths and drawn; a Gaussian behind the near plane gets an opacity of 0.

    widths: None where nothing is antialiased, for which a kernel of its own is compiled.
    """
    bands = sh.shape[1]
    for i in range(start, stop):
        mean = point(means, i)
        depths[i] = to_camera(lens, offset_from(lens, mean))[2]
        drawn[i] = depths[i] > lens.near
        for j in range(9):
            splats[i, j] = 0
        if drawn[i]:
            splats[i, 5] = sigmoid(np.float64(logits[i]))
            if widths is None:
                values = geometry(lens, mean, point(log_scales, i), quaternion(quats, i))
            else:
                width = np.float64(widths[i])
                found = antialiased_geometry(lens, mean, point(log_scales, i), quaternion(quats, i), width)
                values = found[:5]
                splats[i, 5] *= found[5]
            for j in range(5):
                splats[i, j] = values[j]
            harmonic = basis(direction_of(lens, mean)[0])
            for c in range(3):
                colour = 0.5
                for k in range(bands):
                    colour += harmonic[k] * sh[i, k, c]
                splats[i, 6 + c] = max(colour, 0.0)


@kernel
def project_adjoint(
    start, stop, lens, means, log_scales, quats, logits, sh, widths, splats, drawn, bar,
    d_means, d_log_scales, d_quats, d_logits, d_sh,
):  # fmt: skip
    """The adjoints of the stored parameters, given that of the splats, bar (n, 9); outputs start at 0."""
    bands = sh.shape[1]
    for i in range(start, stop):
        moves = False
        for j in range(9):
            moves |= bar[i, j] != 0
        if drawn[i] and moves:
            mean = point(means, i)
            opacity, splat_bar = np.float64(splats[i, 5]), six_of(bar[i])
            if widths is None:
                slope = 1.0 - opacity
                m, s, q = geometry_adjoint(lens, mean, point(log_scales, i), quaternion(quats, i), splat_bar)
            else:
                width, logit = np.float64(widths[i]), np.float64(logits[i])
                slope = sigmoid(-logit)
                m, s, q = antialiased_adjoint(
                    lens,
                    mean,
                    point(log_scales, i),
                    quaternion(quats, i),
                    width,
                    with_factor(splat_bar, sigmoid(logit)),
                )
            harmonic = basis(direction_of(lens, mean)[0])
            weight = np.zeros(16)
            for k in range(bands):
                for c in range(3):
                    colour_bar = bar[i, 6 + c] if splats[i, 6 + c] > 0 else 0.0
                    d_sh[i, k, c] = harmonic[k] * colour_bar
                    weight[k] += sh[i, k, c] * colour_bar
            along = colour_adjoint(lens, mean, weight, bands)
            for j in range(3):
                d_means[i, j] = m[j] + along[j]
                d_log_scales[i, j] = s[j]
            for j in range(4):
                d_quats[i, j] = q[j]
            d_logits[i] = opacity * slope * bar[i, 5]


def project_arrays(gaussians: Gaussians, lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Splats (n, 9) in double precision, depths (n,) and which are drawn (n,)."""
    arrays = attribute_arrays(gaussians)
    n, dtype = len(gaussians), arrays[0].dtype
    splats, depths, drawn = np.empty((n, 9)), np.empty(n, dtype), np.empty(n, np.bool_)
    over_range(n, project_splats, lens, *arrays, width_array(gaussians, lens), splats, depths, drawn)
    require_sizes(lens, log_sizes(gaussians).numpy(), depths, drawn)
    return splats, depths, drawn
