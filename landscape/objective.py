"""The Hessian of any plain torch objective, by differentiating its gradient once more (Pearlmutter 1994).

    H v = d/dtheta (g(theta) . v),   g = dL/dtheta

The objective is a function of one flat vector.  Its graph is built once and kept; each product is one backward pass
through it.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.operator import require_blocks, require_vectors


class ObjectiveHessian:
    """The Hessian of loss(theta) at `point`, in the dtype of point.

    >>> def rosenbrock(x):
    ...     return (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
    >>> H = ObjectiveHessian(rosenbrock, torch.tensor([1.0, 1.0], dtype=torch.float64))
    >>> H.apply(torch.eye(2, dtype=torch.float64))  # at the minimum: [[802, -400], [-400, 200]]
    tensor([[ 802., -400.],
            [-400.,  200.]], dtype=torch.float64)
    >>> H.gradient
    tensor([0., 0.], dtype=torch.float64)
    """

    def __init__(
        self,
        loss: Callable[[Tensor], Tensor],
        point: Float[Tensor, " n"],
        blocks: Mapping[str, slice] | None = None,
    ) -> None:
        if point.ndim != 1 or not point.is_floating_point():
            raise ValueError(
                f"expected one flat vector of floats as point, got {point.dtype} of shape {tuple(point.shape)}"
            )
        self.dim, self.dtype = point.numel(), point.dtype
        self.blocks = require_blocks({"all": slice(0, self.dim)} if blocks is None else blocks, self.dim)
        self._point = point.detach().clone().requires_grad_()
        value = loss(self._point)
        if value.ndim != 0 or not torch.isfinite(value):
            raise ValueError(f"expected a finite scalar loss at the point, got {value.detach()}")
        self.value = float(value.detach())
        self._gradient = torch.zeros_like(self._point)
        if value.requires_grad:
            (self._gradient,) = torch.autograd.grad(value, self._point, create_graph=True, materialize_grads=True)

    @property
    def gradient(self) -> Float[Tensor, " n"]:
        """dL/dtheta at the point."""
        return self._gradient.detach()

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim)
        if not self._gradient.requires_grad:  # an objective that is linear in theta
            return torch.zeros_like(V)
        columns = [
            torch.autograd.grad(self._gradient, self._point, v, retain_graph=True, materialize_grads=True)[0]
            for v in V.unbind(dim=1)
        ]
        return torch.stack(columns, dim=1) if columns else torch.zeros_like(V)
