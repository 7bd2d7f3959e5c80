"""The projection P of one view, linearised: products of its first and second derivatives with K vectors at a time.

For each Gaussian at an index (m,), a `ProjectionJacobian` keeps the Jacobian of its splat in its stored parameters, and the
curvature (a . P''), a the first-order adjoint of its splat.  The colour is linear in SH: its derivatives are the harmonics at
the view direction and their slope in the mean, so a Gaussian takes 179 numbers in place of 9 x 59 and 59 x 59; 20 more where it
is antialiased.

Tangents d_... and adjoints out_... of the stored parameters are (n, numbers of the attribute..., K): views of a (p, K) array
laid out like `Gaussians.flat`.  Tangents and adjoints of splats are (n, K, 9), in the coordinates of `whitening.py`.  In loops,
e counts rows of the Jacobian, i Gaussians, k vectors.
"""

from math import prod

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from splat.backend.cpu.dual import DIRECTIONS, tangent_of, value_of, variable
from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import scratch
from splat.backend.cpu.simd import lanes, load, store
from splat.backend.cpu.threads import over_range
from splat.model.gaussians import Gaussians, attribute_shapes
from splat.projection.antialias import antialiased_adjoint, antialiased_geometry
from splat.projection.cpu import attribute_arrays, point, quaternion, sigmoid, six_of, width_array, with_factor
from splat.projection.formulas import (
    GEOMETRY,
    Lens,
    ProjectionJacobian,
    basis,
    colour_adjoint,
    direction_of,
    geometry,
    geometry_adjoint,
    row_shapes,
)
from splat.projection.whitening import cancellation, geometry_coefficients, plain_gradient, put, whitening

LEAST_CANCELLATION = 4.0  # `cancellation` above which tangents take double precision
FEW = 64  # Gaussians that `affects` tests before it tests all
ROW = 16  # numbers of a row of J in `chain_blocks`: GEOMETRY, the logit, and zeros to whole vectors


@formula
def variables(like, mean, log_scales, quat):
    """A Gaussian's mean, log-scales and quaternion as dual numbers; like: an array of the tangents' dtype."""
    x = (variable(like, mean[0], 0), variable(like, mean[1], 1), variable(like, mean[2], 2))
    s = (variable(like, log_scales[0], 3), variable(like, log_scales[1], 4), variable(like, log_scales[2], 5))
    q = (variable(like, quat[0], 6), variable(like, quat[1], 7), variable(like, quat[2], 8), variable(like, quat[3], 9))
    return x, s, q


@kernel
def linearize_geometry(lens, W, like, mean, log_scales, quat, bar, jacobian, curvature):
    """Fill a Gaussian's jacobian (5, 10) and packed curvature (55,); bar: plain adjoint of its splat; like: of `variables`."""
    x, s, q = variables(like, mean, log_scales, quat)
    tangents = np.empty((5, DIRECTIONS), like.dtype)
    values = geometry(lens, x, s, q)
    for j in range(5):
        store(tangents.reshape(-1), j * DIRECTIONS, tangent_of(values[j]))
    for k in range(GEOMETRY):
        put(jacobian[:, k], geometry_coefficients(W, tangents[:, k]))
    pack_curvature(geometry_adjoint(lens, x, s, q, bar), tangents, curvature)


@formula
def pack_curvature(adjoint, tangents, curvature):
    """Fill curvature (55,) with the lower triangle of the tangents of the geometry's ten adjoints, which are dual numbers."""
    m, t, r = adjoint
    rows = (m[0], m[1], m[2], t[0], t[1], t[2], r[0], r[1], r[2], r[3])
    place = 0
    for j in range(GEOMETRY):
        store(tangents.reshape(-1), 0, tangent_of(rows[j]))
        for k in range(j + 1):
            curvature[place + k] = tangents[0, k]
        place += j + 1


