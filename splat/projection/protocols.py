"""The interface of the projections.

Splats are (n, 9), in double precision; their tangents and adjoints, in plain coordinates or others: `whitening.py`.  Blocks of
vectors (p, k) are laid out like `Gaussians.flat`.
"""

from typing import Protocol

from jaxtyping import Float, Float64
from torch import Tensor

from splat.projection.formulas import ProjectionJacobian


class Projection(Protocol):
    """The map P from stored parameters to the splats of one view, linearised where an adjoint a of the splats is given.

    Tangents and adjoints of splats are coefficients and moments (`whitening.py`), in the precision of the parameters.
    """

    @property
    def jacobian(self) -> ProjectionJacobian:
        """The derivatives, Gaussian by Gaussian, as tensors."""
        ...

    @property
    def bytes(self) -> int:
        """Bytes kept in memory."""
        ...

    def affects(self, block: Float[Tensor, "p k"]) -> bool:
        """Whether a vector moves any of the Gaussians at index; on a GPU always True, since to look is to wait for it."""
        ...

    def jvp(self, block: Float[Tensor, "p k"]) -> Float[Tensor, "n k 9"]:
        """P' U; 0 for Gaussians that are not at index."""
        ...

    def vjp(
        self,
        cotangents: Float[Tensor, "n k 9"],
        block: Float[Tensor, "p k"] | None = None,
        total: Float[Tensor, "p k"] | None = None,
    ) -> Float[Tensor, "p k"]:
        """P'^T cotangents, plus (a . P'') block where a block is given; added to total, where that is given, in its place."""
        ...

    def blocks(
        self, blocks: Float64[Tensor, "m 9 9"], second_order: bool
    ) -> tuple[Float[Tensor, "n 11 11"], Float[Tensor, "n b 3"]]:
        """Diagonal blocks of the splats at index in stored parameters: P'^T B P', plus (a . P'') where second_order.

        Over mean, log-scales, quaternion and opacity logit; and the diagonal of the SH block.
        """
        ...
