"""The losses of `losses.py` on the CPU: value, gradient and Hessian-vector product of one view's image against its target,
and value and gradients of the consistency of two images.

Planes are padded as in `raster/cpu.py`; only the first three are read, and the padding of an output is 0.  The formulas are in
`losses_formulas.py` and `consistency_kernels.py`.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splat.backend.cpu.planes import TILE_ROWS, aligned
from splat.backend.cpu.simd import lanes_of
from splat.backend.cpu.threads import over_range
from splat.losses.cpu.consistency import consistency_rows
from splat.losses.cpu.sweeps import PRODUCT_FIELDS, diagonal_rows, form_rows, gradient_rows, product_rows, value_rows
from splat.losses.cpu.window import RING, moments_rows
from splat.losses.formulas import CHARBONNIER, L1, L2
from splat.losses.reference import LossSettings, window

KINDS = {"l1": L1, "charbonnier": CHARBONNIER, "l2": L2}
RINGS = 5 << 18  # bytes of the rows that a sweep keeps: with more of them, a vector more costs more than it shares
NUMPY = {torch.float32: np.float32, torch.float64: np.float64}


class ImageLoss:
    """A loss of images of one size: their planes, and what its kernels are told."""

    def __init__(self, shape: Sequence[int], settings: LossSettings, dtype: type | np.dtype):
        _, height, width = shape
        stride = -(-width // lanes_of(dtype)) * lanes_of(dtype)
        plane_rows = -(-height // TILE_ROWS) * TILE_ROWS
        self.shape, self.settings, self.dtype = (height, width, plane_rows, stride), settings, np.dtype(dtype)
        self.taps = window(torch.float64).numpy().astype(self.dtype)
        count = 3 * height * width
        self.pixel, self.structural = settings.pixel_weight / count, settings.ssim_weight / count

    def planes(self, sets: int) -> np.ndarray:
        """Uninitialised plane sets, (sets, 3, padded height, padded width)."""
        return aligned((sets, 3, self.shape[2], self.shape[3]), self.dtype)

    def padded(self, image: Tensor | np.ndarray) -> np.ndarray:
        """Padded planes of an image, 0 outside it."""
        planes = self.planes(1)[0]
        planes[:] = 0
        planes[:, : self.shape[0], : self.shape[1]] = image.detach().numpy() if isinstance(image, Tensor) else image
        return planes

    def cropped(self, planes: np.ndarray) -> Tensor:
        """The first three planes without their padding, as a tensor."""
        return torch.from_numpy(np.ascontiguousarray(planes[:3, : self.shape[0], : self.shape[1]]))

    def _pointwise(self) -> tuple:
        scalar = self.dtype.type
        eps, pixel, structural = scalar(self.settings.eps), scalar(self.pixel), scalar(self.structural)
        return KINDS[self.settings.pixel], eps, pixel, structural

    def _value(self, pixels: np.ndarray, distances: np.ndarray) -> float:
        return float(self.pixel * pixels.sum() + self.structural * distances.sum())

    def consistency(self, x: np.ndarray, y: np.ndarray) -> tuple[Tensor, np.ndarray]:
        """The loss between two padded images, and its gradients in both (2, 3, ...)."""
        gradients, (pixels, distances) = self.planes(2), np.zeros((2, 3 * self.shape[0]))
        over_range(
            len(pixels), consistency_rows, self.shape, self.taps, x.reshape(-1), y.reshape(-1), *self._pointwise(),
            *gradients.reshape(2, -1), pixels, distances,
        )  # fmt: skip
        return torch.tensor(self._value(pixels, distances), dtype=torch.from_numpy(gradients).dtype), gradients


class ViewLoss(ImageLoss):
    """The loss of images against one target; what depends on the target alone is computed once."""

    def __init__(self, target: Float[np.ndarray, "3 h w"], settings: LossSettings, dtype: type | np.dtype):
        super().__init__(target.shape, settings, dtype)
        self.target = self.padded(target)
        self._target_moments = self._moments_of_target() if settings.ssim_weight else np.empty(0, self.dtype)

    @classmethod
    def of(cls, target: Float[Tensor, "3 h w"], settings: LossSettings, dtype: torch.dtype) -> "ViewLoss":
        """The loss against a tensor, for images of dtype."""
        return cls(target.numpy(), settings, NUMPY[dtype])

    def _moments_of_target(self) -> np.ndarray:
        """mu and var."""
        moments = self.planes(2)
        flat = self.target.reshape(-1), moments.reshape(-1)
        over_range(3 * self.shape[0], moments_rows, self.shape, self.taps, *flat)
        return moments

    def _against(self, image: np.ndarray) -> tuple[np.ndarray, ...]:
        """The image's three planes, the target's, and the latter's moments, flat."""
        x = np.ascontiguousarray(image[:3], self.dtype)
        return x.reshape(-1), self.target.reshape(-1), self._target_moments.reshape(-1)

    def value(self, image: np.ndarray) -> float:
        """The loss at padded planes: two blurs instead of the gradient's four."""
        kind, eps, _, structural = self._pointwise()
        pixels, distances = np.zeros((2, 3 * self.shape[0]))
        over_range(
            len(pixels), value_rows, self.shape, self.taps, *self._against(image), kind, eps, structural, pixels, distances
        )  # fmt: skip
        return self._value(pixels, distances)

    def linearize(self, image: np.ndarray, second_order: bool = True) -> "LinearLoss":
        """Value, gradient and Hessian's products at padded planes (at least three), which must not change.

        second_order: what the products need is held, too.
        """
        gradient = aligned((4, *self.shape[2:]), self.dtype)
        blurred = self.planes(1).reshape(-1) if second_order and self.structural else np.empty(0, self.dtype)
        gradient[:, self.shape[0] :] = 0
        gradient[3] = 0
        pixels, distances = np.zeros((2, 3 * self.shape[0]))
        over_range(
            len(pixels), gradient_rows, self.shape, self.taps, *self._against(image), *self._pointwise(),
            gradient.reshape(-1), blurred, pixels, distances,
        )  # fmt: skip
        return LinearLoss(self, self._value(pixels, distances), gradient, image, blurred)


