"""The diagonal of a symmetric H by a sketch: XDiag (Epperly, Tropp and Webber 2024), with a projector on both sides of H.

There are s test vectors omega_i of random signs with their products Y = H Omega, and s more products H Q with Q = orth(Y).
With the projector P_i on the span of all columns of Y except the i-th,

    d_i = diag(P_i H + H P_i - P_i H P_i) + omega_i * ((I - P_i) H (I - P_i) omega_i),    diag H ~ mean of d_i

Each d_i is unbiased: its first part is exact, and omega_i, which is independent of P_i, estimates the rest.  XDiag itself
estimates (I - P_i) H by probes; with a projector on both sides the rest is smaller, at the same cost.  All P_i follow from one
QR decomposition, as in `sketched`.

**The error**, as in `sketched`: in each row, the variance of the mean is the sample variance of the d_i over s plus their
covariance, E (d_i - d_i^j) (d_j - d_j^i), where d_i^j is d_i with j left out of the sketch as well.  The covariance of a single
row would be noisy.  Its ratio to the variance is assumed to be equal in all rows, is computed from up to ROWS of them, and
widens the spread of the samples.

The first half of the probes are signs.  Where their products show that a sketch pays, they become its test vectors; else the
second half are signs, too.  As in `landscape.traces.choice`, a sketch pays where 4 r is below the variance of one sample of
signs, summed over the entries; r is the squared norm of the part outside the sketch.
"""

from dataclasses import dataclass
from math import sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.linalg import gram
from landscape.operators.operator import SymmetricOperator, product, products
from landscape.probes import draw_probes
from landscape.traces.choice import WORSE, outside_sketch
from landscape.traces.diagonal import DiagonalEstimate, estimate_diagonal, mean_diagonal, require_squares
from landscape.traces.hutchinson import joined
from landscape.traces.sketched import added_directions, left_out_directions

FEWEST = 4  # test vectors of a sketch
ROWS = 16_384  # rows at a time


def chosen_diagonal(
    operator: SymmetricOperator, generator: torch.Generator, probes: int = 32, batch: int = 4
) -> DiagonalEstimate:
    """diag H by a sketch where that pays, from at most `probes` (3 or more) matvecs; else `estimate_diagonal`.

    It is by signs with fewer than 8 probes, or with no more rows than probes.

    >>> from landscape.operators.operator import DenseOperator
    >>> v = torch.linspace(-1, 1, 100, dtype=torch.float64)
    >>> found = chosen_diagonal(DenseOperator(torch.outer(v, v)), torch.Generator().manual_seed(0))
    >>> found.method, found.matvecs, torch.allclose(found.values, v * v)  # a sketch is exact for a low rank
    ('sketch', 17, True)
    """
    half, kept = probes // 2, []
    if half < FEWEST or operator.dim <= probes:
        return estimate_diagonal(operator, generator, probes, batch)
    for start in range(0, half, batch):
        Z = draw_probes(operator.dim, min(batch, half - start), generator, operator.dtype, "rademacher")
        Y = product(operator, Z)
        require_squares(Y)
        kept.append((Z, Y.clone()))  # an operator may return the same buffer again
    Z, Y = joined(kept)
    signs = Z.double() * Y.double()
    if WORSE * outside_sketch(Y) < float(signs.var(dim=1).sum()):
        Q = added_directions(Y[:, :0], Y)
        samples = sketched_samples(Z, Y, Q, products(operator, Q, batch))
        return mean_diagonal(samples, operator, half + Q.shape[1], "sketch")
    rest = estimate_diagonal(operator, generator, probes - half, batch)
    return mean_diagonal(torch.cat([signs, rest.samples], dim=1), operator, probes, "signs")


def sketched_samples(
    Z: Float[Tensor, "n s"], Y: Float[Tensor, "n s"], Q: Float[Tensor, "n r"], HQ: Float[Tensor, "n r"]
) -> Float64[Tensor, "n s"]:
    """The d_i (columns), with their spread widened to that of independent samples with the same error.  Q spans Y."""
    small = _Small.of(gram(Q, Y), gram(Q, Z), gram(Q, HQ))
    samples = torch.cat([small.samples(*rows) for rows in zip(*(A.split(ROWS) for A in (Z, Q, HQ)), strict=True)])
    mean = samples.mean(dim=1, keepdim=True)
    return mean + sqrt(_widening(small, Z, Q, HQ)) * (samples - mean)


def _widening(small: "_Small", Z: Tensor, Q: Tensor, HQ: Tensor) -> float:
    """Variance of the mean of the d_i over that of independent samples; at least 1."""
    Z, Q, HQ = (A[:: max(1, len(A) // ROWS)] for A in (Z, Q, HQ))
    samples, count = small.samples(Z, Q, HQ), Z.shape[1]
    variance = float(samples.var(dim=1).sum())
    if small.S is None or variance == 0:
        return 1.0
    changes = samples[:, None].expand(-1, count, -1).clone()  # row, left out, tested
    for j in range(count):
        others = [i for i in range(count) if i != j]
        basis, smaller = small.without(j)
        changes[:, j, others] -= smaller.samples(Z[:, others], Q.double() @ basis, HQ.double() @ basis)
        changes[:, j, j] = 0
    covariance = float((changes * changes.mT).sum()) / (count * (count - 1))
    return max(1.0, 1 + count * covariance / variance)


@dataclass(frozen=True, eq=False)
class _Small:
    """The small matrices R = Q^T Y, W = Q^T Omega, core = Q^T H Q, and S with P_i = Q Q^T - (Q s_i)(Q s_i)^T.

    S is None where all P_i are Q Q^T.
    """

    R: Float64[Tensor, "r s"]
    W: Float64[Tensor, "r s"]
    core: Float64[Tensor, "r r"]
    S: Float64[Tensor, "r s"] | None

    @classmethod
    def of(cls, R: Tensor, W: Tensor, core: Tensor) -> "_Small":
        return cls(R, W, core, left_out_directions(R))

    def without(self, j: int) -> tuple[Float64[Tensor, "r r-1"], "_Small"]:
        """The same without test vector j: an orthonormal basis of the smaller sketch in coordinates of Q, and its matrices."""
        assert self.S is not None
        others = [i for i in range(self.R.shape[1]) if i != j]
        basis = torch.linalg.qr(self.R[:, others]).Q
        reduced = basis.T @ self.R[:, others], basis.T @ self.W[:, others], basis.T @ self.core @ basis
        return basis, _Small.of(*reduced)

    def samples(self, Z: Tensor, Q: Tensor, HQ: Tensor) -> Float64[Tensor, "rows s"]:
        """The rows of all d_i that belong to these rows of Omega, Q and H Q."""
        Z, Q, HQ = Z.double(), Q.double(), HQ.double()
        inside = Q @ self.core
        exact = (Q * (2 * HQ - inside)).sum(dim=1, keepdim=True)
        if self.S is None:
            return exact - Z * ((HQ - inside) @ self.W)
        removed, curvature = Q @ self.S, (self.S * (self.core @ self.S)).sum(dim=0)
        exact = exact - 2 * removed * ((HQ - inside) @ self.S) - curvature * removed.square()
        seen = self.W - self.S * (self.S * self.W).sum(dim=0)  # P_i omega_i
        along = (self.S * (self.R - self.core @ seen)).sum(dim=0)
        return exact + Z * (removed * along - (HQ - inside) @ seen)
