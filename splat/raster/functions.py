"""Projection and compositing by the kernels as torch functions, twice differentiable.

The backward of each is a function of its own, whose backward runs the tangent kernels: `torch.autograd.grad(...,
create_graph=True)` followed by another `grad` costs two tangent passes, not a trace through the compositing loop.

`projected`, `pulled`, `held_projection` and `held_raster` alone decide which kernels these are: those where the Gaussians are.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splat.camera import Camera
from splat.device import by_triton
from splat.gaussians import Gaussians
from splat.projection import Splats
from splat.projection_cpu import attribute_arrays, project_adjoint, project_arrays
from splat.projection_formulas import Lens, lens_of
from splat.projection_linear import Projection
from splat.raster.cpu import Raster
from splat.raster.threads import over_range
from splat.settings import RenderSettings

PARTS = (2, 3, 1, 3)  # mean, conic, opacity, colour in a splat of nine numbers


def _parts(splats: Any, like: Tensor) -> tuple[Tensor, ...]:
    """The four attributes of splats (n, 9) as tensors in the precision of another; opacity (n,)."""
    means, conics, opacities, colours = torch.as_tensor(splats).to(like.dtype).split(PARTS, dim=1)
    return means.contiguous(), conics.contiguous(), opacities.reshape(-1), colours.contiguous()


def _joined(parts: tuple[Tensor, ...]) -> Tensor:
    return torch.cat([part.detach().reshape(len(part), -1) for part in parts], dim=1)


THIRD = "expected at most two derivatives of the kernels, got a third; render with backend='reference' for more"


class _Last(torch.autograd.Function):
    """The first `count` tensors, on the graph of them all, with a derivative that is an error."""

    @staticmethod
    def forward(ctx, refusal: str, count: int, *tensors: Tensor):
        ctx.refusal = refusal
        return tensors[:count]

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        raise NotImplementedError(ctx.refusal)


def last_derivative(values: tuple[Tensor, ...], *sources: Tensor, refusal: str = THIRD) -> tuple[Tensor, ...]:
    """Derivatives by a kernel: on the graph of what they came from, so that the next is refused, not taken for 0."""
    return _Last.apply(refusal, len(values), *values, *sources)  # pyright: ignore[reportReturnType]


def native(tensor: Tensor) -> Any:
    """A tensor as the kernels where it is take it: as an array on the CPU."""
    return tensor.detach() if by_triton(tensor) else tensor.detach().numpy()


def projected(gaussians: Gaussians, lens: Lens) -> tuple[Tensor, Tensor, Tensor]:
    """Splats (n, 9), depths and which are drawn."""
    if by_triton(gaussians.flat):
        from splat.projection_cuda import project

        return project(gaussians, lens)
    splats, depths, drawn = project_arrays(gaussians, lens)
    return torch.from_numpy(splats), torch.from_numpy(depths), torch.from_numpy(drawn)


def pulled(gaussians: Gaussians, lens: Lens, splats: Tensor, drawn: Tensor, bar: Tensor) -> Tensor:
    """The gradient in the flat vector, given the adjoint of the splats."""
    if by_triton(gaussians.flat):
        from splat.projection_cuda import project_adjoint as adjoint

        return adjoint(gaussians, lens, splats, drawn, bar.double())
    gradient = torch.zeros_like(gaussians.flat)
    means, log_scales, quats, _, sh = attribute_arrays(gaussians)
    over_range(
        len(gaussians), project_adjoint, lens, means, log_scales, quats, sh, splats.numpy(), drawn.numpy(), bar.numpy(),
        *attribute_arrays(gaussians.with_flat(gradient)),
    )  # fmt: skip
    return gradient


def held_projection(gaussians: Gaussians, lens: Lens, splats: Any, bar: Any, index: Any) -> Any:
    """The projection held still where the Gaussians are: `Projection` in arrays, or `CudaProjection` in tensors."""
    if not by_triton(gaussians.flat):
        return Projection(gaussians, lens, splats, bar, index)
    from splat.projection_cuda import CudaProjection

    return CudaProjection(gaussians, lens, splats, bar, index)


def _pushed_and_curved(
    gaussians: Gaussians, lens: Lens, splats: Tensor, drawn: Tensor, bar: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Of one direction in the flat vector, P' u (n, 9) and (bar . P'') u."""
    index, u = drawn.nonzero()[:, 0], native(direction[:, None])
    projection = held_projection(gaussians, lens, native(splats), native(bar.double()), native(index))
    tangents = torch.as_tensor(projection.jvp(u))
    product = torch.as_tensor(projection.pull(native(torch.zeros_like(tangents)), u))
    return tangents[:, 0], product[:, 0]


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, flat: Tensor, sh_degree: int, camera: Camera, settings: RenderSettings):
        gaussians, lens = Gaussians(flat.detach(), sh_degree), lens_of(camera, settings)
        splats, depths, drawn = projected(gaussians, lens)
        ctx.held = (sh_degree, lens, splats, drawn)
        ctx.save_for_backward(flat)
        outputs = (*_parts(splats, flat), depths, drawn)
        ctx.mark_non_differentiable(*outputs[4:])
        return outputs

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        return _ProjectAdjoint.apply(ctx.saved_tensors[0], ctx.held, *outputs[:4]), None, None, None


