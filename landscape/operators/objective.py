"""The Hessian of any torch objective L(theta), as derivative of the gradient (Pearlmutter 1994).

    H v = d/dtheta (g(theta) . v),   g = dL/dtheta

theta is one flat vector.  The graph of g is built once and kept; a product with one vector is one backward pass through it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate
from typing import Literal

import psutil
import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call
from torch.nn.attention import SDPBackend, sdpa_kernel

from landscape.errors import InputError, lacks_memory
from landscape.operators.operator import require_blocks, require_vectors
from landscape.operators.second_derivative import require_hessian

KINDS = (torch.float32, torch.float64)
REMEDIES = {  # words in an error of torch, while it computes a loss: what to do
    "dtype": "give parameters, inputs and targets one dtype, as by `.double()`",
    "scalar type": "give parameters, inputs and targets one dtype, as by `.double()`",
    "device": "move parameters, inputs and targets to one device",
}
REMEDIES_TWICE = {  # in one while it differentiates
    "embedding_bag": "take nn.Embedding and the mean or sum over its rows",
    "torch.compile": "take the module that was compiled, `compiled._orig_mod`",
    "cudnn": "compute the loss within torch.backends.cudnn.flags(enabled=False)",
    "checkpoint": "call checkpoint(use_reentrant=False), or leave it out",
    "": "write that operation with others that have a second derivative",
}


class ObjectiveHessian:
    """The Hessian of loss(theta) at `point`, in the dtype of point.

    loss: from a flat vector (n,) to a tensor of one finite number, by torch operations alone.  Pairs (weight, loss) are summed;
    graphs of the first are kept while half of the free memory is left, those of the others built anew in each call of `apply`.
    point: (n,) of float32 or float64, copied; or a dict of tensors, which loss then takes in place of the vector.
    blocks: named ranges of rows; None: those of the dict's tensors, or one block of all rows, "all".
    value: the loss at the point.

    Raises InputError for a loss that torch cannot trace back to the point, or whose gradient it cannot differentiate: H would
    wrongly be 0, or lack a part.  `require_hessian` tells, from 2 products and 3 gradients; from 16 where there are kinks.
    A loss that is linear in theta, or piecewise linear like an l1 norm, has the Hessian 0.  Attention is computed by torch's
    plain formula, since the fused ones have no second derivative.

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
        loss: Callable[..., Tensor] | Sequence[tuple[float, Callable[..., Tensor]]],
        point: Float[Tensor, " n"] | Mapping[str, Tensor],
        blocks: Mapping[str, slice] | None = None,
    ) -> None:
        terms = [(1.0, loss)] if callable(loss) else list(loss)
        if isinstance(point, Mapping):
            parts = _require_one_kind(point)
        elif isinstance(point, Tensor) and point.ndim == 1 and point.dtype in KINDS:
            parts = {"all": point}
            terms = [(weight, lambda parts, loss=loss: loss(parts["all"])) for weight, loss in terms]
        else:
            got = f"{point.dtype} of shape {tuple(point.shape)}" if isinstance(point, Tensor) else type(point).__name__
            raise InputError(
                f"expected one flat vector of float32 or float64 as point, or a dict of tensors, got {got}"
            )
        sizes = [part.numel() for part in parts.values()]
        ends = list(accumulate(sizes))
        rows = {name: slice(end - size, end) for name, size, end in zip(parts, sizes, ends, strict=True)}
        center = torch.cat([part.detach().reshape(-1) for part in parts.values()])
        self.dim, self.dtype, self._device = center.numel(), center.dtype, center.device
        self.blocks = require_blocks(rows if blocks is None else blocks, self.dim)
        self._shapes, self._terms = {name: part.shape for name, part in parts.items()}, terms
        self._point = self._leaves(center.clone())
        self.value, self._gradient = 0.0, torch.zeros_like(center)
        self._kept: list[Tensor | None] = [None] * len(parts)  # the gradient of the first terms, with its graph
        enough, kept = _free_memory(self._device) / 2, 0
        for number, term in enumerate(terms):
            value, gradient = self._at(self._point, term, create_graph=True)
            self.value += value
            self._gradient += self._flat(gradient).detach()
            if kept == number and (not kept or _free_memory(self._device) > enough):
                pairs = zip(self._kept, gradient, strict=True)
                self._kept, kept = [b if a is None else a if b is None else a + b for a, b in pairs], kept + 1
        self._anew = terms[kept:]
        require_hessian(self, self._gradient_at, center, self._gradient)

    @classmethod
    def of_module(
        cls,
        module: torch.nn.Module,
        loss: Callable[[Tensor, Tensor], Tensor],
        data: Iterable[tuple[Tensor, Tensor]],
        alike: Literal["samples", "batches"] = "samples",
    ) -> "ObjectiveHessian":
        """The Hessian of a module's mean loss, in its parameters that require a gradient; a block for each of them.

        loss: from outputs and targets of a batch to their mean, a tensor of one number.  data: (inputs, targets) of each batch.
        alike: what has the same weight; "samples": a batch counts by the rows of its targets.
        The module keeps its parameters, its buffers and its mode.  In training mode, normalisation over a batch is part of the
        loss; dropout, whose noise has no Hessian, is refused: call `module.eval()` first.

        >>> net = torch.nn.Linear(2, 1, bias=False)
        >>> H = ObjectiveHessian.of_module(net, torch.nn.functional.mse_loss, [(torch.eye(2), torch.zeros(2, 1))])
        >>> H.blocks, H.apply(torch.eye(2))  # of |w|^2 / 2
        ({'weight': slice(0, 2, None)}, tensor([[1., 0.],
                [0., 1.]]))
        """
        parameters = {name: part.detach() for name, part in module.named_parameters() if part.requires_grad}
        if not parameters:
            raise InputError(f"expected a module with parameters that require a gradient, got {type(module).__name__}")
        batches = list(data)
        if not batches:
            raise InputError("expected at least one batch (inputs, targets), got none")
        sizes = [_rows(targets) if alike == "samples" else 1 for _, targets in batches]

        def of_batch(inputs: Tensor, targets: Tensor) -> Callable[[Mapping[str, Tensor]], Tensor]:
            def mean_loss(parts: Mapping[str, Tensor]) -> Tensor:
                buffers = {name: part.clone() for name, part in module.named_buffers()}  # a layer may change them
                return loss(functional_call(module, {**buffers, **parts}, (inputs,)), targets)

            return mean_loss

        terms = [(size / sum(sizes), of_batch(*batch)) for size, batch in zip(sizes, batches, strict=True)]
        return cls(terms, parameters)

    @property
    def gradient(self) -> Float[Tensor, " n"]:
        """dL/dtheta at the point."""
        return self._gradient

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype, self._device)
        HV = self._product(self._kept, V)
        for term in self._anew:
            HV += self._product(self._at(self._point, term, create_graph=True)[1], V)
        return HV

    def _product(self, gradient: list[Tensor | None], V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """d(gradient . v)/d point for each column v; 0 for a gradient without a graph, of a loss linear in the point."""
        names = [
            name for name, part in zip(self._point, gradient, strict=True) if part is not None and part.requires_grad
        ]
        outputs = [part for part in gradient if part is not None and part.requires_grad]
        if not outputs or not V.shape[1]:
            return torch.zeros_like(V)
        columns, leaves = [], list(self._point.values())
        for v in V.unbind(dim=1):
            parts = self._split(v)
            vectors = [parts[name] for name in names]
            with _in_a_sentence(REMEDIES_TWICE):
                found = torch.autograd.grad(outputs, leaves, vectors, retain_graph=True, materialize_grads=True)
            columns.append(self._flat(found))
        return torch.stack(columns, dim=1)

    def _split(self, flat: Float[Tensor, " n"]) -> dict[str, Tensor]:
        """The parts of a flat vector, by name."""
        parts = flat.split([shape.numel() for shape in self._shapes.values()])
        return {name: part.view(shape) for (name, shape), part in zip(self._shapes.items(), parts, strict=True)}

    def _leaves(self, theta: Float[Tensor, " n"]) -> dict[str, Tensor]:
        """The same, each a tensor that a loss can be differentiated in."""
        return {name: part.detach().requires_grad_() for name, part in self._split(theta).items()}

    def _flat(self, parts: Iterable[Tensor | None]) -> Float[Tensor, " n"]:
        """One vector of a tensor for each part; None: zeros."""
        of_all = zip(parts, self._point.values(), strict=True)
        return torch.cat([(torch.zeros_like(leaf) if part is None else part).reshape(-1) for part, leaf in of_all])

    def _gradient_at(self, theta: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The gradient anywhere, without a graph."""
        total, parts = torch.zeros_like(theta), self._leaves(theta)
        for term in self._terms:
            total += self._flat(self._at(parts, term, create_graph=False)[1])
        return total

    def _at(
        self, point: Mapping[str, Tensor], term: tuple[float, Callable[..., Tensor]], create_graph: bool
    ) -> tuple[float, list[Tensor | None]]:
        """Value of one term, and its gradient in each part.  Raises InputError unless torch traces it back to them."""
        (weight, loss), leaves = term, list(point.values())
        versions = [leaf._version for leaf in leaves]  # they count changes in place, which would move the point
        with sdpa_kernel(SDPBackend.MATH), _in_a_sentence(REMEDIES):
            value = loss(point)
        _require_scalar(value)
        if create_graph and not torch.isfinite(value):  # elsewhere it may be
            raise InputError(f"expected a finite scalar loss at the point, got {value.detach()}")
        if [leaf._version for leaf in leaves] != versions:
            raise InputError(
                "expected a loss that leaves its point as it is, got one that changes it in place; copy it first"
            )
        gradient: list[Tensor | None] = [None]
        if value.requires_grad:
            with _in_a_sentence(REMEDIES_TWICE):
                value = value if weight == 1 else weight * value
                gradient = list(torch.autograd.grad(value, leaves, create_graph=create_graph, allow_unused=True))
        if all(part is None for part in gradient):
            raise InputError(
                "expected a loss computed from the point, got one that torch does not trace back to it; leave out .detach(), "
                "torch.tensor(...) and torch.no_grad(), or add 0 * point.sum() to a loss that is constant"
            )
        if any(part is not None and part.layout != torch.strided for part in gradient):
            raise InputError("expected dense gradients, got a sparse one; take nn.Embedding(sparse=False)")
        return float(value.detach()), gradient


def _require_one_kind(parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The parts.  Raises InputError unless they are different real tensors of one dtype and device."""
    kinds: dict[str, list[str]] = {}
    for name, part in parts.items():
        kind = f"{part.dtype} on {part.device}" if isinstance(part, Tensor) else type(part).__name__
        kinds.setdefault(kind, []).append(name)
    if len(kinds) != 1 or getattr(next(iter(parts.values())), "dtype", None) not in KINDS:
        got = " and ".join(f"{kind} in {', '.join(names[:3])}" for kind, names in kinds.items())
        raise InputError(
            f"expected parameters of one kind, torch.float32 or torch.float64 on one device, got {got or 'none'}; convert them "
            "with .float(), .double() or .to(device), complex ones with torch.view_as_real"
        )
    places: dict[int, list[str]] = {}
    for name, part in parts.items():
        places.setdefault(part.data_ptr() if part.numel() else -1 - len(places), []).append(name)
    if twice := [names for names in places.values() if len(names) > 1]:
        raise InputError(f"expected each parameter once, got one tensor as {' and '.join(twice[0])}; give it one name")
    return dict(parts)


def _rows(targets: object) -> int:
    """The number of samples of a batch, by its targets."""
    if not isinstance(targets, Tensor) or not targets.ndim:
        raise InputError(
            f"expected a tensor with a row for each sample as targets, got {type(targets).__name__}; say alike='batches'"
        )
    return len(targets)


def _free_memory(device: torch.device) -> int:
    """Free bytes on a device."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available


@contextmanager
def _in_a_sentence(remedies: Mapping[str, str]) -> Iterator[None]:
    """Raise an error of torch as InputError, with the remedy for the first word that it has; as it is if it has none."""
    try:
        yield
    except RuntimeError as error:
        found = next((remedy for word, remedy in remedies.items() if word in str(error).lower()), None)
        if found is None or lacks_memory(error):
            raise
        said = str(error).strip().split("\n")[0].split(". ")[0].rstrip(".")
        raise InputError(
            f"expected a loss with two derivatives by torch, got an error of it: {said}; {found}"
        ) from error


def _require_scalar(value: object) -> None:
    """Raise InputError unless value is a tensor of one number."""
    if not isinstance(value, Tensor):
        kind = type(value).__name__
        raise InputError(
            f"expected one scalar tensor as loss, got {kind}; keep to torch, without .item(), float or numpy"
        )
    if value.ndim != 0:
        raise InputError(f"expected one scalar tensor as loss, got {value.dtype} of shape {tuple(value.shape)}")
