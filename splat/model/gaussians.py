"""The five attributes of a set of 3-D Gaussians, stored as one flat vector.

    means           (n, 3)      world units
    log_scales      (n, 3)      natural logarithm of the standard deviations, world units
    quats           (n, 4)      rotation, order w x y z, normalised where it is used, not where it is stored
    opacity_logits  (n,)        opacity = sigmoid(logit)
    sh              (n, k, 3)   spherical harmonics, k = (degree + 1)^2, bands in order, colour channel last

All curvature in this project is with respect to these stored parameters.  The flat vector holds the attributes one after
the other in the order above; each attribute is a view of it, so neither direction copies and autograd passes through.

Gaussians of Mip-Splatting have a constant beside their parameters: the width of a 3-D filter (`splat/projection/antialias.py`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import isqrt, prod

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr

ATTRIBUTES = ("means", "log_scales", "quats", "opacity_logits", "sh")


def attribute_shapes(n: int, sh_degree: int) -> dict[str, tuple[int, ...]]:
    """Shape of every attribute of n Gaussians, in the order of the flat vector."""
    return {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "opacity_logits": (n,),
        "sh": (n, (sh_degree + 1) ** 2, 3),
    }


@lru_cache
def layout(n: int, sh_degree: int) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """The rows in the flat vector, and the shape, of every attribute; nobody changes it."""
    result, start = {}, 0
    for name, shape in attribute_shapes(n, sh_degree).items():
        result[name] = slice(start, start + prod(shape)), shape
        start += prod(shape)
    return result


def parameters_per_gaussian(sh_degree: int) -> int:
    """59 at SH degree 3."""
    return 11 + 3 * (sh_degree + 1) ** 2


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians(ShortRepr):
    """n Gaussians over one flat vector of n (11 + 3 (sh_degree + 1)^2) stored parameters.

    filter_widths: of each one's 3-D filter, world units, in the type of the vector and where that is; None: there is no filter.
    InputError where sh_degree or the length of a vector cannot be.

    >>> gaussians = Gaussians(torch.zeros(2 * 14), sh_degree=0)
    >>> gaussians.means[1] = 1.0  # a view: writes to the flat vector
    >>> len(gaussians), gaussians.flat.sum(), gaussians.blocks["quats"]
    (2, tensor(3.), slice(12, 20, None))
    """

    flat: Float[Tensor, " p"]
    sh_degree: int
    filter_widths: Float[Tensor, " n"] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"expected sh_degree 0, 1, 2 or 3, got {self.sh_degree}")
        each, flat = parameters_per_gaussian(self.sh_degree), self.flat
        other = flat.is_nested or flat.layout != torch.strided
        if other or flat.ndim != 1 or flat.numel() % each:
            raise InputError(
                f"expected a vector of n x {each} parameters at SH degree {self.sh_degree}, got "
                f"{'a tensor that holds its numbers in another way' if other else tuple(flat.shape)}"
            )
        if self.filter_widths is not None and self.filter_widths.shape != (len(self),):
            raise InputError(f"expected {len(self)} filter widths, got {tuple(self.filter_widths.shape)}")

    @classmethod
    def pack(cls, attributes: Mapping[str, Tensor]) -> "Gaussians":
        """One flat vector from the five attributes (copies); InputError where their shapes do not fit each other."""
        n, bands = attributes["sh"].shape[:2]
        degree = isqrt(bands) - 1
        for name, shape in attribute_shapes(n, degree).items():
            if tuple(attributes[name].shape) != shape:
                raise InputError(f"expected {name} of shape {shape}, got {tuple(attributes[name].shape)}")
        return cls(torch.cat([attributes[name].reshape(-1) for name in ATTRIBUTES]), degree)

    def __len__(self) -> int:
        return self.flat.numel() // parameters_per_gaussian(self.sh_degree)

    @property
    def blocks(self) -> dict[str, slice]:
        """The rows of each attribute in the flat vector."""
        return {name: rows for name, (rows, _) in layout(len(self), self.sh_degree).items()}

    @property
    def attributes(self) -> dict[str, Tensor]:
        """The five attributes as views of the flat vector."""
        return {name: self._view(name) for name in ATTRIBUTES}

    def _view(self, name: str) -> Tensor:
        rows, shape = layout(len(self), self.sh_degree)[name]
        return self.flat[rows].view(shape)

    @property
    def means(self) -> Float[Tensor, "n 3"]:
        return self._view("means")

    @property
    def log_scales(self) -> Float[Tensor, "n 3"]:
        return self._view("log_scales")

    @property
    def quats(self) -> Float[Tensor, "n 4"]:
        return self._view("quats")

    @property
    def opacity_logits(self) -> Float[Tensor, " n"]:
        return self._view("opacity_logits")

    @property
    def sh(self) -> Float[Tensor, "n k 3"]:
        return self._view("sh")

    def with_flat(self, flat: Tensor) -> "Gaussians":
        """The same layout and filter over another vector of parameters."""
        return Gaussians(flat, self.sh_degree, None if self.filter_widths is None else self.filter_widths.to(flat))

    def with_filter(self, widths: Float[Tensor, " n"] | None) -> "Gaussians":
        """The same parameters under another 3-D filter."""
        return Gaussians(self.flat, self.sh_degree, None if widths is None else widths.to(self.flat))

    def to(self, dtype: torch.dtype) -> "Gaussians":
        return self.with_flat(self.flat.to(dtype))

    def aligned_to(self, other: "Gaussians") -> "Gaussians":
        """The same Gaussians with unit quaternions of the sign that is nearer to another's: q and -q are one rotation.

        Differences of parameters, lines and planes between checkpoints are taken after this.
        """
        found = self.with_flat(self.flat.clone())
        quats = found.quats
        quats /= quats.norm(dim=1, keepdim=True)
        quats *= torch.where((quats * other.quats).sum(dim=1, keepdim=True) < 0, -1.0, 1.0).to(quats)
        return found

    def select(self, index: Tensor, sh_degree: int | None = None, fresh: Tensor | None = None) -> "Gaussians":
        """The Gaussians at index (a mask or indices, may repeat), with the SH bands up to sh_degree (zero-padded above).

        fresh: a mask of the chosen; numbers are 0 there, for moments and directions, which new Gaussians lack.
        """
        degree = self.sh_degree if sh_degree is None else sh_degree
        chosen = {name: value[index] for name, value in self.attributes.items()}
        bands = (degree + 1) ** 2
        missing = bands - chosen["sh"].shape[1]
        chosen["sh"] = torch.nn.functional.pad(chosen["sh"], (0, 0, 0, max(missing, 0)))[:, :bands]
        result = Gaussians.pack(chosen)
        if self.filter_widths is not None:
            result = result.with_filter(self.filter_widths[index])
        if fresh is not None:
            for values in result.attributes.values():
                values[fresh] = 0
        return result

    def require_finite(self) -> None:
        """Raise InputError, with attribute and number, for the first Gaussian without finite image and derivatives.

        So too where there is no Gaussian, or numbers of another type than float32 and float64.  Refused are numbers that are
        not finite, quaternions of length 0, which have no direction, and quaternions and SH whose fourth power leaves the range
        of the dtype: SSIM's curvature has the fourth power of a colour, and a quaternion's 1 / |q|^2 enters twice.  The limit
        of log_scales depends on the view: `splat.projection.reference.require_sizes`.
        """
        if self.flat.dtype not in (torch.float32, torch.float64):
            raise InputError(f"expected Gaussians in float32 or float64, got {self.flat.dtype}; convert them with .to")
        if not len(self):
            raise InputError("expected at least one Gaussian, got none; begin with those of a checkpoint or of a scene")
        largest = torch.finfo(self.flat.dtype).max ** 0.25
        if self._is_moderate(largest):  # as nearly all are, in a seventh of the time
            return
        sizes = {
            name: value.detach().reshape(len(self), -1).abs().amax(dim=1) for name, value in self.attributes.items()
        }
        if self.filter_widths is not None:
            sizes["filter_widths"] = self.filter_widths
        quats, sh = sizes["quats"], sizes["sh"]
        range_of_quats = f" ({1 / largest:.1e} to {largest:.1e})"
        conditions = [(torch.isfinite(size), name, "finite", "") for name, size in sizes.items()] + [
            (quats > 0, "quats", "non-zero", ""),
            ((quats >= 1 / largest) & (quats <= largest), "quats", "moderate", range_of_quats),
            (sh <= largest, "sh", "moderate", f" (up to {largest:.1e})"),
        ]
        if self.filter_widths is not None:
            conditions.append((self.filter_widths >= 0, "filter_widths", "non-negative", ""))
        for condition in conditions:
            if not condition[0].all():
                self._refuse(*condition)

    def _is_moderate(self, largest: float) -> bool:
        """Whether, as squares tell, no number is beyond `largest`, no quaternion below its inverse and no filter below 0."""
        flat, quats = self.flat.detach(), self.quats.detach()
        ends = [torch.dot(flat, flat), (quats.square() @ quats.new_ones(4)).amin()]
        if self.filter_widths is not None:
            ends += torch.aminmax(self.filter_widths)
        total, least, *widths = torch.stack(ends).cpu().tolist()  # waits for a GPU once
        narrow, wide = widths or (0.0, 0.0)
        # each is False of nan
        return total <= largest**2 and least >= 4 / largest**2 and narrow >= 0 and wide <= largest

    def _refuse(self, good: Tensor, name: str, quality: str, meaning: str) -> None:
        first = int((~good).nonzero()[0])
        raise InputError(
            f"expected {quality} {name}{meaning}, got {getattr(self, name)[first].tolist()} at Gaussian {first} "
            f"({int((~good).sum())} of {len(self)} are not {quality}); remove them from the checkpoint, or lower its rates"
        )