class LinearLoss:
    """A loss held still at an image: value, gradient (4, padded planes; that of alpha is 0) and Hessian-vector products."""

    def __init__(self, loss: ViewLoss, value: float, gradient: np.ndarray, image: np.ndarray, blurred: np.ndarray):
        self.loss, self.value, self.gradient, self._image, self._blurred = loss, value, gradient, image, blurred

    def scalar(self, like: Tensor) -> Float[Tensor, ""]:
        """The value as a tensor like another."""
        return like.new_tensor(self.value)

    def _held(self) -> tuple:
        return *self.loss._against(self._image), self._blurred, *self.loss._pointwise()

    def hvp(self, tangents: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """l'' v for K padded tangents (K, 4, ...), to out (which may be the tangents themselves)."""
        loss, height = self.loss, self.loss.shape[0]
        products = aligned((len(tangents), 4, *loss.shape[2:]), loss.dtype) if out is None else out
        found = loss.planes(min(self._together, len(tangents)))
        for first in range(0, len(tangents), self._together):
            some, results = (each[first : first + self._together] for each in (tangents, products))
            V = np.ascontiguousarray(some, loss.dtype).reshape(-1)
            over_range(
                3 * height, product_rows, loss.shape, loss.taps, V, *self._held(), found.reshape(len(found), -1)[: len(some)]
            )  # fmt: skip
            results[:, :3, :height] = found[: len(some), :, :height]
            results[:, :, height:] = 0
            results[:, 3] = 0
        return products

    @property
    def _together(self) -> int:
        """Vectors in a sweep."""
        rows = PRODUCT_FIELDS * RING * self.loss.shape[3] * self.loss.dtype.itemsize
        return max(1, RINGS // rows)

    def curvatures(self, tangents: np.ndarray) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """v . l'' v for K padded tangents (K, 3 or more, ...), and v . D v with the diagonal D of l''."""
        loss, sums = self.loss, np.empty((2, len(tangents), 3 * self.loss.shape[0]))
        V = np.ascontiguousarray(tangents, loss.dtype).reshape(-1)
        over_range(
            sums.shape[2], form_rows, loss.shape, loss.taps, V, *self._held(), self.diagonal.reshape(-1), *sums
        )  # fmt: skip
        full, pixelwise = torch.from_numpy(sums.sum(axis=2))
        return full, pixelwise

    @property
    def bytes(self) -> int:
        """Memory of what is held, the target's included, the image's not."""
        target = self.loss.target.nbytes + self.loss._target_moments.nbytes
        return target + self.gradient.nbytes + self._blurred.nbytes

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many tangents takes beside its result and a few rows a thread."""
        return min(vectors, self._together) * self.gradient[:3].nbytes

    @cached_property
    def diagonal(self) -> np.ndarray:
        """The pixel-diagonal of l'', padded planes (3, ...): that of SSIM is one blur with the squared window."""
        loss = self.loss
        diagonal = loss.planes(1)[0]
        diagonal[:, loss.shape[0] :] = 0
        over_range(
            3 * loss.shape[0], diagonal_rows, loss.shape, loss.taps, loss.taps**2, *self._held(), diagonal.reshape(-1)
        )  # fmt: skip
        return diagonal
