"""How many vectors of an operator fit into a memory budget."""

import torch

from landscape import EigenSettings, SymmetricOperator

GIB = 2**30


def vectors_within(operator: SymmetricOperator, memory: float) -> int:
    """How many vectors of the operator's length fit into so many GiB."""
    return int(memory * GIB // (operator.dim * torch.empty((), dtype=operator.dtype).element_size()))


def basis_within(eigen: EigenSettings, room: int) -> int:
    """How many vectors the search for the ends may keep where there is room for so many; as many as it needs at least."""
    return min(eigen.basis, max(eigen.wanted + 3 * eigen.block, room))
