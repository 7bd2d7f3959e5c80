"""The diagonal of H.

    method "signs"   probes z_i of random signs (Bekas, Kokiopoulou and Saad 2007)
    method "auto"    the default.  The first half of the probes are signs.  Where their products show that a sketch pays, they
                     become its test vectors and the other half of the budget goes into the sketch (`sketched_diagonal`);
                     otherwise the second half are signs, too

    a_i = z_i * (H z_i),   diag H ~ mean of a_i,   variance of an entry: the squares of the other entries of its row, over k

As in `choice`, a sketch pays where 4 r is below the variance of one a_i, summed over the entries; r is the squared norm of
the part outside the sketch.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import sqrt
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator, product, products
from landscape.probes import draw_probes
from landscape.results import Progress, ShortRepr
from landscape.traces.choice import WORSE, outside_sketch
from landscape.traces.hutchinson import joined
from landscape.traces.sketches.sketched import added_directions
from landscape.traces.sketches.sketched_diagonal import sketched_samples

Method = Literal["auto", "signs"]
FEWEST = 4  # test vectors of a sketch
SQUARED = 1e-140, 1e140  # numbers whose squares, and sums of them, are floats with all their digits


@dataclass(frozen=True, eq=False, repr=False)
class DiagonalEstimate(ShortRepr):
    """diag H.  samples: one column for each test vector, with the mean `values`.

    matvecs: products used.  method: "signs", "sketch" or "pixels" (`pixels`, where products are samples).
    """

    values: Float64[Tensor, " n"]
    standard_errors: Float64[Tensor, " n"]
    samples: Float64[Tensor, "n probes"]
    blocks: Mapping[str, slice]
    matvecs: int
    method: str = "signs"

    def block(self, name: str) -> "DiagonalEstimate":
        """The part of the estimate in one block's rows.  Its matvecs are those of the whole."""
        rows = self.blocks[name]
        values, errors, samples = self.values[rows], self.standard_errors[rows], self.samples[rows]
        blocks = {name: slice(0, rows.stop - rows.start)}
        return replace(self, values=values, standard_errors=errors, samples=samples, blocks=blocks)


def estimate_diagonal(
    operator: SymmetricOperator,
    generator: torch.Generator,
    probes: int = 32,
    batch: int = 4,
    progress: Progress | None = None,
    method: Method = "auto",
) -> DiagonalEstimate:
    """diag H with a standard error for every entry, from at most `probes` (3 or more) matvecs.

    batch: vectors in one application of the operator.  Memory: n x probes numbers in float64.  These are squared: entries
    within SQUARED, as all of float32 are, have right errors; InputError where the largest entry is outside; scale H then.
    Method "auto" is "signs" with fewer than 8 probes, or with no more rows than probes.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([1.0, -2.0])))
    >>> estimate_diagonal(H, torch.Generator().manual_seed(0)).values  # signs are exact for a diagonal matrix
    tensor([ 1., -2.], dtype=torch.float64)
    >>> v = torch.linspace(-1, 1, 100, dtype=torch.float64)
    >>> found = estimate_diagonal(DenseOperator(torch.outer(v, v)), torch.Generator().manual_seed(0))
    >>> found.method, found.matvecs, torch.allclose(found.values, v * v)  # a sketch is exact for a low rank
    ('sketch', 17, True)
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
            kept.append((Z, Y.clone()))  # an operator may return the same buffer again
        if choosing and samples.shape[1] == half:
            Z, Y = joined(kept)
            if WORSE * outside_sketch(Y) < float(samples.var(dim=1).sum()):
                Q = added_directions(Y[:, :0], Y)
                samples = sketched_samples(Z, Y, Q, products(operator, Q, batch))
                return _mean(samples, operator, half + Q.shape[1], "sketch")
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
