"""The parameters of a renderer: named leaf tensors, read as one vector and moved in place."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import require_blocks


class Parameters:
    """Named leaf tensors as one vector (n,), in the order of the mapping; `blocks` names the rows of each.

    Neighbours whose names agree before a slash, as sh/dc and sh/rest, are one block.
    InputError unless all are leaves of one floating type and device that require a gradient, and finite.
    """

    def __init__(self, named: Mapping[str, Tensor]) -> None:
        if not isinstance(named, Mapping) or not named:
            raise InputError(f"expected a dict of named tensors as parameters, got {type(named).__name__} without any")
        for name, tensor in named.items():
            if not (isinstance(tensor, Tensor) and tensor.is_leaf and tensor.requires_grad):
                raise InputError(
                    f"expected leaf tensors that require a gradient as parameters, got another as {name!r}; "
                    "name the tensors that the optimiser updates"
                )
            if not torch.isfinite(tensor).all():
                raise InputError(f"expected finite parameters, got NaN or infinity in {name!r}")
        kinds = {(tensor.dtype, tensor.device) for tensor in named.values()}
        if len(kinds) > 1:
            raise InputError(f"expected parameters of one type on one device, got {sorted(map(str, kinds))}")
        self.tensors = list(named.values())
        ends = list(accumulate(tensor.numel() for tensor in self.tensors))
        self.rows = [slice(end - tensor.numel(), end) for tensor, end in zip(self.tensors, ends, strict=True)]
        joined: dict[str, slice] = {}
        for name, rows in zip(named, self.rows, strict=True):
            block = name.split("/")[0]
            joined[block] = slice(joined.get(block, rows).start, rows.stop)
        self.blocks = require_blocks(joined, ends[-1])
        self.dim, (self.dtype, self.device) = ends[-1], kinds.pop()

    @property
    def flat(self) -> Float[Tensor, " n"]:
        """A copy of the parameters as they are now."""
        return self.vector(self.tensors).clone()

    def vector(self, parts: Sequence[Tensor]) -> Float[Tensor, " n"]:
        """Tensors of the parameters' shapes as one vector."""
        return torch.cat([part.detach().reshape(-1) for part in parts])

    def write(self, flat: Float[Tensor, " n"]) -> None:
        """Set the parameters, rounded to their type.

        It writes to `data`, unseen by autograd: a graph can be used again when the numbers it was made with are back.
        """
        for tensor, rows in zip(self.tensors, self.rows, strict=True):
            tensor.data.copy_(flat[rows].view_as(tensor))

    @contextmanager
    def restored(self) -> Iterator[Float[Tensor, " n"]]:
        """Yield the parameters as one vector; afterwards they are what they were to the bit, after an exception too."""
        before = self.flat
        try:
            yield before
        finally:
            self.write(before)

    def vjp(self, image: Tensor, cotangent: Tensor, keep: bool = False) -> Float[Tensor, " n"]:
        """J^T times the cotangent, for an image with a graph.  keep: the graph."""
        parts = torch.autograd.grad(
            image, self.tensors, cotangent.to(image), retain_graph=keep, allow_unused=True, materialize_grads=True
        )
        return self.vector(parts)
