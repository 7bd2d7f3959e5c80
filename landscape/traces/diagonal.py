"""The diagonal of H, and how much of it lies on groups of rows.

    method "signs"   random signs (Bekas, Kokiopoulou and Saad 2007)
    method "auto"    the default: the first half of the probes are signs.  Where their products tell that a sketch pays, by the
                     rule of `choice`, they become its test vectors and the other matvecs go into the sketch's products
                     (`sketched_diagonal`); else the other half are signs too

    a_i = z_i * (H z_i),   diag H ~ mean of a_i,   variance of an entry: the other entries of its row, squared, over k

A sketch pays where 4 r is below the sum of the entries' variances
with one probe, r what the sketch leaves.

The sensitivity of a group of rows (a Gaussian, say) is the sum of |H_rr| over them.  The modulus of an estimate is too large on
average: for a normal error s by at most s sqrt(2 / pi), where the entry is zero.  `GroupSums.bias` is that expected excess
at the estimated entries, summed over the group.  The standard error is that of the sum of s_r H_rr, s_r the estimated signs
taken for certain: so it includes how the errors of a group's rows are correlated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import pi, sqrt
from typing import Literal

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import group_sums
from landscape.operators.operator import SymmetricOperator, product
from landscape.probes import draw_probes
from landscape.results import Progress
from landscape.traces.choice import WORSE, sketch_leaves
from landscape.traces.sketched import added_directions
from landscape.traces.sketched_diagonal import sketched_samples

Method = Literal["auto", "signs"]
FEWEST = 4  # test vectors of a sketch
SQUARED = 1e-140, 1e140  # numbers whose squares, and sums of them, are floats with all their digits


@dataclass(frozen=True, eq=False)
class GroupSums:
    """sum |H_rr| over the rows of each group, with its standard error.

    bias: by how much noise makes the sum too large on average (the top of this module); it is not subtracted from `values`.
    """

    values: Float64[Tensor, " groups"]
    standard_errors: Float64[Tensor, " groups"]
    bias: Float64[Tensor, " groups"]


@dataclass(frozen=True, eq=False)
class DiagonalEstimate:
    """diag H.  samples: one column a test vector, whose mean is `values`.

    matvecs: products with H that it took.  method: "signs" or "sketch", whichever was used in the end.
    """

    values: Float64[Tensor, " n"]
    standard_errors: Float64[Tensor, " n"]
    samples: Float64[Tensor, "n probes"]
    blocks: Mapping[str, slice]
    matvecs: int
    method: str = "signs"

    def block(self, name: str) -> "DiagonalEstimate":
        """The part of the estimate in one block's rows; its matvecs are those of the whole."""
        rows = self.blocks[name]
        own = {name: slice(0, rows.stop - rows.start)}
        return replace(
            self,
            values=self.values[rows],
            standard_errors=self.standard_errors[rows],
            samples=self.samples[rows],
            blocks=own,
        )

    def sensitivity(self, groups: Int64[Tensor, " n"], count: int) -> GroupSums:
        """sum |H_rr| over the rows of each of `count` groups; groups: the number, from 0, of the group of every row."""
        if groups.shape != self.values.shape or not ((groups >= 0) & (groups < count)).all():
            raise ValueError(
                f"expected a group in 0..{count - 1} for each of {len(self.values)} rows, got shape {tuple(groups.shape)}"
            )
        groups = groups.to(self.values.device)
        sums = group_sums(self.values.abs(), groups, count)
        probes = self.samples.shape[1]
        signed = group_sums(self.values.sign()[:, None] * self.samples, groups, count)
        excess = group_sums(_folded_excess(self.values.abs(), self.standard_errors), groups, count)
        return GroupSums(sums, signed.std(dim=1) / sqrt(probes), excess)