@kernel
def linearize_antialiased(
    lens, W, mean, log_scales, quat, logit, width, bar, jacobian, curvature, opacity_slope, opacity_curvature
):
    """`linearize_geometry` of an antialiased Gaussian, in double precision, and the derivatives of its opacity.

    Its opacity is sigmoid(logit) times a factor of the geometry (`antialias.py`).  bar[5]: S / opacity, S the adjoint of
    q = ln alpha.  opacity_slope: d ln(factor) in the geometry; opacity_curvature: S (1 - sigmoid(logit)) times it, the mixed
    second derivative with the logit.
    """
    like = np.empty(0)
    x, s, q = variables(like, mean, log_scales, quat)
    tangents = np.empty((6, DIRECTIONS))
    values = antialiased_geometry(lens, x, s, q, width)
    for j in range(6):
        store(tangents.reshape(-1), j * DIRECTIONS, tangent_of(values[j]))
    factor, unfiltered = value_of(values[5]), sigmoid(logit)
    S = unfiltered * factor * bar[5]
    for k in range(GEOMETRY):
        put(jacobian[:, k], geometry_coefficients(W, tangents[:5, k]))
        opacity_slope[k] = tangents[5, k] / factor if factor > 0 else 0.0
        opacity_curvature[k] = S * sigmoid(-logit) * opacity_slope[k]
    pack_curvature(antialiased_adjoint(lens, x, s, q, width, with_factor(bar, unfiltered)), tangents, curvature)


@formula
def linearize_colour(lens, mean, x, colour_weight, bands, curvature, harmonic, slope):
    """Fill one Gaussian's harmonics (16,) and their slope in the mean (16, 3); add the colour's part to its curvature.

    x: the mean as dual numbers; colour_weight: (16,) the adjoint of the harmonics, sum_c sh[k, c] colour_bar[c].
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
def linearize_gaussian(lens, W, mean, log_scales, quat, bar, jacobian, curvature):
    """`linearize_geometry` with tangents in double precision for slanted needles, in that of the parameters for others.

    Tangents of a needle lose digits by cancellation, by the factor a c / (a c - b^2) of its conic, in whitening as well as in
    `geometry_adjoint`.
    """
    if cancellation(W) > LEAST_CANCELLATION:
        linearize_geometry(lens, W, np.empty(0), mean, log_scales, quat, bar, jacobian, curvature)
    else:
        linearize_geometry(lens, W, jacobian, mean, log_scales, quat, bar, jacobian, curvature)


@kernel
def linearize_all(start, stop, jac, lens, means, log_scales, quats, logits, sh, widths, splats, moments):
    """Fill rows of a `ProjectionJacobian`.  moments (n, 9): adjoint of the splats; widths: as for `project_splats`."""
    bands = sh.shape[1]
    for e in range(start, stop):
        i = jac.index[e]
        weight = np.zeros(16)
        for c in range(3):
            jac.visible[e, c] = 1.0 if splats[i, 6 + c] > 0 else 0.0
            jac.colour_bar[e, c] = jac.visible[e, c] * moments[i, 6 + c]
            for k in range(bands):
                weight[k] += sh[i, k, c] * jac.colour_bar[e, c]
        # the geometry, in whitened coordinates; bar: the adjoint in plain ones
        mean, log_scale, quat, W = point(means, i), point(log_scales, i), quaternion(quats, i), whitening(splats[i])
        opacity = splats[i, 5]
        bar = plain_gradient(W, opacity, six_of(moments[i]))
        # first derivatives and (a . P'') of mean, scales and quaternion; antialiased: of the opacity's factor too
        if widths is None:
            linearize_gaussian(lens, W, mean, log_scale, quat, bar, jac.jacobian[e], jac.curvature[e])
        else:
            width, logit = np.float64(widths[i]), np.float64(logits[i])
            opacity = sigmoid(logit)
            linearize_antialiased(
                lens, W, mean, log_scale, quat, logit, width, bar, jac.jacobian[e], jac.curvature[e],
                jac.opacity_slope[e], jac.opacity_curvature[e],
            )  # fmt: skip
        # the opacity's logit
        jac.logit_slope[e] = 1 - opacity
        jac.logit_curvature[e] = (1 - opacity) * (1 - 2 * opacity) * moments[i, 0]
        # the colour: harmonics, their slopes in the mean, and what they add to (a . P'')
        x, _s, _q = variables(jac.slope, mean, log_scale, quat)
        linearize_colour(lens, mean, x, weight, bands, jac.curvature[e], jac.harmonic[e], jac.slope[e])
        for c in range(3):
            for j in range(3):
                total = 0.0
                for k in range(bands):
                    total += sh[i, k, c] * jac.slope[e, k, j]
                jac.colour_slope[e, c, j] = total


@formula
def gather_tangent(u, i, k, d_means, d_log_scales, d_quats):
    """Fill u (10,) with the geometry of Gaussian i in vector k."""
    for j in range(3):
        u[j], u[3 + j] = d_means[i, j, k], d_log_scales[i, j, k]
    for j in range(4):
        u[6 + j] = d_quats[i, j, k]


@formula
def unpack_curvature(packed, curvature):
    """Fill the symmetric curvature (10, 10) from its lower triangle; see `pack_curvature`."""
    place = 0
    for j in range(GEOMETRY):
        for l in range(j + 1):
            curvature[j, l] = curvature[l, j] = packed[place + l]
        place += j + 1


@kernel
def push_forward(start, stop, jac, d_means, d_log_scales, d_quats, d_logits, d_sh, out):
    """Write P' u of K vectors to out (n, K, 9); rows of other Gaussians stay as they are."""
    K, bands = out.shape[1], d_sh.shape[1]
    u = np.empty(GEOMETRY, out.dtype)
    for e in range(start, stop):
        i = jac.index[e]
        for k in range(K):
            gather_tangent(u, i, k, d_means, d_log_scales, d_quats)
            # ln opacity
            out[i, k, 0] = jac.logit_slope[e] * d_logits[i, k]
            for j in range(jac.opacity_slope.shape[1]):
                out[i, k, 0] += jac.opacity_slope[e, j] * u[j]
            # the five whitened coefficients of mean and conic
            for r in range(5):
                total = out.dtype.type(0)
                for j in range(GEOMETRY):
                    total += jac.jacobian[e, r, j] * u[j]
                out[i, k, 1 + r] = total
            # colours: by the direction to the mean, and by SH
            for c in range(3):
                total = out.dtype.type(0)
                for j in range(3):
                    total += jac.colour_slope[e, c, j] * u[j]
                for b in range(bands):
                    total += jac.harmonic[e, b] * d_sh[i, b, c, k]
                out[i, k, 6 + c] = jac.visible[e, c] * total


