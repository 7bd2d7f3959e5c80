"""The Lanczos recurrence with full re-orthogonalisation (Lanczos 1950, Paige 1972).

    H Q = Q T + r e_m^T      Q (n, m) orthonormal, T tridiagonal, r orthogonal to Q

Vectors have the operator's dtype, T is float64.  Every new vector is orthogonalised twice against all earlier ones
(`linalg.orthogonalise`).  Vectors are rows of the workspaces, so that each is contiguous.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.linalg import is_roundoff, norm, orthogonalise, unit_columns
from landscape.operators.operator import SymmetricOperator, product, require_finite
from landscape.results import Progress, ShortRepr


@dataclass(frozen=True, eq=False, repr=False)
class LanczosFactorization(ShortRepr):
    """H Q = Q T + r e_m^T after m steps: fewer than asked for if Q spans an invariant subspace (r = 0) or `enough` ended it."""

    Q: Float[Tensor, "n m"]
    T: Float64[Tensor, "m m"]
    r: Float[Tensor, " n"]


def lanczos(
    operator: SymmetricOperator,
    starts: Float[Tensor, "n k"],
    steps: int,
    progress: Progress | None = None,
    scale: float = 0.0,
    enough: Callable[[Sequence[tuple[Float64[Tensor, "m m"], float]]], bool] | None = None,
) -> list[LanczosFactorization]:
    """One factorisation for each column of starts, all one step at a time, so that H is applied to blocks of k vectors.

    Memory: k * steps vectors.  starts: not zero, of any length.  A recurrence ends early where its remainder is only round-off
    relative to |H|.  scale: |H| where the starts do not show it, for example if the largest eigenvectors were projected out.
    enough: called with (T, |r|) of every recurrence after each step; all end when it returns True.

    >>> from landscape.operators.operator import DenseOperator
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
            if is_roundoff(lengths[i], max(size, float(T[i].abs().max())), operator.dtype):
                running.remove(i)
                lengths[i] = 0.0
            remainders[i] = w[0] / (lengths[i] or 1.0)
        if progress:
            progress((j + 1) * k, steps * k, f"Lanczos step {j + 1} of {steps}")
        rules = [T[i, :m, :m] for i, m in enumerate(sizes)]
        if not running or (enough and enough(list(zip(rules, lengths, strict=True)))):
            break
    return [LanczosFactorization(basis[i, :m].T, T[i, :m, :m], remainders[i] * lengths[i]) for i, m in enumerate(sizes)]