def estimate_diagonal(
    operator: SymmetricOperator,
    generator: torch.Generator,
    probes: int = 32,
    batch: int = 4,
    progress: Progress | None = None,
    method: Method = "auto",
) -> DiagonalEstimate:
    """diag H with a standard error for every entry, from `probes` (3 or more) matvecs at most.

    batch: vectors in one application of the operator.  Keeps n x probes numbers in float64, and squares them: entries within
    SQUARED, as all of float32 are, have their errors, and InputError where the largest is not.  Method "auto" is "signs" with
    fewer than 8 probes, and with no more rows than probes.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([1.0, -2.0])))
    >>> estimate_diagonal(H, torch.Generator().manual_seed(0)).values  # exact on a diagonal
    tensor([ 1., -2.], dtype=torch.float64)
    """
    if probes < 3:
        raise InputError(f"expected at least 3 probes, got {probes}")
    if method not in ("auto", "signs"):
        raise InputError(f"expected the method 'auto' or 'signs', got {method!r}")
    half = probes // 2
    choosing = method == "auto" and half >= FEWEST and operator.dim > probes
    samples = torch.zeros(operator.dim, 0, dtype=torch.float64, device=generator.device)
    kept: list[tuple[Tensor, Tensor]] = []
    while (done := samples.shape[1]) < probes:
        until = half if choosing and done < half else probes
        Z = draw_probes(operator.dim, min(batch, until - done), generator, operator.dtype, "rademacher")
        Y = product(operator, Z)
        _require_squares(float(Y.abs().max()) if Y.numel() else 0.0)
        samples = torch.cat([samples, Z.double() * Y.double()], dim=1)
        if progress:
            progress(samples.shape[1], probes, f"diagonal: {samples.shape[1]} probes")
        if choosing and samples.shape[1] <= half:
            kept.append((Z, Y.clone()))  # an operator may give the same buffer again
        if choosing and samples.shape[1] == half and _pays(samples, kept):
            return _sketched(operator, kept, batch, probes, progress)
    return _mean(samples, operator, probes, "signs")


def _require_squares(largest: float) -> None:
    """ValueError unless the square of the largest entry of products is a float with all its digits."""
    if largest and not SQUARED[0] <= largest <= SQUARED[1]:
        raise ValueError(
            f"expected products H z with a largest entry from {SQUARED[0]:g} to {SQUARED[1]:g}, got {largest:.3g}; scale H"
        )


def _mean(samples: Float64[Tensor, "n k"], operator: SymmetricOperator, matvecs: int, method: str) -> DiagonalEstimate:
    errors = samples.std(dim=1) / sqrt(samples.shape[1])
    return DiagonalEstimate(samples.mean(dim=1), errors, samples, operator.blocks, matvecs, method)


def _pays(samples: Float64[Tensor, "n k"], kept: list[tuple[Tensor, Tensor]]) -> bool:
    """Whether a sketch leaves so much less to chance that half as many test vectors do better."""
    leaves = sketch_leaves(torch.cat([Y for _, Y in kept], dim=1))
    return WORSE * leaves < float(samples.var(dim=1).sum())


def _sketched(
    operator: SymmetricOperator, kept: list[tuple[Tensor, Tensor]], batch: int, most: int, progress: Progress | None
) -> DiagonalEstimate:
    """With the products of the sketch's own directions."""
    Z, Y = (torch.cat(parts, dim=1) for parts in zip(*kept, strict=True))
    Q = added_directions(Y[:, :0], Y)
    HQ, done = torch.empty_like(Q), Z.shape[1]
    for columns in torch.arange(Q.shape[1]).split(batch):
        HQ[:, columns] = product(operator, Q[:, columns].contiguous())
        done += len(columns)
        if progress:
            progress(done, most, f"diagonal: a sketch of {Q.shape[1]} directions")
    return _mean(sketched_samples(Z, Y, Q, HQ), operator, done, "sketch")


def _folded_excess(size: Tensor, error: Tensor) -> Tensor:
    """E |x| - size for a normal x of the mean size and the standard deviation error."""
    z = size / error.clamp_min(1e-300)
    normal = torch.exp(-z.square() / 2) * sqrt(2 / pi)
    return error * (normal - z * torch.special.erfc(z / sqrt(2)))