@formula
def pull_back_geometry(jac, e, y, bar, h):
    """Fill h (10,) with P'^T y in a Gaussian's geometry.  y (9,): cotangent of its splat; bar (3,): of its colour unclamped."""
    h[:] = 0
    for r in range(5):
        for j in range(GEOMETRY):
            h[j] += jac.jacobian[e, r, j] * y[1 + r]
    for c in range(3):
        for j in range(3):
            h[j] += jac.colour_slope[e, c, j] * bar[c]
    for j in range(jac.opacity_slope.shape[1]):
        h[j] += jac.opacity_slope[e, j] * y[0]


@formula
def add_curvature(jac, e, curvature, u, d_logit, h, logit):
    """Add (a . P'') of geometry and logit, times their tangents u (10,) and d_logit, to h; return logit with its share."""
    for j in range(jac.opacity_curvature.shape[1]):
        h[j] += jac.opacity_curvature[e, j] * d_logit
        logit += jac.opacity_curvature[e, j] * u[j]
    for j in range(GEOMETRY):
        for l in range(GEOMETRY):
            h[l] += curvature[j, l] * u[j]
    return logit + jac.logit_curvature[e] * d_logit


@kernel
def pull_back(
    start, stop, jac, second_order, cotangents, d_means, d_log_scales, d_quats, d_logits, d_sh,
    out_means, out_log_scales, out_quats, out_logits, out_sh,
):  # fmt: skip
    """Add P'^T y for cotangents y (n, K, 9), plus (a . P'') u for vectors u (d_...) where second_order, to out_...

    Without second_order the d_... are read, but not used.
    """
    K, bands = cotangents.shape[1], out_sh.shape[1]
    u, h, bar = np.empty(GEOMETRY, out_means.dtype), np.empty(GEOMETRY, out_means.dtype), np.empty(3, out_means.dtype)
    curvature = np.empty((GEOMETRY, GEOMETRY), out_means.dtype)  # h: the result in a Gaussian's geometry
    for e in range(start, stop):
        i = jac.index[e]
        if second_order:
            unpack_curvature(jac.curvature[e], curvature)
        for k in range(K):
            y = cotangents[i, k]
            gather_tangent(u, i, k, d_means, d_log_scales, d_quats)
            # P'^T y in logit and geometry
            for c in range(3):
                bar[c] = jac.visible[e, c] * y[6 + c]
            logit = jac.logit_slope[e] * y[0]
            pull_back_geometry(jac, e, y, bar, h)
            if second_order:
                logit = add_curvature(jac, e, curvature, u, d_logits[i, k], h, logit)
            out_logits[i, k] += logit
            # SH: P'^T y, and the mixed second derivatives of SH and mean both ways
            for b in range(bands):
                slope, weight = jac.slope[e, b], out_means.dtype.type(0)
                along = slope[0] * u[0] + slope[1] * u[1] + slope[2] * u[2]
                for c in range(3):
                    total = jac.harmonic[e, b] * bar[c]
                    if second_order:
                        total += jac.colour_bar[e, c] * along
                        weight += jac.colour_bar[e, c] * d_sh[i, b, c, k]
                    out_sh[i, b, c, k] += total
                for j in range(3):
                    h[j] += slope[j] * weight
            for j in range(3):
                out_means[i, j, k] += h[j]
                out_log_scales[i, j, k] += h[3 + j]
            for j in range(4):
                out_quats[i, j, k] += h[6 + j]


