"""Linear algebra of tall vectors: lengths, dot products, orthogonalisation and sums over groups of rows.

Sums are accumulated in float64 and are the same to the last bit from run to run, on the CPU and on a GPU.
"""

from math import inf, isfinite

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

SMALLEST = 1e-140  # a length whose square has all its digits, and those of its parts
ROWS = 65_536  # taken to float64 at a time


def orthogonalise(vectors: Float[Tensor, "b n"], basis: Float[Tensor, "m n"]) -> Float64[Tensor, "m b"]:
    """Remove from vectors, in place, their components along the orthonormal rows of basis; return these, on the CPU."""
    components = basis.new_zeros(basis.shape[0], vectors.shape[0], dtype=torch.float64)
    for _ in range(2):  # "twice is enough"
        part = basis @ vectors.T
        vectors.addmm_(part.T, basis, alpha=-1)
        components += part.double()
    return components.cpu()


def norm(vector: Tensor) -> float:
    """Euclidean length, added up in float64; where squares leave its range, in units of the largest entry."""
    length = float(torch.linalg.vector_norm(vector, dtype=torch.float64))
    if SMALLEST < length < inf or not vector.numel():
        return length
    unit = float(vector.abs().max())
    if unit == 0 or not isfinite(unit):
        return unit
    return unit * float(torch.linalg.vector_norm(vector / unit, dtype=torch.float64))


def unit_columns(vectors: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The directions of start vectors.  ValueError where one is 0 or not finite."""
    lengths = torch.linalg.vector_norm(vectors, dim=0, dtype=torch.float64)
    if not ((lengths > 0) & torch.isfinite(lengths)).all():
        raise ValueError(f"expected finite start vectors that are not zero, got lengths {lengths.tolist()}")
    return vectors / lengths.to(vectors.dtype)


def is_roundoff(length: float, scale: float, dtype: torch.dtype) -> bool:
    """Whether a remainder this long is the round-off of orthogonalising vectors of length `scale`."""
    return length <= 10 * torch.finfo(dtype).eps * scale


def gram(A: Float[Tensor, "n k"], B: Float[Tensor, "n l"]) -> Float64[Tensor, "k l"]:
    """A^T B, accumulated in float64."""
    total = A.new_zeros(A.shape[1], B.shape[1], dtype=torch.float64)
    for start in range(0, len(A), ROWS):
        rows = slice(start, start + ROWS)
        total += A[rows].double().T @ B[rows].double()
    return total


def column_dots(A: Float[Tensor, "n k"], B: Float[Tensor, "n k"]) -> Float64[Tensor, " k"]:
    """The diagonal of A^T B, accumulated in float64."""
    return sum((a.double() * b.double()).sum(dim=0) for a, b in zip(A.split(ROWS), B.split(ROWS), strict=True))  # pyright: ignore


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
