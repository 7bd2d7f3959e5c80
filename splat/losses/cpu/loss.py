"""The losses of `splat/losses/reference.py` on the CPU: value, gradient and Hessian-vector products of an image's loss against
its target, and value and gradients of the consistency of two images.

Planes are padded as in `render/cpu/raster.py`; only the first three are read, and the padding of an output is 0.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splat.backend.cpu.memory import TILE_HEIGHT, aligned
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import over_range
from splat.losses.cpu.sweeps import (
    PRODUCT_FIELDS,
    Loss,
    diagonal_rows,
    gradient_rows,
    product_rows,
    uncoupled_rows,
    uniform_rows,
)
from splat.losses.cpu.window import BORDER, RING, Frame, moments_rows
from splat.losses.formulas import CENTRE, KINDS, SECONDS
from splat.losses.protocols import require_planes
from splat.losses.reference import REACH, LossSettings, beyond, window

RINGS = 5 << 18  # bytes of rings in a sweep: with more, another vector costs more cache than it shares
NUMPY = {torch.float32: np.float32, torch.float64: np.float64}


class Coupling(NamedTuple):
    """l'' = weight * sum over windows of M . seconds M, M a window's means of v, 2 r v and (y - c) v, plus uncoupled v^2.

    factors: 2 r and y - c, three flat planes each, with BORDER numbers before and behind both; uncoupled: three flat planes;
    seconds: see `sweeps.py`.
    """

    factors: np.ndarray
    seconds: np.ndarray
    weight: float
    uncoupled: np.ndarray


class CpuImageLoss:
    """`losses.protocols.ImageLoss`: planes for them, and the sizes and weights that its kernels take."""

    def __init__(self, shape: Sequence[int], settings: LossSettings, dtype: type | np.dtype):
        _, height, width = shape
        stride = -(-width // lanes_of(dtype)) * lanes_of(dtype)
        plane_rows = -(-height // TILE_HEIGHT) * TILE_HEIGHT
        self.dtype = np.dtype(dtype)
        taps = tuple(window(torch.float64)[REACH:].numpy().astype(dtype))
        self.frame = Frame(height, width, plane_rows, stride, taps)
        scalar, self.structural = self.dtype.type, settings.structural(height, width)
        self.pixel = settings.pixel_weight / (3 * height * width)
        eps, pixel, structural = map(scalar, (settings.eps, self.pixel, self.structural))
        self.loss = Loss(KINDS[settings.pixel], eps, pixel, structural, settings.margin)

    def planes(self, sets: int) -> np.ndarray:
        """Uninitialised plane sets, (sets, 3, padded height, padded width)."""
        return aligned((sets, 3, self.frame.plane_rows, self.frame.stride), self.dtype)

    def padded(self, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 H W"]:
        planes = self.planes(1)[0]
        planes[:] = 0
        planes[:, : self.frame.height, : self.frame.width] = image.detach().numpy()
        return torch.from_numpy(planes)

    @property
    def couples_pixels(self) -> bool:
        """Whether the loss has second derivatives across pixels."""
        return self.structural > 0

    def cropped(self, planes: Float[Tensor, "k H W"]) -> Float[Tensor, "3 h w"]:
        return planes[:3, : self.frame.height, : self.frame.width].contiguous()

    def _sweep(self, *images: np.ndarray | None) -> float:
        """The loss by `gradient_rows`.  images: x, y and target, and where the three results go."""
        pixels, distances = np.zeros((2, 3 * self.frame.height))
        over_range(len(pixels), gradient_rows, self.frame, self.loss, *images, pixels, distances)
        return float(self.pixel * pixels.sum() + self.structural * distances.sum())

    def consistency(
        self, x: Float[Tensor, "3 H W"], y: Float[Tensor, "3 H W"]
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "2 3 H W"]]:
        gradients = self.planes(2)
        for image in (x, y):
            require_planes(image, torch.from_numpy(gradients[0]))
        gradients[:, :, self.frame.height :] = 0
        flat = *gradients.reshape(2, -1), np.empty(0, self.dtype)
        value = self._sweep(x.numpy().reshape(-1), y.numpy().reshape(-1), None, *flat)
        return x.new_tensor(value), torch.from_numpy(gradients)


class CpuViewLoss(CpuImageLoss):
    """`losses.protocols.ViewLoss`; what depends on the target alone is computed once."""

    def __init__(self, target: Float[Tensor, "3 h w"], settings: LossSettings, dtype: torch.dtype):
        super().__init__(target.shape, settings, NUMPY[dtype])
        self.target, self._target_moments = self.padded(target).numpy(), np.empty(0, self.dtype)
        if settings.ssim_weight:
            self._target_moments = self.planes(2)  # mu and var
            flat = self.target.reshape(-1), self._target_moments.reshape(-1)
            over_range(3 * self.frame.height, moments_rows, self.frame, *flat)

    def _against(self, image: Float[Tensor, "k H W"]) -> tuple[np.ndarray, ...]:
        """The image's three planes, the target's, and the latter's moments, flat."""
        require_planes(image, torch.from_numpy(self.target))
        x = np.ascontiguousarray(image[:3].numpy())
        return x.reshape(-1), self.target.reshape(-1), self._target_moments.reshape(-1)

    def value(self, image: Float[Tensor, "k H W"]) -> float:
        """The loss at padded planes: two blurs instead of the gradient's four."""
        none = np.empty(0, self.dtype)
        return self._sweep(*self._against(image), None, none, none)

    def linearize(self, image: Float[Tensor, "k H W"], second_order: bool = True) -> "CpuLinearLoss":
        gradient = aligned((4, self.frame.plane_rows, self.frame.stride), self.dtype)
        wanted = second_order and self.structural
        seconds = self.planes(SECONDS if wanted else 0)
        flat = self.planes(1 if wanted else 0).reshape(-1), seconds.reshape(-1)
        gradient[:, self.frame.height :] = 0
        gradient[3] = 0
        value = self._sweep(*self._against(image), gradient.reshape(-1), *flat)
        self._leave_margin(seconds)
        return CpuLinearLoss(self, value, torch.from_numpy(gradient), image, *flat)

    def _leave_margin(self, planes: np.ndarray) -> None:
        """Set planes to 0 where no window counts, and in their padding."""
        frame, margin = self.frame, self.loss.margin
        for edge in (slice(margin), slice(frame.height - margin, None)):
            planes[:, :, edge] = 0
        for edge in (slice(margin), slice(frame.width - margin, None)):
            planes[..., edge] = 0


