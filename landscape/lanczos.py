"""The Lanczos recurrence with full re-orthogonalisation (Lanczos 1950, Paige 1972).

    H Q = Q T + r e_m^T      Q (n, m) orthonormal, T tridiagonal, r orthogonal to Q

Vectors are in the operator's dtype, T in float64.  Every new vector is orthogonalised twice against all the earlier
ones: the first pass leaves components of the size of its own round-off, the second removes them and corrects the
entries of T ("twice is enough", Kahan and Parlett).  Rows of the workspaces are vectors, so that each is contiguous.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.operator import SymmetricOperator, product, require_finite
from landscape.results import Progress

SMALLEST = 1e-140  # a length whose square has all its digits, and those of its parts


@dataclass(frozen=True, eq=False)
class LanczosFactorization:
    """H Q = Q T + r e_m^T, m the steps made: fewer than asked for where Q spans an invariant subspace (r = 0) or was enough."""

    Q: Float[Tensor, "n m"]
    T: Float64[Tensor, "m m"]
    r: Float[Tensor, " n"]


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


def is_dust(length: float, scale: float, dtype: torch.dtype) -> bool:
    """Whether a remainder this long is the round-off of orthogonalising vectors of length `scale`."""
    return length <= 10 * torch.finfo(dtype).eps * scale


def lanczos(
    operator: SymmetricOperator,
    starts: Float[Tensor, "n k"],
    steps: int,
    progress: Progress | None = None,
    scale: float = 0.0,
    enough: Callable[[Sequence[tuple[Float64[Tensor, "m m"], float]]], bool] | None = None,
) -> list[LanczosFactorization]:
    """One factorisation per column of starts, run in lock-step so that the operator sees blocks of k vectors.

    Memory: k * steps vectors.  starts: not zero, of any length.  A recurrence ends early where its remainder is round-off.
    scale: |H|, where starts do not show it (because they were projected off the largest eigenvectors, say): round-off is
    then relative to it.  enough: is given (T, |r|) of every run after each step; once it returns True, all end.

    >>> from landscape.operator import DenseOperator
    >>> A = DenseOperator(torch.diag(torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)))
    >>> (f,) = lanczos(A, torch.ones(3, 1, dtype=torch.float64), steps=3)
    >>> [round(x, 9) for x in torch.linalg.eigvalsh(f.T).tolist()]
    [1.0, 2.0, 4.0]
    """
    n, k = starts.shape
    if steps < 1:
        raise ValueError(f"expected at least one Lanczos step, got {steps}")
    units = unit_columns(starts)
    steps = min(steps, n)
    basis = starts.new_empty(k, steps, n, dtype=operator.dtype)
    T = torch.zeros(k, steps, steps, dtype=torch.float64)
    remainders = units.T.to(operator.dtype).contiguous()
    sizes, lengths, running = [0] * k, [0.0] * k, list(range(k))
    for j in range(steps):
        for i in running:
            basis[i, j] = remainders[i]
            if j:
                T[i, j - 1, j] = T[i, j, j - 1] = lengths[i]
        products = product(operator, torch.stack([basis[i, j] for i in running], dim=1), finite=False).T
        for i, column in zip(list(running), products, strict=True):
            w = column.clone()[None]
            length = norm(w)
            require_finite(operator, isfinite(length))
            size = max(scale, length)
            T[i, j, j] = orthogonalise(w, basis[i, : j + 1])[j, 0]
            sizes[i], lengths[i] = j + 1, norm(w)
            if is_dust(lengths[i], max(size, float(T[i].abs().max())), operator.dtype):
                running.remove(i)
                lengths[i] = 0.0
            remainders[i] = w[0] / (lengths[i] or 1.0)
        if progress:
            progress((j + 1) * k, steps * k, f"Lanczos step {j + 1} of {steps}")
        rules = [T[i, :m, :m] for i, m in enumerate(sizes)]
        if not running or (enough and enough(list(zip(rules, lengths, strict=True)))):
            break
    return [LanczosFactorization(basis[i, :m].T, T[i, :m, :m], remainders[i] * lengths[i]) for i, m in enumerate(sizes)]
