"""Projection and compositing by the kernels as torch functions, twice differentiable.

The backward of each is a function of its own, whose backward runs the tangent kernels: `torch.autograd.grad(...,
create_graph=True)` followed by another `grad` costs two tangent passes, not a trace through the compositing loop.

On the graph a view's splats are (n, 9), plain and in double precision whatever that of the parameters (`whitening.py`): the
rasteriser gets the numbers that the projection gives, as it does in `forward.rasterize_view`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.autograd import last_derivative
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.formulas import Lens, lens_of
from splat.projection.reference import Splats
from splat.render.backend import Raster, backend_of, coefficients_of, moments_of, plain_gradient, plain_tangents


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, flat: Tensor, sh_degree: int, widths: Tensor | None, lens: Lens):
        ctx.view = sh_degree, widths, lens
        splats, depths, drawn = backend_of(flat).project(Gaussians(flat.detach(), sh_degree, widths), lens)
        ctx.save_for_backward(flat, splats, drawn)
        ctx.mark_non_differentiable(depths, drawn)
        return splats, depths, drawn

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        flat, splats, drawn = ctx.saved_tensors
        return _ProjectAdjoint.apply(flat, outputs[0], splats.detach(), drawn, *ctx.view), None, None, None


class _ProjectAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, flat: Tensor, bar: Tensor, splats: Tensor, drawn: Tensor, sh_degree: int, widths: Tensor | None, lens: Lens
    ) -> Tensor:
        ctx.view = splats, drawn, sh_degree, widths, lens
        ctx.save_for_backward(flat, bar)
        gaussians = Gaussians(flat.detach(), sh_degree, widths)
        return backend_of(gaussians.flat).project_vjp(gaussians, lens, splats, drawn, bar.detach().contiguous())

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        (flat, bar), (splats, drawn, sh_degree, widths, lens) = ctx.saved_tensors, ctx.view
        gaussians, direction = Gaussians(flat.detach(), sh_degree, widths), outputs[0].detach()[:, None]
        moments = moments_of(splats, bar.detach().contiguous())
        projection = backend_of(gaussians.flat).linearize_projection(
            gaussians, lens, splats, moments, drawn.nonzero()[:, 0]
        )
        tangents = projection.jvp(direction)
        product = projection.vjp(torch.zeros_like(tangents), direction)
        values = (product[:, 0], plain_tangents(splats, tangents[:, 0]))
        return *last_derivative(values, flat, bar, *outputs), None, None, None, None, None


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats: Tensor, raster: Raster) -> Tensor:
        ctx.raster = raster
        ctx.save_for_backward(splats)
        return raster.crop(raster.planes).clone()

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        return _RasterizeAdjoint.apply(*ctx.saved_tensors, outputs[0], ctx.raster), None


class _RasterizeAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats: Tensor, cotangent: Tensor, raster: Raster) -> Tensor:
        ctx.raster, ctx.adjoint = raster, raster.backward(raster.pad(cotangent.detach()))
        ctx.save_for_backward(splats, cotangent)
        return plain_gradient(raster.splats, ctx.adjoint.moments)

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        raster: Raster = ctx.raster
        tangent = raster.jvp(coefficients_of(raster.splats, outputs[0].detach().contiguous())[:, None])
        product = tangent.backward_tangent(ctx.adjoint, torch.zeros_like(tangent.planes))
        values = (plain_gradient(raster.splats, product[:, 0]), raster.crop(tangent.planes[0]).clone())
        return *last_derivative(values, *ctx.saved_tensors, *outputs), None


def project_by_kernel(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> Splats:
    """`reference.project`, by the kernels, in double precision.  depths carry no gradient: they only sort."""
    inputs = (gaussians.flat, gaussians.sh_degree, gaussians.filter_widths, lens_of(camera, settings))
    splats, depths, drawn = _Project.apply(*inputs)  # pyright: ignore
    means, conics, opacities, colours = splats.split((2, 3, 1, 3), dim=1)
    return Splats(means, conics, opacities[:, 0], colours, depths, drawn)


def rasterize_by_kernel(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, settings: RenderSettings
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"]]:
    """Colour and accumulated alpha of `reference.rasterize_reference`, by the kernels, where the splats are.

    The pixels have the precision of the depths.
    """
    parts = (splats.means, splats.conics, splats.opacities[:, None], splats.colours)
    numbers = torch.cat([part.double() for part in parts], dim=1)
    raster = backend_of(numbers).rasterize(
        numbers.detach(), splats.depths.detach(), splats.drawn, background, width, height, settings
    )
    planes: Tensor = _Rasterize.apply(numbers, raster)  # pyright: ignore
    return planes[:3], planes[3]
