"""diag H by a sketch: XDiag (Epperly, Tropp and Webber 2024) with both sides of H on the sketch, for symmetric H.

s test vectors omega_i of signs with their products Y = H Omega, and s products more, H Q with Q = orth(Y).  With P_i the
projector on the span of all columns of Y but the i-th,

    d_i = diag(P_i H + H P_i - P_i H P_i) + omega_i * ((I - P_i) H (I - P_i) omega_i),    diag H ~ mean of d_i

Each d_i is unbiased: its first part is exact, and omega_i, which P_i knows nothing of, sees only the rest.  XDiag leaves
(I - P_i) H to chance; the rest of both sides is smaller and costs no more.  All P_i follow from one QR, as in `sketched`.

**The error.**  As there: in each row, the variance of the mean is that of the d_i over s and their covariance,
E (d_i - d_i^j) (d_j - d_j^i) with d_i^j the i-th without j in the sketch.  A row's own covariance would be noisy; its ratio to
the variance is taken to be the same in all rows, is found from up to ROWS of them, and widens the spread of the samples.
"""

from dataclasses import dataclass
from math import sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.linalg import gram

ROWS = 16_384
EPS = torch.finfo(torch.float64).eps


def sketched_samples(
    Z: Float[Tensor, "n s"], Y: Float[Tensor, "n s"], Q: Float[Tensor, "n r"], HQ: Float[Tensor, "n r"]
) -> Float64[Tensor, "n s"]:
    """The d_i, spread about their mean as independent ones of the same error would be.  Q spans Y."""
    small = _Small.of(gram(Q, Y), gram(Q, Z), gram(Q, HQ))
    samples = torch.cat([small.samples(*rows) for rows in zip(*(A.split(ROWS) for A in (Z, Q, HQ)), strict=True)])
    mean = samples.mean(dim=1, keepdim=True)
    return mean + sqrt(_widening(small, Z, Q, HQ)) * (samples - mean)


def _widening(small: "_Small", Z: Tensor, Q: Tensor, HQ: Tensor) -> float:
    """The squared error of the mean over that of as many independent samples; at least 1."""
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
    """Q^T Y, Q^T Omega, Q^T H Q; S: P_i = Q Q^T - (Q s_i)(Q s_i)^T, None where all P_i are Q Q^T."""

    R: Float64[Tensor, "r s"]
    W: Float64[Tensor, "r s"]
    core: Float64[Tensor, "r r"]
    S: Float64[Tensor, "r s"] | None

    @classmethod
    def of(cls, R: Tensor, W: Tensor, core: Tensor) -> "_Small":
        if R.shape[0] < R.shape[1]:
            return cls(R, W, core, None)
        U, sigma, Vh = torch.linalg.svd(R)
        S = U @ (Vh / sigma.clamp_min(EPS * float(sigma[0]))[:, None])  # R^-T
        return cls(R, W, core, S / S.norm(dim=0))

    def without(self, j: int) -> tuple[Float64[Tensor, "r r-1"], "_Small"]:
        """Test vector j left out: an orthonormal basis of what is left of the sketch, in that of Q, and all in it."""
        assert self.S is not None
        others = [i for i in range(self.R.shape[1]) if i != j]
        basis = torch.linalg.qr(self.R[:, others]).Q
        reduced = basis.T @ self.R[:, others], basis.T @ self.W[:, others], basis.T @ self.core @ basis
        return basis, _Small.of(*reduced)

    def samples(self, Z: Tensor, Q: Tensor, HQ: Tensor) -> Float64[Tensor, "rows s"]:
        """Some rows of the d_i."""
        Z, Q, HQ = Z.double(), Q.double(), HQ.double()
        inside = Q @ self.core
        exact = (Q * (2 * HQ - inside)).sum(dim=1, keepdim=True)
        if self.S is None:
            return exact - Z * ((HQ - inside) @ self.W)
        removed, own = Q @ self.S, (self.S * (self.core @ self.S)).sum(dim=0)
        exact = exact - 2 * removed * ((HQ - inside) @ self.S) - own * removed.square()
        seen = self.W - self.S * (self.S * self.W).sum(dim=0)  # P_i omega_i
        along = (self.S * (self.R - self.core @ seen)).sum(dim=0)
        return exact + Z * (removed * along - (HQ - inside) @ seen)
