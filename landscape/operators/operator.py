"""Symmetric operators: all that the rest of the package sees of an objective's curvature.

An operator H has n rows (`dim`), named groups of rows (`blocks`: one per attribute, say), a `dtype`, and
`apply(V) -> H V` for k vectors at once, V of shape (n, k).  Operators compose:

    SumOperator         sum_i w_i H_i
    RestrictedOperator  E^T H E     one block, E its rows of the identity
    ScaledOperator      D H D       a change of metric: curvature in the units theta / d
    ProjectedOperator   P H P       P an orthogonal projector, to leave a known null space out
    CountingOperator    H           counts the vectors it is applied to, and the seconds that takes

One that wraps another has its rows, blocks and dtype unless it says otherwise.
"""

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError


@runtime_checkable
class SymmetricOperator(Protocol):
    """H = H^T as a product with blocks of vectors: the interface that every estimator takes.

    dim: n, the number of rows.  blocks: named ranges of rows, disjoint; an operator without a structure has one, "all".
    dtype: of V and of H V; they are on the device of the generator that the estimator is given.
    """

    @property
    def dim(self) -> int: ...

    @property
    def blocks(self) -> Mapping[str, slice]: ...

    @property
    def dtype(self) -> torch.dtype: ...

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """H V, which the next call may overwrite.  Raises ValueError where V has another shape than (dim, k)."""
        ...


def require_vectors(V: Tensor, n: int) -> None:
    """Raise ValueError unless V is (n, k)."""
    if V.ndim == 1 and V.shape[0] == n:
        raise ValueError(f"expected V of shape (n, k) with n = {n}, got ({n},); use V[:, None]")
    if V.ndim != 2 or V.shape[0] != n:
        raise ValueError(f"expected V of shape (n, k) with n = {n}, got {tuple(V.shape)}")


def product(operator: SymmetricOperator, V: Float[Tensor, "n k"], finite: bool = True) -> Float[Tensor, "n k"]:
    """H V, which the next call may overwrite.  ValueError where it has another shape or dtype than V, or is not finite.

    finite: whether the latter is looked at, for which the host waits; else by `require_finite`, in what comes to it anyway.
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
    """ValueError that says of whose products it is, unless they are finite."""
    if not finite:
        raise InputError(
            f"expected finite products H V, got NaN or infinity in {', '.join(operator.blocks)}; check the parameters with "
            "check_operator"
        )


def finished(tensor: Tensor) -> Tensor:
    """The tensor, once it is computed: a GPU is still at work when the call that launched it returns."""
    if tensor.is_cuda:
        torch.cuda.synchronize(tensor.device)
    return tensor


def require_blocks(blocks: Mapping[str, slice], n: int) -> dict[str, slice]:
    """A copy of blocks; raise ValueError unless they are disjoint ranges of 0..n."""
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

    blocks: one of all rows, "all", where None.  ValueError unless the matrix is square, finite and symmetric to round-off, and
    the blocks are disjoint.

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
        require_vectors(V, self.dim)
        return self.matrix @ V


class SumOperator:
    """sum_i weights_i H_i; weights are 1 where None.  ValueError unless all H_i have the same rows, blocks and dtype."""

    def __init__(self, terms: Sequence[SymmetricOperator], weights: Sequence[float] | None = None) -> None:
        if not terms:
            raise ValueError("expected at least one operator to sum, got none")
        weights = [1.0] * len(terms) if weights is None else weights
        if len(weights) != len(terms):
            raise ValueError(f"expected one weight per operator ({len(terms)}), got {len(weights)}")
        first = terms[0]
        for term in terms[1:]:
            if (term.dim, term.dtype, dict(term.blocks)) != (first.dim, first.dtype, dict(first.blocks)):
                raise ValueError(
                    f"expected operators of {first.dim} rows, {first.dtype} and blocks {', '.join(first.blocks)}, "
                    f"got {term.dim} rows, {term.dtype} and blocks {', '.join(term.blocks)}"
                )
        self.terms, self.weights = tuple(terms), tuple(weights)
        self.dim, self.dtype, self.blocks = first.dim, first.dtype, first.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim)
        total = self.weights[0] * self.terms[0].apply(V)
        for weight, term in zip(self.weights[1:], self.terms[1:], strict=True):
            total.add_(term.apply(V), alpha=weight)
        return total


class RestrictedOperator:
    """E^T H E: the diagonal block of H on one named block of rows, its only block.  A product costs one with all of H.

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
        require_vectors(V, self.dim)
        padded = V.new_zeros(self.inner.dim, V.shape[1])
        padded[self.rows] = V
        return self.inner.apply(padded)[self.rows]


class ScaledOperator:
    """D H D with D = diag(scale), n finite numbers: the Hessian with respect to theta / scale."""

    def __init__(self, inner: SymmetricOperator, scale: Float[Tensor, " n"]) -> None:
        if scale.shape != (inner.dim,) or not torch.isfinite(scale).all():
            raise ValueError(f"expected {inner.dim} finite scales, got shape {tuple(scale.shape)}")
        self.inner = inner
        self.scale = scale.to(inner.dtype)[:, None]
        self.dim, self.dtype, self.blocks = inner.dim, inner.dtype, inner.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim)
        return self.scale * self.inner.apply(self.scale * V)


class ProjectedOperator:
    """P H P for an orthogonal projector `project(V) -> P V`, V of shape (n, k).

    That it is linear, symmetric and idempotent is the caller's promise, and is not checked.
    """

    def __init__(self, inner: SymmetricOperator, project: Callable[[Tensor], Tensor]) -> None:
        self.inner, self.project = inner, project
        self.dim, self.dtype, self.blocks = inner.dim, inner.dtype, inner.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim)
        return self.project(self.inner.apply(self.project(V)))


class CountingOperator:
    """H itself, with counts of its use so far.

    matvecs: vectors that it was applied to; calls: of `apply`; seconds: that these took, a GPU's work included.
    """

    def __init__(self, inner: SymmetricOperator) -> None:
        self.inner = inner
        self.dim, self.dtype, self.blocks = inner.dim, inner.dtype, inner.blocks
        self.matvecs, self.calls, self.seconds = 0, 0, 0.0

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(finished(V), self.dim)
        start = perf_counter()
        result = finished(self.inner.apply(V))
        self.seconds += perf_counter() - start
        self.matvecs += V.shape[1]
        self.calls += 1
        return result
