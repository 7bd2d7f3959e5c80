"""Choose the projection for the device of the Gaussians: NumPy kernels on the CPU, Triton kernels on a GPU."""

from typing import Any

import torch
from torch import Tensor

from splat.backend.cpu.threads import over_range
from splat.backend.device import by_triton
from splat.model.gaussians import Gaussians
from splat.projection.cpu import attribute_arrays, project_adjoint, project_arrays
from splat.projection.formulas import Lens
from splat.projection.linear_cpu import Projection


def projected(gaussians: Gaussians, lens: Lens) -> tuple[Tensor, Tensor, Tensor]:
    """Splats (n, 9), depths and which are drawn."""
    if by_triton(gaussians.flat):
        from splat.projection.cuda import project

        return project(gaussians, lens)
    splats, depths, drawn = project_arrays(gaussians, lens)
    return torch.from_numpy(splats), torch.from_numpy(depths), torch.from_numpy(drawn)


def pulled(gaussians: Gaussians, lens: Lens, splats: Tensor, drawn: Tensor, bar: Tensor) -> Tensor:
    """The gradient in the flat vector, given the adjoint of the splats."""
    if by_triton(gaussians.flat):
        from splat.projection.cuda import project_adjoint as adjoint

        return adjoint(gaussians, lens, splats, drawn, bar.double())
    gradient = torch.zeros_like(gaussians.flat)
    means, log_scales, quats, _, sh = attribute_arrays(gaussians)
    over_range(
        len(gaussians), project_adjoint, lens, means, log_scales, quats, sh, splats.numpy(), drawn.numpy(), bar.numpy(),
        *attribute_arrays(gaussians.with_flat(gradient)),
    )  # fmt: skip
    return gradient


def linearize_projection(gaussians: Gaussians, lens: Lens, splats: Any, bar: Any, index: Any) -> Any:
    """The projection held still where the Gaussians are: `Projection` in arrays, or `CudaProjection` in tensors."""
    if not by_triton(gaussians.flat):
        return Projection(gaussians, lens, splats, bar, index)
    from splat.projection.cuda import CudaProjection

    return CudaProjection(gaussians, lens, splats, bar, index)
