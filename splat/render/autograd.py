"""Projection and compositing by the kernels as torch functions, twice differentiable.

The backward of each is a function of its own, whose backward runs the tangent kernels: `torch.autograd.grad(...,
create_graph=True)` followed by another `grad` costs two tangent passes, not a trace through the compositing loop.

`projected`, `pulled`, `linearize_projection` and `rasterize` choose the kernels for the device of the Gaussians.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.autograd import last_derivative, to_backend
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.dispatch import linearize_projection, projected, pulled
from splat.projection.formulas import Lens, lens_of
from splat.projection.reference import Splats
from splat.raster.dispatch import rasterize

PARTS = (2, 3, 1, 3)  # mean, conic, opacity, colour in a splat of nine numbers


def _parts(splats: Any, like: Tensor) -> tuple[Tensor, ...]:
    """The four attributes of splats (n, 9) as tensors in the precision of another; opacity (n,)."""
    means, conics, opacities, colours = torch.as_tensor(splats).to(like.dtype).split(PARTS, dim=1)
    return means.contiguous(), conics.contiguous(), opacities.reshape(-1), colours.contiguous()


def _joined(parts: tuple[Tensor, ...]) -> Tensor:
    return torch.cat([part.detach().reshape(len(part), -1) for part in parts], dim=1)


def _pushed_and_curved(
    gaussians: Gaussians, lens: Lens, splats: Tensor, drawn: Tensor, bar: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Of one direction in the flat vector, P' u (n, 9) and (bar . P'') u."""
    index, u = drawn.nonzero()[:, 0], to_backend(direction[:, None])
    projection = linearize_projection(gaussians, lens, to_backend(splats), to_backend(bar.double()), to_backend(index))
    tangents = torch.as_tensor(projection.jvp(u))
    product = torch.as_tensor(projection.pull(to_backend(torch.zeros_like(tangents)), u))
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
        ctx.adjoint = raster.backward(raster.pad(to_backend(cotangent)))
        ctx.save_for_backward(cotangent, *splats)
        return _parts(ctx.adjoint.gradient, cotangent)

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        raster = ctx.raster
        tangent = raster.jvp(to_backend(_joined(outputs)[:, None]))
        product = tangent.curvature(ctx.adjoint, to_backend(torch.zeros_like(torch.as_tensor(tangent.planes))))
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
    raster = rasterize(_joined(parts), splats.depths.detach(), splats.drawn, background, width, height, settings)
    planes = _Rasterize.apply(raster, *parts)
    return planes[:3], planes[3]  # pyright: ignore
