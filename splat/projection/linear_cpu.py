"""The projection of one view held still: first and second derivatives as products with blocks of vectors.

Per Gaussian that matters, the Jacobian of the map from its stored parameters to its splat and the curvature `(a . P'')`, a the
first-order adjoint of its splat.  SH enters the colour linearly: its derivatives are the harmonics at the view direction and
their slope in the mean, so a Gaussian needs 179 numbers, not a dense 9 x 59 and 59 x 59.

Tangents and adjoints of the stored parameters are (n, parameters of a Gaussian..., K) per attribute: views of a (p, K) block
that is laid out like the flat vector.  Splats are (n, 9), tangents of splats (n, K, 9): `raster/packing.py`.
"""

from math import prod

import numpy as np

from splat.backend.cpu.dual import DIRECTIONS, tangent_of, variable
from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import store
from splat.backend.cpu.threads import over_range
from splat.model.gaussians import Gaussians, attribute_shapes
from splat.projection.cpu import attribute_arrays, point, quaternion
from splat.projection.formulas import (
    GEOMETRY,
    SYMMETRIC,
    Lens,
    ProjectionJacobian,
    add_symmetric,
    basis,
    colour_adjoint,
    direction_of,
    geometry,
    geometry_adjoint,
)
from splat.projection.whitening import cancellation, plain, put, whitened, whitened_adjoint, whitening

LEAST_CANCELLATION = 4.0  # from which on tangents take double precision


@formula
def variables(like, mean, log_scales, quat):
    """The ten numbers of a Gaussian's geometry as variables; like: an array of the tangents' dtype."""
    x = (variable(like, mean[0], 0), variable(like, mean[1], 1), variable(like, mean[2], 2))
    s = (variable(like, log_scales[0], 3), variable(like, log_scales[1], 4), variable(like, log_scales[2], 5))
    q = (variable(like, quat[0], 6), variable(like, quat[1], 7), variable(like, quat[2], 8), variable(like, quat[3], 9))
    return x, s, q


@kernel
def linearize_geometry(lens, W, like, mean, log_scales, quat, bar, jacobian, curvature):
    """One Gaussian's whitened Jacobian (5, 10) and the packed curvature (55,) of its geometry; like: of the tangents' dtype."""
    x, s, q = variables(like, mean, log_scales, quat)
    tangents = np.empty((5, DIRECTIONS), like.dtype)
    values = geometry(lens, x, s, q)
    for j in range(5):
        store(tangents.reshape(-1), j * DIRECTIONS, tangent_of(values[j]))
    for k in range(GEOMETRY):
        put(jacobian[:, k], whitened(W, tangents[:, k]))
    m, t, r = geometry_adjoint(lens, x, s, q, bar)
    rows = (m[0], m[1], m[2], t[0], t[1], t[2], r[0], r[1], r[2], r[3])
    place = 0
    for j in range(GEOMETRY):
        store(tangents.reshape(-1), 0, tangent_of(rows[j]))
        for k in range(j + 1):
            curvature[place + k] = tangents[0, k]
        place += j + 1