class CpuLinearLoss:
    """`losses.protocols.LinearLoss`: value, gradient (4 padded planes; that of alpha is 0) and Hessian-vector products."""

    def __init__(
        self, loss: CpuViewLoss, value: float, gradient: Tensor, image: Tensor, blurred: np.ndarray, seconds: np.ndarray
    ):
        self.loss, self.value, self.gradient, self._image = loss, value, gradient, image
        self._blurred, self._seconds = blurred, seconds

    def scalar(self, like: Tensor) -> Float[Tensor, ""]:
        return like.new_tensor(self.value)

    def hvp(self, tangents: Float[Tensor, "k 4 H W"], out: Tensor | None = None) -> Float[Tensor, "k 4 H W"]:
        loss, height, vectors = self.loss, self.loss.frame.height, tangents.numpy()
        products = aligned((len(vectors), *self.gradient.shape), loss.dtype) if out is None else out.numpy()
        found = loss.planes(min(self._together, len(vectors)))
        for first in range(0, len(vectors), self._together):
            some, results = (each[first : first + self._together] for each in (vectors, products))
            planes = found.reshape(len(found), -1)[: len(some)]
            self._products(some, self._means(some), self._uniform, planes, None, None)
            results[:, :3, :height] = found[: len(some), :, :height]
            results[:, :, height:] = 0
            results[:, 3] = 0
        return torch.from_numpy(products)

    @property
    def _together(self) -> int:
        """Vectors in a sweep."""
        rows = PRODUCT_FIELDS * RING * self.loss.frame.stride * self.loss.dtype.itemsize
        return max(1, RINGS // rows)

    def curvatures(self, tangents: Float[Tensor, "k p H W"]) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        forms = np.empty((2, len(tangents), 3 * self.loss.frame.height))
        none = np.zeros((len(tangents), 3), self.loss.dtype)
        self._products(tangents.numpy(), none, self._blurred, None, self.diagonal.numpy().reshape(-1), forms)
        full, pixelwise = torch.from_numpy(forms.sum(axis=2))
        return full, pixelwise

    def _products(self, tangents: np.ndarray, *arguments: np.ndarray | None) -> None:
        """`product_rows`.  arguments: means, uniform, products, diagonal and forms."""
        V = np.ascontiguousarray(tangents, self.loss.dtype).reshape(len(tangents), -1)
        self._sweep(product_rows, V, *arguments)

    def _means(self, tangents: np.ndarray) -> np.ndarray:
        """Of each tangent's channels in every eighth row, (k, 3), where SSIM is to have what differs from them."""
        if not self.loss.structural:
            return np.zeros((len(tangents), 3), self.loss.dtype)
        return tangents[:, :3, : self.loss.frame.height : 8, : self.loss.frame.width].mean(axis=(2, 3))

    @cached_property
    def _uniform(self) -> np.ndarray:
        """l'' times an image of ones, with SSIM."""
        loss, frame = self.loss, self.loss.frame
        if not loss.structural:
            return self._blurred
        columns = np.zeros(frame.stride, loss.dtype)
        columns[: frame.width] = beyond(frame.width).numpy()
        lines, uniform = beyond(frame.height).numpy().astype(loss.dtype), loss.planes(1).reshape(-1)
        images = loss._against(self._image)
        over_range(3 * frame.height, uniform_rows, frame, loss.loss, *images, columns, lines, uniform)
        return uniform

    def _sweep(self, kernel: Callable, *arguments: np.ndarray | tuple | None) -> None:
        loss, (x, y, _) = self.loss, self.loss._against(self._image)
        over_range(3 * loss.frame.height, kernel, loss.frame, loss.loss, x, y, self._blurred, self._seconds, *arguments)

    @property
    def bytes(self) -> int:
        target = self.loss.target.nbytes + self.loss._target_moments.nbytes
        return target + self.gradient.nbytes + 2 * self._blurred.nbytes + self._seconds.nbytes

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many tangents takes beside its result and a few rows a thread."""
        return min(vectors, self._together) * self.gradient[:3].nbytes

    def coupling(self) -> Coupling:
        """l'' of a loss with SSIM: the part that couples pixels, and the pixelwise rest."""
        loss, uncoupled = self.loss, self.loss.planes(1)
        image, target, _ = loss._against(self._image)
        uncoupled[:, :, loss.frame.height :] = 0
        images = image, target, self._blurred
        over_range(3 * loss.frame.height, uncoupled_rows, loss.frame, loss.loss, *images, uncoupled.reshape(-1))
        factors = np.zeros(2 * (image.size + BORDER), loss.dtype)
        factors[BORDER:-BORDER] = np.concatenate([2 * (image - target), target - CENTRE])
        return Coupling(factors, self._seconds, -loss.structural, uncoupled.reshape(-1))

    @cached_property
    def diagonal(self) -> Float[Tensor, "3 H W"]:
        """The pixel-diagonal of l'': that of SSIM is one blur with the squared window."""
        frame, diagonal = self.loss.frame, self.loss.planes(1)[0]
        diagonal[:, frame.height :] = 0
        self._sweep(diagonal_rows, frame._replace(taps=tuple(tap**2 for tap in frame.taps)), diagonal.reshape(-1))
        return torch.from_numpy(diagonal)
