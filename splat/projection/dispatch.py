"""The interface of the projections, and the choice of one for the device of the Gaussians: Numba kernels, or Triton's on a GPU.

Splats are (n, 9), in double precision; their tangents and adjoints, in plain coordinates or others: `whitening.py`.  Blocks of
vectors (p, k) are laid out like `Gaussians.flat`.
"""

from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from splat.backend.cpu.threads import over_range
from splat.backend.device import by_triton
from splat.model.gaussians import Gaussians
from splat.projection import cpu
from splat.projection.formulas import Lens, ProjectionJacobian
from splat.projection.linear_cpu import CpuProjection
from splat.projection.whitening import COEFFICIENTS, MOMENTS, PLAIN_GRADIENT, PLAIN_TANGENT


class Projection(Protocol):
    """The map P from stored parameters to the splats of one view, linearised where an adjoint a of the splats is given.

    Tangents and adjoints of splats are coefficients and moments (`whitening.py`), in the precision of the parameters.
    """

    @property
    def jacobian(self) -> ProjectionJacobian:
        """The derivatives, Gaussian by Gaussian, as tensors."""
        ...

    @property
    def bytes(self) -> int:
        """Memory of what is kept."""
        ...

    def affects(self, block: Float[Tensor, "p k"]) -> bool:
        """Whether a vector moves any of the Gaussians at index; on a GPU always True, since to look is to wait for it."""
        ...

    def jvp(self, block: Float[Tensor, "p k"]) -> Float[Tensor, "n k 9"]:
        """P' U; 0 for Gaussians that are not at index."""
        ...

    def vjp(
        self,
        cotangents: Float[Tensor, "n k 9"],
        block: Float[Tensor, "p k"] | None = None,
        total: Float[Tensor, "p k"] | None = None,
    ) -> Float[Tensor, "p k"]:
        """P'^T cotangents, plus (a . P'') block where a block is given; added to total, where that is given, in its place."""
        ...

    def blocks(
        self, blocks: Float64[Tensor, "m 9 9"], second_order: bool
    ) -> tuple[Float[Tensor, "n 11 11"], Float[Tensor, "n b 3"]]:
        """Diagonal blocks of the splats at index in stored parameters: P'^T B P', plus (a . P'') where second_order.

        Over mean, log-scales, quaternion and opacity logit; and the diagonal of the SH block.
        """
        ...


def projected(
    gaussians: Gaussians, lens: Lens
) -> tuple[Float64[Tensor, "n 9"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Splats, depths in the precision of the parameters, and which are drawn; ValueError as `require_sizes`."""
    if by_triton(gaussians.flat):
        from splat.projection import cuda

        return cuda.project(gaussians, lens)
    splats, depths, drawn = cpu.project_arrays(gaussians, lens)
    return torch.from_numpy(splats), torch.from_numpy(depths), torch.from_numpy(drawn)


def projected_vjp(
    gaussians: Gaussians,
    lens: Lens,
    splats: Float64[Tensor, "n 9"],
    drawn: Bool[Tensor, " n"],
    bar: Float64[Tensor, "n 9"],
) -> Float[Tensor, " p"]:
    """The gradient in the flat vector, given the plain adjoint of the splats: a product without what `Projection` keeps."""
    if by_triton(gaussians.flat):
        from splat.projection import cuda

        return cuda.project_adjoint(gaussians, lens, splats, drawn, bar)
    gradient = torch.zeros_like(gaussians.flat)
    inputs = (*cpu.attribute_arrays(gaussians), cpu.width_array(gaussians, lens))
    outputs = cpu.attribute_arrays(gaussians.with_flat(gradient))
    arguments = (*inputs, splats.numpy(), drawn.numpy(), bar.numpy(), *outputs)
    over_range(len(gaussians), cpu.project_adjoint, lens, *arguments)
    return gradient


def linearize_projection(
    gaussians: Gaussians,
    lens: Lens,
    splats: Float64[Tensor, "n 9"],
    moments: Float[Tensor, "n 9"],
    index: Int[Tensor, " m"],
) -> Projection:
    """The projection, linearised for the Gaussians at index; moments: the adjoint of the splats."""
    if not by_triton(gaussians.flat):
        return CpuProjection(gaussians, lens, splats, moments, index)
    from splat.projection.cuda import CudaProjection

    return CudaProjection(gaussians, lens, splats, moments, index)


def plain_gradient(splats: Float64[Tensor, "n 9"], moments: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Plain adjoints of splats, given their moments."""
    return _converted(PLAIN_GRADIENT, splats, moments)


def moments_of(splats: Float64[Tensor, "n 9"], gradient: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Moments, given plain adjoints of splats."""
    return _converted(MOMENTS, splats, gradient)


def plain_tangents(splats: Float64[Tensor, "n 9"], coefficients: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Plain tangents of splats, given their coefficients."""
    return _converted(PLAIN_TANGENT, splats, coefficients)


def coefficients_of(splats: Float64[Tensor, "n 9"], tangents: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Coefficients, given plain tangents of splats."""
    return _converted(COEFFICIENTS, splats, tangents)


def _converted(way: int, splats: Float64[Tensor, "n 9"], numbers: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    if by_triton(splats):
        from splat.projection import cuda

        return cuda.convert(way, splats, numbers)
    out = np.empty(splats.shape)
    over_range(len(splats), cpu.convert, way, splats.numpy(), numbers.numpy(), out)
    return torch.from_numpy(out)