class _ProjectAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(ctx, flat: Tensor, held: tuple, *bars: Tensor) -> Tensor:
        sh_degree, lens, splats, drawn = held
        ctx.held, ctx.bar = held, _joined(bars)
        ctx.save_for_backward(flat)
        return pulled(Gaussians(flat.detach(), sh_degree), lens, splats, drawn, ctx.bar)

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        (flat,) = ctx.saved_tensors
        sh_degree, lens, splats, drawn = ctx.held
        gaussians, direction = Gaussians(flat.detach(), sh_degree), outputs[0].detach()
        tangents, product = _pushed_and_curved(gaussians, lens, splats, drawn, ctx.bar, direction)
        product, *parts = last_derivative((product, *_parts(tangents, flat)), flat, *outputs)
        return product, None, *parts


def held_raster(
    splats: Tensor, depths: Tensor, drawn: Tensor, background: Tensor, width: int, height: int, settings: RenderSettings
) -> Any:
    """A view held still where its splats (n, 9) are: `cpu.Raster` in arrays, or `cuda.CudaRaster` in tensors."""
    if not by_triton(splats):
        arrays = (splats.numpy(), depths.numpy(), drawn.numpy(), background.numpy())
        return Raster(*arrays, width, height, settings)
    from splat.raster.cuda import CudaRaster  # needs triton, which a machine without a GPU may not have

    return CudaRaster(splats, depths, drawn, background, width, height, settings)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, raster: Any, *splats: Tensor) -> Tensor:
        ctx.raster = raster
        ctx.save_for_backward(*splats)
        return torch.as_tensor(raster.crop(raster.planes)).clone()

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        return None, *_RasterizeAdjoint.apply(ctx.raster, outputs[0], *ctx.saved_tensors)


class _RasterizeAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(ctx, raster: Any, cotangent: Tensor, *splats: Tensor):
        ctx.raster = raster
        ctx.adjoint = raster.backward(raster.pad(native(cotangent)))
        ctx.save_for_backward(cotangent, *splats)
        return _parts(ctx.adjoint.gradient, cotangent)

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        raster = ctx.raster
        tangent = raster.jvp(native(_joined(outputs)[:, None]))
        product = tangent.curvature(ctx.adjoint, native(torch.zeros_like(torch.as_tensor(tangent.planes))))
        values = (torch.as_tensor(raster.crop(tangent.planes[0])).clone(), *_parts(product[:, 0], outputs[0]))
        return None, *last_derivative(values, *ctx.saved_tensors, *outputs)


def project_by_kernel(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> Splats:
    """`projection.project`, by the kernels.  depths carry no gradient: they only sort."""
    return Splats(*_Project.apply(gaussians.flat, gaussians.sh_degree, camera, settings))  # pyright: ignore


def rasterize_by_kernel(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, settings: RenderSettings
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"]]:
    """Colour and accumulated alpha of `reference.rasterize_reference`, by the kernels, where the splats are."""
    parts = (splats.means, splats.conics, splats.opacities, splats.colours)
    raster = held_raster(_joined(parts), splats.depths.detach(), splats.drawn, background, width, height, settings)
    planes = _Rasterize.apply(raster, *parts)
    return planes[:3], planes[3]  # pyright: ignore
