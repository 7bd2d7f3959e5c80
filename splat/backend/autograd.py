"""The end of differentiation, for torch functions made of kernels."""

import torch
from torch import Tensor

THIRD = "expected at most two derivatives of the kernels, got a third; render with backend='reference' for more"


class _Last(torch.autograd.Function):
    """The first `count` tensors, on the graph of them all, with a derivative that is an error."""

    @staticmethod
    def forward(_ctx, count: int, *tensors: Tensor):
        return tensors[:count]

    @staticmethod
    def backward(_ctx, *_outputs: Tensor):
        raise NotImplementedError(THIRD)


def last_derivative(values: tuple[Tensor, ...], *sources: Tensor) -> tuple[Tensor, ...]:
    """Derivatives by a kernel: on the graph of their inputs, so that the next is refused, not taken for 0."""
    return _Last.apply(len(values), *values, *sources)  # pyright: ignore[reportReturnType]
