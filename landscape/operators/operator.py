"""Symmetric operators: the interface between an objective's curvature and the estimators.

An operator H has n rows (`dim`), named ranges of rows (`blocks`; for a scene one per attribute), a `dtype`, and
`apply(V) -> H V` for k vectors at once, V of shape (n, k).  Operators compose:

    SumOperator         sum_i H_i
    RestrictedOperator  E^T H E     one block, E its rows of the identity
    ScaledOperator      D H D       a change of units: the curvature in theta / d, D = diag(d)
    ProjectedOperator   P H P       P an orthogonal projector, to remove a known null space
    CountingOperator    H           counts vectors

An operator that wraps another one has the same rows, blocks and dtype unless stated otherwise.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError


@runtime_checkable
class SymmetricOperator(Protocol):
    """H = H^T, given by its products with blocks of vectors.

    dim: the number n of rows.  blocks: named, disjoint ranges of rows; one, "all", for an operator without structure.
    dtype: of V and of H V.  Both lie on the device of the generator that an estimator is given.
    """

    @property
    def dim(self) -> int: ...

    @property
    def blocks(self) -> Mapping[str, slice]: ...

    @property
    def dtype(self) -> torch.dtype: ...

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """H V.  The next call may overwrite it.  Raises ValueError unless V has the shape (dim, k) and the dtype."""
        ...


def require_vectors(V: Tensor, n: int, dtype: torch.dtype, device: torch.device | None = None) -> None:
    """Raise ValueError unless V is (n, k), of the operator's dtype and, where one is named, on its device."""
    if V.ndim == 1 and V.shape[0] == n:
        raise ValueError(f"expected V of shape (n, k) with n = {n}, got ({n},); use V[:, None]")
    if V.ndim != 2 or V.shape[0] != n:
        raise ValueError(f"expected V of shape (n, k) with n = {n}, got {tuple(V.shape)}")
    if V.dtype != dtype or (device is not None and V.device != device):
        where = "" if device is None else f" on {device}"
        raise ValueError(f"expected V of {dtype}{where}, got {V.dtype} on {V.device}; use V.to(...)")


def product(operator: SymmetricOperator, V: Float[Tensor, "n k"], finite: bool = True) -> Float[Tensor, "n k"]:
    """H V, checked.  The next call may overwrite it.  Raises InputError unless it is finite, with the shape and dtype of V.

    finite: False leaves out the check for finiteness, for which the CPU has to wait for a GPU.  Such callers pass a number that
    they need anyway to `require_finite`.
    """
    HV = operator.apply(V)
    if HV.shape != V.shape or HV.dtype != V.dtype:
        raise InputError(
            f"expected products H V of the shape {tuple(V.shape)} and dtype {V.dtype} of V, got {tuple(HV.shape)} and "
            f"{HV.dtype} in {', '.join(operator.blocks)}"
        )
    if finite:
        require_finite(operator, bool(torch.isfinite(HV).all()))
    return HV


def require_finite(operator: SymmetricOperator, finite: bool) -> None:
    """Raise InputError, with the names of the operator's blocks, unless its products are finite."""
    if not finite:
        raise InputError(
            f"expected finite products H V, got NaN or infinity in {', '.join(operator.blocks)}; check the parameters with "
            "check_operator"
        )


def products(operator: SymmetricOperator, V: Float[Tensor, "n k"], batch: int) -> Float[Tensor, "n k"]:
    """H V in a tensor of its own, from products with `batch` vectors at a time."""
    result = torch.empty_like(V)
    for part, vectors in zip(result.split(batch, dim=1), V.split(batch, dim=1), strict=True):
        if vectors.shape[1]:
            part.copy_(product(operator, vectors.contiguous()))
    return result


def require_blocks(blocks: Mapping[str, slice], n: int) -> dict[str, slice]:
    """A copy of blocks.  Raises InputError unless they are disjoint ranges of 0..n."""
    end = 0
    for name, block in sorted(blocks.items(), key=lambda item: (item[1].start or 0, item[1].stop or 0)):
        if block.start is None or block.stop is None or block.step not in (None, 1):
            raise InputError(f"expected block {name!r} as slice(start, stop), got {block}")
        if not end <= block.start <= block.stop <= n:
            raise InputError(
                f"expected disjoint blocks within 0..{n}, got {name!r} = {block.start}..{block.stop} after {end}"
            )
        end = block.stop
    return dict(blocks)


class DenseOperator:
    """A symmetric matrix as an operator.

    blocks: None means one block of all rows, "all".  Raises InputError unless the matrix is square, finite and symmetric to
    round-off, and the blocks are disjoint.

    >>> H = DenseOperator(torch.tensor([[2.0, 1.0], [1.0, 3.0]]))
    >>> H.apply(torch.tensor([[1.0], [-1.0]]))
    tensor([[ 1.],
            [-2.]])
    """

    def __init__(self, matrix: Float[Tensor, "n n"], blocks: Mapping[str, slice] | None = None) -> None:
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
            raise InputError(f"expected a square matrix, got shape {tuple(matrix.shape)}")
        if not torch.isfinite(matrix).all():
            raise InputError("expected a finite matrix, got NaN or infinite entries")
        gap = float((matrix - matrix.T).abs().max()) if matrix.numel() else 0.0
        largest = float(matrix.abs().max()) if matrix.numel() else 0.0
        if gap > matrix.shape[0] * torch.finfo(matrix.dtype).eps * largest:
            raise InputError(f"expected a symmetric matrix, got |A - A^T| = {gap:.1e}; use (A + A.T) / 2")
        self.matrix = matrix
        self.dim = matrix.shape[0]
        self.dtype = matrix.dtype
        self.blocks = require_blocks({"all": slice(0, self.dim)} if blocks is None else blocks, self.dim)

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype, self.matrix.device)
        return self.matrix @ V


