"""The diagonal of H from probes z_i of random signs (Bekas, Kokiopoulou and Saad 2007).

a_i = z_i * (H z_i),   diag H ~ mean of a_i,   variance of an entry: the squares of the other entries of its row, over k
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator, product
from landscape.probes import draw_probes
from landscape.results import Progress, ShortRepr

SQUARED = 1e-140, 1e140  # numbers whose squares, and sums of them, are floats with all their digits


@dataclass(frozen=True, eq=False, repr=False)
class DiagonalEstimate(ShortRepr):
    """diag H.  samples: one column for each test vector, with the mean `values`; matvecs: products used."""

    values: Float64[Tensor, " n"]
    standard_errors: Float64[Tensor, " n"]
    samples: Float64[Tensor, "n probes"]
    blocks: Mapping[str, slice]
    matvecs: int
    method: str = "signs"


def estimate_diagonal(
    operator: SymmetricOperator,
    generator: torch.Generator,
    probes: int = 32,
    batch: int = 4,
    progress: Progress | None = None,
) -> DiagonalEstimate:
    """diag H with a standard error for every entry, from at most `probes` (3 or more) matvecs.

    batch: vectors in one application of the operator.  Memory: n x probes numbers in float64.  These are squared: entries
    within SQUARED, as all of float32 are, have right errors; InputError where the largest entry is outside; scale H then.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([1.0, -2.0])))
    >>> estimate_diagonal(H, torch.Generator().manual_seed(0)).values  # signs are exact for a diagonal matrix
    tensor([ 1., -2.], dtype=torch.float64)
    """
    if probes < 3:
        raise InputError(f"expected at least 3 probes, got {probes}")
    samples = torch.zeros(operator.dim, 0, dtype=torch.float64, device=generator.device)
    while (done := samples.shape[1]) < probes:
        Z = draw_probes(operator.dim, min(batch, probes - done), generator, operator.dtype, "rademacher")
        Y = product(operator, Z)
        require_squares(Y)
        samples = torch.cat([samples, Z.double() * Y.double()], dim=1)
        if progress:
            progress(samples.shape[1], probes, f"diagonal: {samples.shape[1]} probes")
    return mean_diagonal(samples, operator, probes, "signs")


def require_squares(Y: Float[Tensor, "n k"]) -> None:
    """ValueError unless the square of the largest entry of products is a float with all its digits."""
    largest = float(Y.abs().max()) if Y.numel() else 0.0
    if largest and not SQUARED[0] <= largest <= SQUARED[1]:
        raise ValueError(
            f"expected products H z with a largest entry from {SQUARED[0]:g} to {SQUARED[1]:g}, got {largest:.3g}; scale H"
        )


def mean_diagonal(
    samples: Float64[Tensor, "n k"], operator: SymmetricOperator, matvecs: int, method: str
) -> DiagonalEstimate:
    errors = samples.std(dim=1) / sqrt(samples.shape[1])
    return DiagonalEstimate(samples.mean(dim=1), errors, samples, operator.blocks, matvecs, method)
