"""The kernels of the GPU as one object."""

from splat.gpu import projection
from splat.gpu.adam import adam_step
from splat.gpu.loss import CudaImageLoss, CudaViewLoss
from splat.gpu.raster.raster import CudaRaster
from splat.losses.protocols import ImageLoss, ViewLoss
from splat.projection.protocols import Projection
from splat.render.backend import Raster


class CudaBackend:
    """`render.backend.Backend` by Triton kernels."""

    exact_blocks = False

    def project(self, gaussians, lens):
        return projection.project(gaussians, lens)

    def project_vjp(self, gaussians, lens, splats, drawn, bar):
        return projection.project_adjoint(gaussians, lens, splats, drawn, bar)

    def linearize_projection(self, gaussians, lens, splats, moments, index) -> Projection:
        return projection.CudaProjection(gaussians, lens, splats, moments, index)

    def convert(self, way, splats, numbers):
        return projection.convert(way, splats, numbers)

    def rasterize(self, splats, depths, drawn, background, width, height, settings) -> Raster:
        return CudaRaster(splats, depths, drawn, background, width, height, settings)

    def view_loss(self, target, settings, like) -> ViewLoss:
        return CudaViewLoss(target.to(like.device), settings, like.dtype)

    def image_loss(self, image, settings) -> ImageLoss:
        return CudaImageLoss(image.detach(), settings)

    def adam(self, parameters, gradient, rates, first, second, updates):
        adam_step(parameters, gradient, rates, first, second, updates)


CUDA = CudaBackend()
