"""Numbers of vectors that fit into a memory budget."""

import torch

from landscape import EigenSettings, SymmetricOperator

GIB = 2**30


def vectors_within(operator: SymmetricOperator, memory: float) -> int:
    """Number of vectors of the operator's length that fit into so many GiB."""
    return int(memory * GIB // (operator.dim * torch.empty((), dtype=operator.dtype).element_size()))


def basis_within(eigen: EigenSettings, room: int) -> int:
    """Number of vectors that the search for the ends may keep where there is room for so many; at least what it needs."""
    return min(eigen.basis, max(eigen.wanted + 3 * eigen.block, room))
