"""The interface of the losses where their images are.

`Backend.view_loss` and `Backend.image_loss` make them.  Planes (k, H, W) are padded as the rasteriser's are
(`render/backend.py`); only the first three are read.
"""

from functools import cached_property
from typing import Any, Protocol

from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError


def require_planes(image: Float[Tensor, "k H W"], target: Float[Tensor, "3 H W"]) -> None:
    """Raise InputError unless an image is of the dtype, device and padding of a target: kernels would read other memory."""
    found, wanted = [(part.dtype, part.device, tuple(part.shape[-2:])) for part in (image, target)]
    if found != wanted:
        raise InputError(
            "expected an image like the loss's target, {} on {} and padded to {}, ".format(*wanted)
            + "got {} on {} padded to {}; make Gaussians and loss of one kind, as by `Gaussians.to`".format(*found)
        )


class LinearLoss(Protocol):
    """A loss, linearised at an image: value, gradient (that of alpha is 0), and products with its second derivative l''."""

    gradient: Float[Tensor, "4 H W"]

    @property
    def value(self) -> float: ...

    @cached_property
    def diagonal(self) -> Float[Tensor, "3 H W"]:
        """The pixel-diagonal of l''."""
        ...

    @property
    def bytes(self) -> int:
        """Bytes kept in memory, the target's included."""
        ...

    def scalar(self, like: Tensor) -> Float[Tensor, ""]:
        """The value where another tensor is, in its precision."""
        ...

    def hvp(self, tangents: Float[Tensor, "k 4 H W"], out: Tensor | None = None) -> Float[Tensor, "k 4 H W"]:
        """l'' v for k tangents, to out (which may be the tangents themselves)."""
        ...

    def curvatures(self, tangents: Float[Tensor, "k 4 H W"]) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """v . l'' v for k tangents, and v . D v with the diagonal D of l''."""
        ...

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many tangents takes beside its result."""
        ...


class ImageLoss(Protocol):
    """A loss of images of one size."""

    def padded(self, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 H W"]:
        """An image as the other methods take it, 0 in the padding."""
        ...

    def cropped(self, planes: Float[Tensor, "k H W"]) -> Float[Tensor, "3 h w"]:
        """The first three planes without their padding."""
        ...

    def consistency(self, x: Float[Tensor, "3 H W"], y: Float[Tensor, "3 H W"]) -> tuple[Float[Tensor, ""], Any]:
        """The loss between two images, and its gradients in both."""
        ...


class ViewLoss(ImageLoss, Protocol):
    """The loss of images against one target."""

    @property
    def couples_pixels(self) -> bool:
        """Whether the loss has second derivatives across pixels, as SSIM has."""
        ...

    def value(self, image: Float[Tensor, "k H W"]) -> float: ...

    def linearize(self, image: Float[Tensor, "k H W"], second_order: bool = True) -> LinearLoss:
        """The loss at an image, which must not change; second_order: with products by its second derivative."""
        ...