class SumOperator:
    """sum_i H_i.  Raises ValueError unless all H_i have the same rows, blocks and dtype."""

    def __init__(self, terms: Sequence[SymmetricOperator]) -> None:
        if not terms:
            raise ValueError("expected at least one operator to sum, got none")
        first = terms[0]
        for term in terms[1:]:
            if (term.dim, term.dtype, dict(term.blocks)) != (first.dim, first.dtype, dict(first.blocks)):
                raise ValueError(
                    f"expected operators of {first.dim} rows, {first.dtype} and blocks {', '.join(first.blocks)}, "
                    f"got {term.dim} rows, {term.dtype} and blocks {', '.join(term.blocks)}"
                )
        self.terms = tuple(terms)
        self.dim, self.dtype, self.blocks = first.dim, first.dtype, first.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype)
        total = self.terms[0].apply(V).clone()
        for term in self.terms[1:]:
            total += term.apply(V)
        return total


class RestrictedOperator:
    """E^T H E: the diagonal block of H on one named block of rows.  A product with it costs a product with H.

    >>> H = DenseOperator(torch.tensor([[2.0, 1.0], [1.0, 3.0]]), {"a": slice(0, 1), "b": slice(1, 2)})
    >>> RestrictedOperator(H, "b").apply(torch.ones(1, 1))
    tensor([[3.]])
    """

    def __init__(self, inner: SymmetricOperator, block: str) -> None:
        if block not in inner.blocks:
            raise ValueError(f"expected a block out of {', '.join(inner.blocks)}, got {block!r}")
        self.inner = inner
        self.rows = inner.blocks[block]
        self.dim = self.rows.stop - self.rows.start
        self.dtype = inner.dtype
        self.blocks = {block: slice(0, self.dim)}

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype)
        padded = V.new_zeros(self.inner.dim, V.shape[1])
        padded[self.rows] = V
        return self.inner.apply(padded)[self.rows]


class ScaledOperator:
    """D H D with D = diag(scale), for n finite scales: the Hessian with respect to theta / scale."""

    def __init__(self, inner: SymmetricOperator, scale: Float[Tensor, " n"]) -> None:
        if scale.shape != (inner.dim,) or not torch.isfinite(scale).all():
            raise ValueError(f"expected {inner.dim} finite scales, got shape {tuple(scale.shape)}")
        self.inner = inner
        self.scale = scale.to(inner.dtype)[:, None]
        self.dim, self.dtype, self.blocks = inner.dim, inner.dtype, inner.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype)
        return self.scale * self.inner.apply(self.scale * V)


class ProjectedOperator:
    """P H P for an orthogonal projector `project(V) -> P V`, V of shape (n, k).

    `project` must be linear, symmetric and idempotent, which is not checked.
    """

    def __init__(self, inner: SymmetricOperator, project: Callable[[Tensor], Tensor]) -> None:
        self.inner, self.project = inner, project
        self.dim, self.dtype, self.blocks = inner.dim, inner.dtype, inner.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype)
        return self.project(self.inner.apply(self.project(V)))


class LiftedOperator:
    """P H P + c (1 - P) for an operator that is P H P, and a Rayleigh quotient c of it.

    c lies between the smallest and the largest eigenvalue of P H P: the null space that P leaves out is at neither end.

    >>> H, P = DenseOperator(torch.diag(torch.tensor([2.0, 1.0, 0.0]))), torch.diag(torch.tensor([1.0, 1.0, 0.0]))
    >>> lifted = LiftedOperator(H, lambda V: P @ V, torch.Generator().manual_seed(0))
    >>> 1 < float(lifted.apply(torch.eye(3))[2, 2]) < 2
    True
    """

    def __init__(
        self, inner: SymmetricOperator, project: Callable[[Tensor], Tensor], generator: torch.Generator
    ) -> None:
        self.inner, self.project = inner, project
        self.dim, self.dtype, self.blocks = inner.dim, inner.dtype, inner.blocks
        v = project(torch.randn(inner.dim, 1, generator=generator, dtype=inner.dtype, device=generator.device))
        self.level = float((v * inner.apply(v)).sum() / v.square().sum())

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype)
        return self.inner.apply(V).add_(V - self.project(V), alpha=self.level)


class CountingOperator:
    """H, with a count of its use: matvecs, the vectors that it was applied to so far."""

    def __init__(self, inner: SymmetricOperator) -> None:
        self.inner = inner
        self.dim, self.dtype, self.blocks = inner.dim, inner.dtype, inner.blocks
        self.matvecs = 0

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        result = self.inner.apply(V)
        self.matvecs += V.shape[1]
        return result
