"""The Hessian of any plain torch objective, by differentiating its gradient once more (Pearlmutter 1994).

    H v = d/dtheta (g(theta) . v),   g = dL/dtheta

The objective is a function of one flat vector.  Its graph is built once and kept; each product is one backward pass
through it.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import require_blocks, require_vectors


class ObjectiveHessian:
    """The Hessian of loss(theta) at `point`, in the dtype of point.

    loss: from the flat vector theta (n,) to a tensor of one finite number, by torch operations alone.  point: (n,); it is
    copied.  blocks: named ranges of its rows; one of all, "all", where None.  value: the loss there.

    A loss that torch does not trace back to the point raises ValueError: it would look flat.  One that is linear in the
    point, or piecewise so (as is an l1 norm), has the Hessian 0.

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
        self, loss: Callable[[Tensor], Tensor], point: Float[Tensor, " n"], blocks: Mapping[str, slice] | None = None
    ) -> None:
        if point.ndim != 1 or not point.is_floating_point():
            raise InputError(
                f"expected one flat vector of floats as point, got {point.dtype} of shape {tuple(point.shape)}"
            )
        self.dim, self.dtype = point.numel(), point.dtype
        self.blocks = require_blocks({"all": slice(0, self.dim)} if blocks is None else blocks, self.dim)
        self._point = point.detach().clone().requires_grad_()
        value = loss(self._point)
        _require_loss(value)
        self.value, self._gradient = float(value.detach()), _traced_gradient(value, self._point)

    @property
    def gradient(self) -> Float[Tensor, " n"]:
        """dL/dtheta at the point, (n,)."""
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


def _require_loss(value: object) -> None:
    """ValueError unless it is a tensor of one finite number."""
    if not isinstance(value, Tensor):
        kind = type(value).__name__
        raise InputError(
            f"expected one scalar tensor as loss, got {kind}; keep to torch, without .item(), float or numpy"
        )
    if value.ndim != 0:
        raise InputError(f"expected one scalar tensor as loss, got {value.dtype} of shape {tuple(value.shape)}")
    if not torch.isfinite(value):
        raise InputError(f"expected a finite scalar loss at the point, got {value.detach()}")


def _traced_gradient(value: Tensor, point: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """dL/dtheta, with the graph for its own derivative.  ValueError where the loss has none that leads to the point."""
    gradient = None
    if value.requires_grad:
        (gradient,) = torch.autograd.grad(value, point, create_graph=True, allow_unused=True)
    if gradient is None:
        raise InputError(
            "expected a loss computed from the point, got one that torch does not trace back to it; leave out .detach(), "
            "torch.tensor(...) and torch.no_grad(), or add 0 * point.sum() to a loss that is constant"
        )
    return gradient
