"""Linear algebra of long vectors: lengths, dot products, orthogonalisation, sums over groups of rows.

Sums are accumulated in float64.  They are the same to the last bit from run to run, on the CPU and on a GPU.
"""

from math import inf, isfinite

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from landscape.errors import InputError

SMALLEST = 1e-140  # shorter vectors are rescaled: the squares of their entries lose digits near 1e-308
ROWS = 65_536  # converted to float64 at a time


def orthogonalise(vectors: Float[Tensor, "b n"], basis: Float[Tensor, "m n"]) -> Float64[Tensor, "m b"]:
    """Remove the components of vectors along the orthonormal rows of basis, in place; return these components, on the CPU."""
    components = basis.new_zeros(basis.shape[0], vectors.shape[0], dtype=torch.float64)
    for _ in range(2):  # "twice is enough": the second pass removes the round-off of the first (Kahan and Parlett)
        part = basis @ vectors.T
        vectors.addmm_(part.T, basis, alpha=-1)
        components += part.double()
    return components.cpu()


def norm(vector: Tensor) -> float:
    """Euclidean length in float64.  Where squares leave the range of float64, entries are divided by the largest first."""
    length = float(torch.linalg.vector_norm(vector, dtype=torch.float64))
    if SMALLEST < length < inf or not vector.numel():
        return length
    unit = float(vector.abs().max())
    if unit == 0 or not isfinite(unit):
        return unit
    return unit * float(torch.linalg.vector_norm(vector / unit, dtype=torch.float64))


def unit_columns(vectors: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Columns divided by their lengths.  Raises InputError where a length is zero or not finite."""
    return vectors / column_lengths(vectors, "start vectors").to(vectors.dtype)


def column_lengths(vectors: Float[Tensor, "n k"], name: str) -> Float64[Tensor, " k"]:
    """Euclidean lengths of the columns.  Raises InputError, with this name for them, where one is zero or not finite."""
    lengths = torch.linalg.vector_norm(vectors, dim=0, dtype=torch.float64)
    if not ((lengths > 0) & torch.isfinite(lengths)).all():
        raise InputError(f"expected finite {name} that are not zero, got lengths {lengths.tolist()}")
    return lengths


def is_roundoff(length: float, scale: float, dtype: torch.dtype) -> bool:
    """Whether a remainder of this length is only round-off, left by orthogonalising vectors of length `scale`."""
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
    """Sum of the rows of each group.  groups: the number (from 0) of every row's group.

    The order of additions is fixed on both devices: `index_put_` sorts the rows by group on a GPU, where `index_add_` adds in
    any order; on the CPU `index_add_` is the one with a fixed order.

    >>> import torch
    >>> group_sums(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([2, 0, 2]), 3)
    tensor([2., 0., 5.])
    """
    sums = values.new_zeros(count, *values.shape[1:])
    if values.is_cuda:
        return sums.index_put_((groups,), values, accumulate=True)
    return sums.index_add_(0, groups, values)
