"""Sums over groups of rows that are the same to the last bit from run to run, on the CPU and on a GPU."""

from jaxtyping import Float, Int
from torch import Tensor


def group_sums(values: Float[Tensor, "n *k"], groups: Int[Tensor, " n"], count: int) -> Float[Tensor, "{count} *k"]:
    """The sum of the rows of each group; groups: the number, from 0, of the group of every row.

    A GPU's `index_add_` adds in whatever order its threads come; its `index_put_` sorts the rows by their groups first.  On the
    CPU it is the other way round.

    >>> import torch
    >>> group_sums(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([2, 0, 2]), 3)
    tensor([2., 0., 5.])
    """
    sums = values.new_zeros(count, *values.shape[1:])
    if values.is_cuda:
        return sums.index_put_((groups,), values, accumulate=True)
    return sums.index_add_(0, groups, values)
