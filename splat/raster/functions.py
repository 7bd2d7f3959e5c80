"""Projection and compositing by the kernels as torch functions, twice differentiable.

The backward of each is a function of its own, whose backward runs the tangent kernels: `torch.autograd.grad(...,
create_graph=True)` followed by another `grad` costs two tangent passes, not a trace through the compositing loop.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splat.camera import Camera
from splat.gaussians import Gaussians
from splat.projection import Splats
from splat.projection_cpu import attribute_arrays, lens_of, project_adjoint, project_arrays
from splat.projection_linear import Projection
from splat.raster.cpu import Raster
from splat.raster.threads import over_range
from splat.settings import RenderSettings

PARTS = (2, 3, 1, 3)  # mean, conic, opacity, colour in a splat of nine numbers


def _parts(splats: np.ndarray, like: Tensor) -> tuple[Tensor, ...]:
    """The four attributes of splats (n, 9) as tensors in the precision of another; opacity (n,)."""
    means, conics, opacities, colours = torch.from_numpy(splats).to(like.dtype).split(PARTS, dim=1)
    return means.contiguous(), conics.contiguous(), opacities.reshape(-1), colours.contiguous()


def _joined(parts: tuple[Tensor, ...]) -> np.ndarray:
    return torch.cat([part.detach().reshape(len(part), -1) for part in parts], dim=1).numpy()


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


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, flat: Tensor, sh_degree: int, camera: Camera, settings: RenderSettings):
        gaussians, lens = Gaussians(flat.detach(), sh_degree), lens_of(camera, settings)
        splats, depths, drawn = project_arrays(gaussians, lens)
        ctx.held = (sh_degree, lens, splats, drawn)
        ctx.save_for_backward(flat)
        outputs = (*_parts(splats, flat), torch.from_numpy(depths), torch.from_numpy(drawn))
        ctx.mark_non_differentiable(*outputs[4:])
        return outputs

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        return _ProjectAdjoint.apply(ctx.saved_tensors[0], ctx.held, *outputs[:4]), None, None, None


class _ProjectAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(ctx, flat: Tensor, held: tuple, *bars: Tensor) -> Tensor:
        sh_degree, lens, splats, drawn = held
        gaussians, gradient = Gaussians(flat.detach(), sh_degree), torch.zeros_like(flat)
        means, log_scales, quats, _, sh = attribute_arrays(gaussians)
        bar = _joined(bars)
        over_range(
            len(gaussians), project_adjoint, lens, means, log_scales, quats, sh, splats, drawn, bar,
            *attribute_arrays(gaussians.with_flat(gradient)),
        )  # fmt: skip
        ctx.held, ctx.bar = held, bar
        ctx.save_for_backward(flat)
        return gradient

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        (flat,) = ctx.saved_tensors
        sh_degree, lens, splats, drawn = ctx.held
        gaussians = Gaussians(flat.detach(), sh_degree)
        projection = Projection(gaussians, lens, splats, ctx.bar, np.flatnonzero(drawn))
        direction = outputs[0].detach().numpy()[:, None]
        tangents, product = projection.jvp(direction), torch.zeros_like(flat)
        projection.pull(np.zeros_like(tangents), direction, product.numpy()[:, None])
        product, *parts = last_derivative((product, *_parts(tangents[:, 0], flat)), flat, *outputs)
        return product, None, *parts


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, raster: Raster, *splats: Tensor) -> Tensor:
        ctx.raster = raster
        ctx.save_for_backward(*splats)
        return torch.from_numpy(raster.crop(raster.planes).copy())

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        return None, *_RasterizeAdjoint.apply(ctx.raster, outputs[0], *ctx.saved_tensors)


class _RasterizeAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(ctx, raster: Raster, cotangent: Tensor, *splats: Tensor):
        ctx.raster = raster
        ctx.adjoint = raster.backward(raster.pad(cotangent.detach().numpy()))
        ctx.save_for_backward(cotangent, *splats)
        return _parts(ctx.adjoint.gradient, cotangent)

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        raster = ctx.raster
        tangent = raster.jvp(_joined(outputs)[:, None])
        product = tangent.curvature(ctx.adjoint, np.zeros_like(tangent.planes))
        values = (torch.from_numpy(raster.crop(tangent.planes[0]).copy()), *_parts(product[:, 0], outputs[0]))
        return None, *last_derivative(values, *ctx.saved_tensors, *outputs)


def project_by_kernel(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> Splats:
    """`projection.project`, by the kernels.  depths carry no gradient: they only sort."""
    return Splats(*_Project.apply(gaussians.flat, gaussians.sh_degree, camera, settings))  # pyright: ignore


def rasterize_by_kernel(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, settings: RenderSettings
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"]]:
    """Colour and accumulated alpha of `reference.rasterize_reference`, by the kernels."""
    parts = (splats.means, splats.conics, splats.opacities, splats.colours)
    raster = Raster(
        _joined(parts),
        splats.depths.detach().numpy(),
        splats.drawn.numpy(),
        background.numpy(),
        width,
        height,
        settings,
    )
    planes = _Rasterize.apply(raster, *parts)
    return planes[:3], planes[3]  # pyright: ignore
