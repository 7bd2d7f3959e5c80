"""Choose the rasteriser for the device of the splats: NumPy kernels on the CPU, Triton kernels on a GPU."""

from typing import Any

from torch import Tensor

from splat.backend.device import by_triton
from splat.model.settings import RenderSettings
from splat.raster.cpu.raster import Raster


def rasterize(
    splats: Tensor, depths: Tensor, drawn: Tensor, background: Tensor, width: int, height: int, settings: RenderSettings
) -> Any:
    """A view held still where its splats (n, 9) are: `cpu.Raster` in arrays, or `cuda.CudaRaster` in tensors."""
    if not by_triton(splats):
        arrays = (splats.numpy(), depths.numpy(), drawn.numpy(), background.numpy())
        return Raster(*arrays, width, height, settings)
    from splat.raster.cuda.raster import CudaRaster  # needs triton, which a machine without a GPU may not have

    return CudaRaster(splats, depths, drawn, background, width, height, settings)