@formula
def weigh_rows(weights, step, first, rows, out, to):
    """Write sum_s weights[step s + first] rows[s] over the rows (9, ROW), flat, to out from `to` on."""
    L = lanes(rows)
    for at in range(0, ROW, L):
        total = load(rows, at) * weights[first]
        for s in range(1, 9):
            total += load(rows, s * ROW + at) * weights[step * s + first]
        store(out, to + at, total)


@kernel
def chain_blocks(start, stop, jac, blocks, second_order, geometry_out, sh_out):
    """Write P'^T B P' for diagonal blocks B (m, 9, 9) of splats, plus (a . P'') where second_order.

    geometry_out: (n, 11, 11) over mean, log-scales, quaternion and opacity logit.  sh_out: (n, bands, 3), the diagonal for SH.
    """
    bands, doubles = sh_out.shape[1], np.zeros(0)
    J, product, row = scratch(doubles, 9 * ROW), scratch(doubles, 9 * ROW), scratch(doubles, ROW)
    J[:] = 0
    for e in range(start, stop):
        i = jac.index[e]
        # J: the rows of P' over geometry and logit, one for each of the splat's nine numbers, and zeros behind
        J[GEOMETRY] = jac.logit_slope[e]
        for r in range(5):
            for j in range(GEOMETRY):
                J[(1 + r) * ROW + j] = jac.jacobian[e, r, j]
        for j in range(jac.opacity_slope.shape[1]):
            J[j] = jac.opacity_slope[e, j]
        for c in range(3):
            for j in range(3):
                J[(6 + c) * ROW + j] = jac.visible[e, c] * jac.colour_slope[e, c, j]
            for b in range(bands):
                sh_out[i, b, c] = jac.visible[e, c] * jac.harmonic[e, b] * jac.harmonic[e, b] * blocks[e, 6 + c, 6 + c]
        # B J, then J^T B J, row by row
        for r in range(9):
            weigh_rows(blocks[e, r], 1, 0, J, product, r * ROW)
        for j in range(GEOMETRY + 1):
            weigh_rows(J, ROW, j, product, row, 0)
            for k in range(j + 1):
                if second_order and j < GEOMETRY:
                    row[k] += jac.curvature[e, j * (j + 1) // 2 + k]
                geometry_out[i, j, k] = geometry_out[i, k, j] = row[k]
        # (a . P'') of the logit, and of the logit with the geometry
        if second_order:
            geometry_out[i, GEOMETRY, GEOMETRY] += jac.logit_curvature[e]
            for j in range(jac.opacity_curvature.shape[1]):
                geometry_out[i, GEOMETRY, j] += jac.opacity_curvature[e, j]
                geometry_out[i, j, GEOMETRY] = geometry_out[i, GEOMETRY, j]


class CpuProjection:
    """The projection of one view, linearised: `projection.protocols.Projection` by Numba kernels, on NumPy views of tensors."""

    def __init__(
        self,
        gaussians: Gaussians,
        lens: Lens,
        splats: Float64[Tensor, "n 9"],
        moments: Float[Tensor, "n 9"],
        index: Int[Tensor, " m"],
    ):
        inputs, widths = attribute_arrays(gaussians), width_array(gaussians, lens)
        self.n, self.sh_degree, self.parameters = len(gaussians), gaussians.sh_degree, gaussians.flat.numel()
        self._shapes = tuple(attribute_shapes(self.n, self.sh_degree).values())
        rows = row_shapes(antialiased=widths is not None)
        self._jacobian = ProjectionJacobian(
            index.numpy(), *(np.empty((len(index), *row), inputs[0].dtype) for row in rows)
        )
        arguments = (lens, *inputs, widths, splats.numpy(), moments.numpy())
        over_range(len(index), linearize_all, self._jacobian, *arguments)

    @property
    def jacobian(self) -> ProjectionJacobian:
        return ProjectionJacobian(*map(torch.from_numpy, self._jacobian))

    @property
    def bytes(self) -> int:
        return sum(array.nbytes for array in self._jacobian)

    def affects(self, block: Float[Tensor, "p k"]) -> bool:
        """Whether any vector is non-zero at a Gaussian of the index; the first FEW usually decide."""
        index, parts = self._jacobian.index, self._split(block.numpy())
        return any(part[rows].any() for rows in (index[:FEW], index) for part in parts)

    def jvp(self, block: Float[Tensor, "p k"]) -> Float[Tensor, "n k 9"]:
        out = np.zeros((self.n, block.shape[1], 9), self._jacobian.jacobian.dtype)
        over_range(len(self._jacobian.index), push_forward, self._jacobian, *self._split(block.numpy()), out)
        return torch.from_numpy(out)

    def vjp(
        self,
        cotangents: Float[Tensor, "n k 9"],
        block: Float[Tensor, "p k"] | None = None,
        total: Float[Tensor, "p k"] | None = None,
    ) -> Float[Tensor, "p k"]:
        if total is None:
            total = torch.from_numpy(np.zeros((self.parameters, cotangents.shape[1]), self._jacobian.jacobian.dtype))
        outputs = self._split(total.numpy())
        tangents = outputs if block is None else self._split(block.numpy())
        arguments = (block is not None, cotangents.numpy(), *tangents, *outputs)
        over_range(len(self._jacobian.index), pull_back, self._jacobian, *arguments)
        return total

    def blocks(
        self, blocks: Float64[Tensor, "m 9 9"], second_order: bool
    ) -> tuple[Float[Tensor, "n 11 11"], Float[Tensor, "n b 3"]]:
        shapes = ((GEOMETRY + 1, GEOMETRY + 1), ((self.sh_degree + 1) ** 2, 3))
        geometry, sh = (np.zeros((self.n, *shape), self._jacobian.jacobian.dtype) for shape in shapes)
        over_range(len(self._jacobian.index), chain_blocks, self._jacobian, blocks.numpy(), second_order, geometry, sh)
        return torch.from_numpy(geometry), torch.from_numpy(sh)

    def _split(self, block: np.ndarray) -> tuple[np.ndarray, ...]:
        """Views of a (p, K) block laid out like the flat vector: (n, 3, K), (n, 3, K), (n, 4, K), (n, K), (n, b, 3, K)."""
        block, views, start = np.ascontiguousarray(block), [], 0
        for shape in self._shapes:
            size = prod(shape)
            views.append(block[start : start + size].reshape(*shape, block.shape[1]))
            start += size
        return tuple(views)
