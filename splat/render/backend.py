"""The kernels of a device: one object, `Backend`, with all that rendering, its losses and training ask of it.

`backend_of(tensor)` alone asks where a tensor lies.  The CPU's kernels, in Numba, are always there; those for an NVIDIA GPU, in
Triton, join `BACKENDS` when `device_named` loads them.

A view's rasteriser does all that depends on the splats alone when it is made (order, tile lists, image, final transmittances,
stops); its methods are passes over the pixels.  Shapes:

    planes     (k, H, W), the image's planes as the rasteriser keeps them: padded to H x W on the CPU, as they are on a GPU;
               `crop` takes the padding away, `pad` adds it.  Four planes: red, green, blue, accumulated alpha
    splats     (n, 9), plain and in double precision; their tangents and adjoints (n, k, 9) in the coordinates of
               `projection/whitening.py`, in the precision of the pixels, which is that of the depths
"""

from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from landscape.errors import InputError
from splat.backend.cpu.adam import adam_step
from splat.backend.cpu.threads import LIGHT, over_range
from splat.losses.cpu.loss import NUMPY, CpuImageLoss, CpuViewLoss
from splat.losses.protocols import ImageLoss, ViewLoss
from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection import cpu
from splat.projection.formulas import Lens
from splat.projection.linear_cpu import CpuProjection
from splat.projection.protocols import Projection
from splat.projection.reference import Splats
from splat.projection.whitening import COEFFICIENTS, MOMENTS, PLAIN_GRADIENT, PLAIN_TANGENT
from splat.render.cpu.raster import CpuRaster


class Adjoint(Protocol):
    """The adjoint of a view's splats: `moments`, given the cotangent of its planes."""

    cotangent: Float[Tensor, "4 H W"]

    @property
    def moments(self) -> Float[Tensor, "n 9"]: ...

    @property
    def bytes(self) -> int:
        """Bytes kept in memory beside the cotangent."""
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
    def pairs(self) -> int:
        """Number of (pixel, splat) pairs that a pass evaluates."""
        ...

    @property
    def touched(self) -> Int[Tensor, " m"]:
        """The splats that have such intersections."""
        ...

    @property
    def draw_order(self) -> int:
        """A number that is equal for rasters whose tiles all draw the same splats in the same order."""
        ...

    @property
    def bytes(self) -> int:
        """Bytes kept in memory."""
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

    def coupled_blocks(
        self, loss: Any, index: Int[Tensor, " m"], space: list[Any]
    ) -> tuple[Float[Tensor, "3 H W"], Float64[Tensor, "m 9 9"]]:
        """Of a loss that couples pixels, linearised: the pixelwise part of l'', and what the rest adds to the blocks at index.

        index: ascending.  space: memory that views use one after the other, at first none.  InputError where the device has no
        such kernel (`Backend.exact_blocks`).
        """
        ...

    def dark_tiles(self, adjoint: Any, curvature: Float[Tensor, "3 H W"]) -> int:
        """Number of tiles with intersections that have neither slope nor curvature (as in `gaussian_blocks`) in any pixel."""
        ...


