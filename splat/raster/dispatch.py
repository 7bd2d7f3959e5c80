"""The interface of the rasterisers, and the choice of one for the device of the splats.

A view's rasteriser does all that depends on the splats alone when it is made (order, tile lists, image, final transmittances,
stops); its methods are passes over the pixels.  Shapes:

    planes     (k, H, W), the image's planes as the rasteriser keeps them: padded to H x W on the CPU, as they are on a GPU;
               `crop` takes the padding away, `pad` adds it.  Four planes: red, green, blue, accumulated alpha
    splats     (n, 9), plain and in double precision; their tangents and adjoints (n, k, 9) in the coordinates of
               `projection/whitening.py`, in the precision of the pixels, which is that of the depths
"""

from typing import Any, Protocol

from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from splat.backend.device import by_triton
from splat.model.settings import RenderSettings
from splat.raster.cpu.raster import CpuRaster


class Adjoint(Protocol):
    """The adjoint of a view's splats: `moments`, given the cotangent of its planes."""

    cotangent: Float[Tensor, "4 H W"]

    @property
    def moments(self) -> Float[Tensor, "n 9"]: ...

    @property
    def bytes(self) -> int:
        """Memory of what is kept beside the cotangent."""
        ...


class Tangent(Protocol):
    """J u of k tangents of a view's splats: `planes`."""

    planes: Float[Tensor, "k 4 H W"]

    def backward_tangent(self, adjoint: Any, cotangents: Float[Tensor, "k 4 H W"]) -> Float[Tensor, "n k 9"]:
        """The tangent of `Raster.backward` along these tangents.

        adjoint: of this raster; cotangents: the tangents of its cotangent, 0 for the second derivative of compositing alone.
        """
        ...


class Raster(Protocol):
    """One view of one set of splats, composited.

    intersections: how many pairs of a splat and a tile there are that it touches; some of them no pixel reaches, since all of
    the tile stop in front of it.
    """

    splats: Float64[Tensor, "n 9"]
    width: int
    height: int

    @property
    def planes(self) -> Float[Tensor, "4 H W"]: ...

    @property
    def intersections(self) -> int: ...

    @property
    def intersections_reached(self) -> int:
        """Number of intersections that some pixel reaches: a pass goes through these."""
        ...

    @property
    def touched(self) -> Int[Tensor, " m"]:
        """The splats that have such intersections."""
        ...

    @property
    def draw_order(self) -> int:
        """The same number for rasters of which every tile draws the same splats in the same order."""
        ...

    @property
    def bytes(self) -> int:
        """Memory of what is kept."""
        ...

    def workspace(self, vectors: int) -> int:
        """Bytes that `jvp` and `backward_tangent` of so many tangents take, tangents and result included."""
        ...

    def crop(self, planes: Float[Tensor, "*k H W"]) -> Float[Tensor, "*k h w"]:
        """A view of planes without padding."""
        ...

    def pad(self, planes: Float[Tensor, "*k h w"]) -> Float[Tensor, "*k H W"]:
        """Planes with padding of 0, which has no weight in any derivative, in the precision of the pixels."""
        ...

    def backward(self, cotangent: Float[Tensor, "4 H W"]) -> Adjoint:
        """The adjoint of the splats, given that of the planes."""
        ...

    def jvp(self, directions: Float[Tensor, "n k 9"]) -> Tangent:
        """J u for tangents of the splats; rows of splats that are not `touched` are not read."""
        ...

    def gaussian_blocks(
        self, adjoint: Any, curvature: Float[Tensor, "3 H W"], index: Int[Tensor, " m"], gauss_newton: bool
    ) -> Float64[Tensor, "m 9 9"]:
        """Diagonal blocks of the splats at index: of the Hessian or of its Gauss-Newton part.

        adjoint: of the loss's gradient; curvature: the pixel-diagonal of l''.
        """
        ...

    def dark_tiles(self, adjoint: Any, curvature: Float[Tensor, "3 H W"]) -> int:
        """Number of tiles with intersections that have neither slope nor curvature (as in `gaussian_blocks`) in any pixel."""
        ...


def rasterize(
    splats: Float64[Tensor, "n 9"],
    depths: Float[Tensor, " n"],
    drawn: Bool[Tensor, " n"],
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    settings: RenderSettings,
) -> Raster:
    """Composite a view where its splats are.  splats: finite; depths: positive where drawn, in the precision of the pixels."""
    if not by_triton(splats):
        return CpuRaster(splats, depths, drawn, background, width, height, settings)
    from splat.raster.cuda.raster import CudaRaster  # needs triton, which a machine without a GPU may not have

    return CudaRaster(splats, depths, drawn, background, width, height, settings)
