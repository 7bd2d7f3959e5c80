"""The kernels of the GPU as one object."""

from splat.gpu import projection
from splat.gpu.adam import adam_step
from splat.gpu.loss import CudaImageLoss, CudaViewLoss
from splat.gpu.raster.raster import CudaRaster
from splat.losses.protocols import ImageLoss, ViewLoss
from splat.projection.reference import add_screen_gradients


class CudaBackend:
    """`render.backend.Backend` by Triton kernels."""

    exact_blocks = False
    project = staticmethod(projection.project)
    project_vjp = staticmethod(projection.project_adjoint)
    convert = staticmethod(projection.convert)
    linearize_projection, rasterize, adam = projection.CudaProjection, CudaRaster, staticmethod(adam_step)
    add_screen_gradients = staticmethod(add_screen_gradients)

    def view_loss(self, target, settings, like) -> ViewLoss:
        return CudaViewLoss(target.to(like.device), settings, like.dtype)

    def image_loss(self, image, settings) -> ImageLoss:
        return CudaImageLoss(image.detach(), settings)


CUDA = CudaBackend()