class Backend(Protocol):
    """What a device computes.  exact_blocks: whether it has `Raster.coupled_blocks`, the exact blocks of a loss with SSIM."""

    exact_blocks: bool

    def project(
        self, gaussians: Gaussians, lens: Lens
    ) -> tuple[Float64[Tensor, "n 9"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
        """Splats, depths in the precision of the parameters, and which are drawn; ValueError as `require_sizes`."""
        ...

    def project_vjp(
        self,
        gaussians: Gaussians,
        lens: Lens,
        splats: Float64[Tensor, "n 9"],
        drawn: Bool[Tensor, " n"],
        bar: Float64[Tensor, "n 9"],
    ) -> Float[Tensor, " p"]:
        """The gradient in the flat vector, given the plain adjoint of the splats: a product without what `Projection` keeps."""
        ...

    def linearize_projection(
        self,
        gaussians: Gaussians,
        lens: Lens,
        splats: Float64[Tensor, "n 9"],
        moments: Float[Tensor, "n 9"],
        index: Int[Tensor, " m"],
    ) -> Projection:
        """The projection, linearised for the Gaussians at index; moments: the adjoint of the splats."""
        ...

    def add_screen_gradients(
        self, total: Tensor, renders: Tensor, gradient: Tensor, splats: Splats, camera: Camera
    ) -> None:
        """`projection.reference.add_screen_gradients`, in place."""
        ...

    def convert(
        self, way: int, splats: Float64[Tensor, "n 9"], numbers: Float[Tensor, "n 9"]
    ) -> Float64[Tensor, "n 9"]:
        """Tangents or adjoints of splats in other coordinates: `whitening.converted`."""
        ...

    def rasterize(
        self,
        splats: Float64[Tensor, "n 9"],
        depths: Float[Tensor, " n"],
        drawn: Bool[Tensor, " n"],
        background: Float[Tensor, "3"],
        width: int,
        height: int,
        settings: RenderSettings,
    ) -> Raster:
        """Composite a view.  splats: finite; depths: positive where drawn, in the precision of the pixels."""
        ...

    def view_loss(self, target: Float[Tensor, "3 h w"], settings: LossSettings, like: Tensor) -> ViewLoss:
        """The loss of images against a target, on the device and in the dtype of the tensor `like`."""
        ...

    def image_loss(self, image: Float[Tensor, "3 h w"], settings: LossSettings) -> ImageLoss:
        """The loss of two images of the size, dtype and device of this one."""
        ...

    def adam(
        self, parameters: Tensor, gradient: Tensor, rates: Tensor, first: Tensor, second: Tensor, updates: int
    ) -> None:
        """One step of Adam in place: number `updates`, counted from 1 (`backend/cpu/adam.py`)."""
        ...


class CpuBackend:
    """`Backend` by Numba kernels on NumPy views of tensors."""

    exact_blocks = True
    linearize_projection, rasterize, adam = CpuProjection, CpuRaster, staticmethod(adam_step)

    def project(self, gaussians, lens):
        splats, depths, drawn = cpu.project_arrays(gaussians, lens)
        return torch.from_numpy(splats), torch.from_numpy(depths), torch.from_numpy(drawn)

    def project_vjp(self, gaussians, lens, splats, drawn, bar):
        gradient = torch.empty_like(gaussians.flat)
        inputs = (*cpu.attribute_arrays(gaussians), cpu.width_array(gaussians, lens))
        outputs = cpu.attribute_arrays(gaussians.with_flat(gradient))
        arguments = (*inputs, splats.numpy(), drawn.numpy(), bar.numpy(), *outputs)
        over_range(len(gaussians), cpu.project_adjoint, lens, *arguments)
        return gradient

    def add_screen_gradients(self, total, renders, gradient, splats, camera):
        arrays = (each.numpy() for each in (splats.means, splats.conics, splats.drawn, gradient))
        halves = camera.width / 2, camera.height / 2
        over_range(len(total), cpu.add_screen_gradients, *arrays, *halves, total.numpy(), renders.numpy(), least=LIGHT)

    def convert(self, way, splats, numbers):
        out = np.empty(splats.shape)
        over_range(len(splats), cpu.convert, way, splats.numpy(), numbers.numpy(), out, least=LIGHT)
        return torch.from_numpy(out)

    def view_loss(self, target, settings, like) -> ViewLoss:
        return CpuViewLoss(target, settings, like.dtype)

    def image_loss(self, image, settings) -> ImageLoss:
        return CpuImageLoss(image.shape, settings, NUMPY[image.dtype])


CPU = CpuBackend()
BACKENDS: dict[str, Backend] = {"cpu": CPU}  # by the type of torch's device


def backend_of(tensor: Tensor) -> Backend:
    """The kernels for the device of a tensor; InputError where none are loaded."""
    try:
        return BACKENDS[tensor.device.type]
    except KeyError:
        raise InputError(
            f"expected a tensor on a device whose kernels are loaded ({', '.join(BACKENDS)}), got one on {tensor.device}; take "
            "the device from splat.backend.device.device_named, which loads them"
        ) from None


def plain_gradient(splats: Float64[Tensor, "n 9"], moments: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Plain adjoints of splats, given their moments."""
    return backend_of(splats).convert(PLAIN_GRADIENT, splats, moments)


def moments_of(splats: Float64[Tensor, "n 9"], gradient: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Moments, given plain adjoints of splats."""
    return backend_of(splats).convert(MOMENTS, splats, gradient)


def plain_tangents(splats: Float64[Tensor, "n 9"], coefficients: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Plain tangents of splats, given their coefficients."""
    return backend_of(splats).convert(PLAIN_TANGENT, splats, coefficients)


def coefficients_of(splats: Float64[Tensor, "n 9"], tangents: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Coefficients, given plain tangents of splats."""
    return backend_of(splats).convert(COEFFICIENTS, splats, tangents)
