"""The Hessian of any torch objective L(theta), as derivative of the gradient (Pearlmutter 1994).

    H v = d/dtheta (g(theta) . v),   g = dL/dtheta

theta is one flat vector.  The graph of g is built once and kept; a product with one vector is one backward pass through it.
"""

from collections.abc import Callable, Iterable, Mapping
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call

from landscape.errors import InputError
from landscape.operators.operator import require_blocks, require_vectors


class ObjectiveHessian:
    """The Hessian of loss(theta) at `point`, in the dtype of point.

    loss: from a flat vector (n,) to a tensor of one finite number, by torch operations alone.  point: (n,), copied.  blocks:
    named ranges of rows; None: one block of all rows, "all".  value: the loss at the point.

    Raises InputError for a loss that torch cannot trace back to the point; its Hessian would wrongly be 0.  A loss that is
    linear in theta, or piecewise linear like an l1 norm, has the Hessian 0.

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

    @classmethod
    def of_module(
        cls, module: torch.nn.Module, loss: Callable[[Tensor, Tensor], Tensor], data: Iterable[tuple[Tensor, Tensor]]
    ) -> "ObjectiveHessian":
        """The Hessian of a module's mean loss over batches, in its parameters that require a gradient; a block for each.

        loss: from outputs and targets to a tensor of one number.  data: (inputs, targets) of each batch, all weighted alike;
        the graph of all is kept.  Call `module.eval()` first where it has dropout, whose noise has no Hessian.

        >>> net = torch.nn.Linear(2, 1, bias=False)
        >>> H = ObjectiveHessian.of_module(net, torch.nn.functional.mse_loss, [(torch.eye(2), torch.zeros(2, 1))])
        >>> H.blocks, H.apply(torch.eye(2))  # of |w|^2 / 2
        ({'weight': slice(0, 2, None)}, tensor([[1., 0.],
                [0., 1.]]))
        """
        parameters = {name: part.detach() for name, part in module.named_parameters() if part.requires_grad}
        if not parameters:
            raise InputError(f"expected a module with parameters that require a gradient, got {type(module).__name__}")
        batches, sizes = list(data), [part.numel() for part in parameters.values()]
        if not batches:
            raise InputError("expected at least one batch (inputs, targets), got none")
        ends = list(accumulate(sizes))
        blocks = {name: slice(end - size, end) for name, size, end in zip(parameters, sizes, ends, strict=True)}

        def mean_loss(theta: Tensor) -> Tensor:
            parts = zip(parameters.items(), theta.split(sizes), strict=True)
            state = {name: part.view_as(shape) for (name, shape), part in parts}
            losses = [loss(functional_call(module, state, (inputs,)), targets) for inputs, targets in batches]
            return torch.stack(losses).mean()

        return cls(mean_loss, torch.cat([part.reshape(-1) for part in parameters.values()]), blocks)

    @property
    def gradient(self) -> Float[Tensor, " n"]:
        """dL/dtheta at the point."""
        return self._gradient.detach()

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim)
        if not self._gradient.requires_grad:  # the objective is linear in theta
            return torch.zeros_like(V)
        columns = [
            torch.autograd.grad(self._gradient, self._point, v, retain_graph=True, materialize_grads=True)[0]
            for v in V.unbind(dim=1)
        ]
        return torch.stack(columns, dim=1) if columns else torch.zeros_like(V)


def _require_loss(value: object) -> None:
    """Raise InputError unless value is a tensor of one finite number."""
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
    """dL/dtheta with its graph, for another derivative.  Raises InputError where no graph connects loss and point."""
    gradient = None
    if value.requires_grad:
        (gradient,) = torch.autograd.grad(value, point, create_graph=True, allow_unused=True)
    if gradient is None:
        raise InputError(
            "expected a loss computed from the point, got one that torch does not trace back to it; leave out .detach(), "
            "torch.tensor(...) and torch.no_grad(), or add 0 * point.sum() to a loss that is constant"
        )
    return gradient