@formula
def linearize_colour(lens, mean, x, colour_weight, bands, curvature, harmonic, slope):
    """One Gaussian's harmonics (16,), their derivative in the mean (16, 3), and what the colours add to its curvature.

    colour_weight: (16,) the adjoint of the direction's harmonics, sum_c sh[k, c] colour_bar[c].
    """
    tangents = np.empty(DIRECTIONS, slope.dtype)
    along = colour_adjoint(lens, x, colour_weight, bands)
    for j in range(3):
        store(tangents, 0, tangent_of(along[j]))
        for k in range(j + 1):
            curvature[j * (j + 1) // 2 + k] += tangents[k]
    values, harmonics = basis(direction_of(lens, mean)[0]), basis(direction_of(lens, x)[0])
    for k in range(16):
        harmonic[k] = values[k]
        store(tangents, 0, tangent_of(harmonics[k]))
        for j in range(3):
            slope[k, j] = tangents[j]


@kernel
def linearize_gaussian(
    lens, mean, log_scales, quat, splat, colour_weight, bands, bar, jacobian, curvature, harmonic, slope
):
    """One Gaussian's rows of `Held`; bar: five geometric adjoints.

    The geometry of a slanted needle has tangents in double precision: they cancel by a c / (a c - b^2), in whitening as well as
    in `geometry_adjoint`.
    """
    W = whitening(splat)
    if cancellation(W) > LEAST_CANCELLATION:
        linearize_geometry(lens, W, np.empty(0), mean, log_scales, quat, bar, jacobian, curvature)
    else:
        linearize_geometry(lens, W, slope, mean, log_scales, quat, bar, jacobian, curvature)
    x, _s, _q = variables(slope, mean, log_scales, quat)
    linearize_colour(lens, mean, x, colour_weight, bands, curvature, harmonic, slope)


@kernel
def linearize_all(start, stop, held, lens, means, log_scales, quats, sh, bar):
    """Fill the arrays of `Projection` for the Gaussians at index; bar (n, 9) is the adjoint of the splats."""
    bands = sh.shape[1]
    for e in range(start, stop):
        i = held.index[e]
        weight = np.zeros(16)
        for c in range(3):
            held.visible[e, c] = 1.0 if held.splats[i, 6 + c] > 0 else 0.0
            held.colour_bar[e, c] = held.visible[e, c] * bar[i, 6 + c]
            for k in range(bands):
                weight[k] += sh[i, k, c] * held.colour_bar[e, c]
        bars = (
            np.float64(bar[i, 0]), np.float64(bar[i, 1]), np.float64(bar[i, 2]),
            np.float64(bar[i, 3]), np.float64(bar[i, 4]),
        )  # fmt: skip
        linearize_gaussian(
            lens, point(means, i), point(log_scales, i), quaternion(quats, i), held.splats[i], weight, bands, bars,
            held.jacobian[e], held.curvature[e], held.harmonic[e], held.slope[e],
        )  # fmt: skip
        for c in range(3):
            for j in range(3):
                total = 0.0
                for k in range(bands):
                    total += sh[i, k, c] * held.slope[e, k, j]
                held.colour_slope[e, c, j] = total


@kernel
def push_forward(start, stop, held, d_means, d_log_scales, d_quats, d_logits, d_sh, out):
    """P' u: out (n, K, 9), which starts at 0."""
    K, bands = out.shape[1], d_sh.shape[1]
    y = np.empty(5, d_means.dtype)
    for e in range(start, stop):
        i = held.index[e]
        W, opacity = whitening(held.splats[i]), held.splats[i, 5]
        for k in range(K):
            for r in range(5):
                J = held.jacobian[e, r]
                total = J[6] * d_quats[i, 0, k] + J[9] * d_quats[i, 3, k]
                total += J[7] * d_quats[i, 1, k] + J[8] * d_quats[i, 2, k]
                for j in range(3):
                    total += J[j] * d_means[i, j, k] + J[3 + j] * d_log_scales[i, j, k]
                y[r] = total
            put(out[i, k], plain(W, y))
            out[i, k, 5] = opacity * (1 - opacity) * d_logits[i, k]
            for c in range(3):
                total = d_means.dtype.type(0)
                for j in range(3):
                    total += held.colour_slope[e, c, j] * d_means[i, j, k]
                for b in range(bands):
                    total += held.harmonic[e, b] * d_sh[i, b, c, k]
                out[i, k, 6 + c] = held.visible[e, c] * total


@kernel
def pull_back(
    start, stop, held, second_order, cotangents, d_means, d_log_scales, d_quats, d_logits, d_sh,
    out_means, out_log_scales, out_quats, out_logits, out_sh,
):  # fmt: skip
    """P'^T of cotangents (n, K, 9), plus (a . P'') u where second_order; added to the outputs."""
    K, bands = cotangents.shape[1], out_sh.shape[1]
    y = np.empty(9, out_means.dtype)
    for e in range(start, stop):
        i = held.index[e]
        W, opacity = whitening(held.splats[i]), held.splats[i, 5]
        slope_of_opacity = opacity * (1 - opacity)
        u, h = np.empty(GEOMETRY, out_means.dtype), np.empty(GEOMETRY, out_means.dtype)
        for k in range(K):
            put(y, whitened_adjoint(W, cotangents[i, k]))
            for c in range(5, 9):
                y[c] = cotangents[i, k, c]
            for j in range(GEOMETRY):
                h[j] = 0
                for r in range(5):
                    h[j] += held.jacobian[e, r, j] * y[r]
            logit = slope_of_opacity * y[5]
            for c in range(3):
                bar = held.visible[e, c] * y[6 + c]
                for j in range(3):
                    h[j] += held.colour_slope[e, c, j] * bar
                for b in range(bands):
                    out_sh[i, b, c, k] += held.harmonic[e, b] * bar
            if second_order:
                for j in range(3):
                    u[j], u[3 + j] = d_means[i, j, k], d_log_scales[i, j, k]
                for j in range(4):
                    u[6 + j] = d_quats[i, j, k]
                add_symmetric(held.curvature[e], u, h)
                logit += slope_of_opacity * (1 - 2 * opacity) * held.opacity_bar[i] * d_logits[i, k]
                for b in range(bands):
                    weight, along = out_means.dtype.type(0), out_means.dtype.type(0)
                    for c in range(3):
                        weight += held.colour_bar[e, c] * d_sh[i, b, c, k]
                    for j in range(3):
                        h[j] += held.slope[e, b, j] * weight
                        along += held.slope[e, b, j] * u[j]
                    for c in range(3):
                        out_sh[i, b, c, k] += held.colour_bar[e, c] * along
            for j in range(3):
                out_means[i, j, k] += h[j]
                out_log_scales[i, j, k] += h[3 + j]
            for j in range(4):
                out_quats[i, j, k] += h[6 + j]
            out_logits[i, k] += logit


@kernel
def chain_blocks(start, stop, held, own, curved, geometry_out, sh_out):
    """Own blocks of splats, (m, 9, 9), in stored parameters: P'^T own P', plus (a . P'') where curved.

    geometry_out: (n, 11, 11) over mean, log-scales, quaternion and opacity logit; sh_out: (n, k, 3), the diagonal of SH's.
    Both are added to.
    """
    bands = sh_out.shape[1]
    J, product = np.zeros((9, GEOMETRY + 1)), np.zeros(9)
    for e in range(start, stop):
        i = held.index[e]
        opacity = np.float64(held.splats[i, 5])
        slope = opacity * (1 - opacity)
        J[5, GEOMETRY] = slope
        W = whitening(held.splats[i])
        for j in range(GEOMETRY):
            put(J[:, j], plain(W, held.jacobian[e, :, j]))
        for c in range(3):
            for j in range(3):
                J[6 + c, j] = held.visible[e, c] * held.colour_slope[e, c, j]
            for b in range(bands):
                sh_out[i, b, c] += held.visible[e, c] * held.harmonic[e, b] * held.harmonic[e, b] * own[e, 6 + c, 6 + c]
        for j in range(GEOMETRY + 1):
            for r in range(9):
                product[r] = 0
                for s in range(9):
                    product[r] += own[e, r, s] * J[s, j]
            for k in range(j + 1):
                total = 0.0
                for r in range(9):
                    total += J[r, k] * product[r]
                if curved and j < GEOMETRY:
                    total += held.curvature[e, j * (j + 1) // 2 + k]
                geometry_out[i, j, k] += total
                if k < j:
                    geometry_out[i, k, j] += total
        if curved:
            geometry_out[i, GEOMETRY, GEOMETRY] += slope * (1 - 2 * opacity) * held.opacity_bar[i]


class Projection:
    """The map from stored parameters to the splats of one view, held still at the Gaussians and at an adjoint of the splats.

    index: the Gaussians that matter (those that touch a pixel); bar: (n, 9), the adjoint of the splats.
    """

    def __init__(self, gaussians: Gaussians, lens: Lens, splats: np.ndarray, bar: np.ndarray, index: np.ndarray):
        means, log_scales, quats, _logits, sh = attribute_arrays(gaussians)
        self.n, self.sh_degree, self.parameters = len(gaussians), gaussians.sh_degree, gaussians.flat.numel()
        m = index.size

        def empty(*shape: int) -> np.ndarray:
            return np.empty((m, *shape), means.dtype)

        self.held = ProjectionJacobian(
            index, splats, np.ascontiguousarray(bar[:, 5]), empty(5, GEOMETRY), empty(SYMMETRIC), empty(16), empty(16, 3),
            empty(3), empty(3), empty(3, 3),
        )  # fmt: skip
        over_range(m, linearize_all, self.held, lens, means, log_scales, quats, sh, bar)

    @property
    def bytes(self) -> int:
        """Memory of what is held per Gaussian in sight."""
        return sum(array.nbytes for array in self.held[3:])

    def affects(self, block: np.ndarray) -> bool:
        """Whether a vector of a block (p, K) moves any of the Gaussians that matter."""
        return any(part[self.held.index].any() for part in self._split(block))

    def jvp(self, block: np.ndarray) -> np.ndarray:
        """P' U: (n, K, 9) from a block (p, K) of tangents of the stored parameters."""
        out = np.zeros((self.n, block.shape[1], 9))
        over_range(self.held.index.size, push_forward, self.held, *self._split(block), out)
        return out

    def pull(self, cotangents: np.ndarray, block: np.ndarray | None) -> np.ndarray:
        """P'^T cotangents (p, K) from (n, K, 9), plus (a . P'') block where a block (p, K) is given."""
        out = np.zeros((self.parameters, cotangents.shape[1]), self.held.jacobian.dtype)
        outputs = self._split(out)
        tangents = outputs if block is None else self._split(block)
        over_range(self.held.index.size, pull_back, self.held, block is not None, cotangents, *tangents, *outputs)
        return out

    def blocks(self, own: np.ndarray, curved: bool) -> tuple[np.ndarray, np.ndarray]:
        """The blocks of splats, own (m, 9, 9), in stored parameters: `chain_blocks`."""
        dtype = self.held.jacobian.dtype
        geometry = np.zeros((self.n, GEOMETRY + 1, GEOMETRY + 1), dtype)
        sh = np.zeros((self.n, (self.sh_degree + 1) ** 2, 3), dtype)
        over_range(self.held.index.size, chain_blocks, self.held, own, curved, geometry, sh)
        return geometry, sh

    def _split(self, block: np.ndarray) -> tuple[np.ndarray, ...]:
        """Views of a (p, K) block laid out like the flat vector: (n, 3, K), (n, 3, K), (n, 4, K), (n, K), (n, k, 3, K)."""
        block, views, start = np.ascontiguousarray(block), [], 0
        for shape in attribute_shapes(self.n, self.sh_degree).values():
            size = prod(shape)
            views.append(block[start : start + size].reshape(*shape, block.shape[1]))
            start += size
        return tuple(views)
