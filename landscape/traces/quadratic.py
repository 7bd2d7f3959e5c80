"""Confidence intervals for the mean of quadratic forms z^T S z, from the spread and skewness that pairs of probes show.

Few samples of z^T S z say little about their variance and nothing about their skewness, which Student's interval ignores; where
one eigenvalue dominates it covers the truth too rarely.  But k probes have k (k - 1) / 2 pairs: each entry z_i^T S z_j of the
Gram matrix off its diagonal, squared, has the mean tr S^2.  With p_j = tr S^j for a symmetric S:

    cumulants    2 p_2, 8 p_3, ... of z^T S z for Gaussian z; for random signs the first two, with S without its diagonal
    B            the Gram matrix minus the mean of its diagonal, k x k and traceless
    p_2, p_3     tr B^2 / ((k - 1) (k + 2)) and k tr B^3 / ((k - 1) (k - 2) (k + 2) (k + 4)), p_4 likewise from tr B^4 and
                 (tr B^2)^2: unbiased for Gaussian z, and the only such estimates that are invariant under shifts of tr S
                 and rotations of the probes among each other.  For random signs see `_gram`.
    c            p_3 / p_2^(3/2) in [-1, 1], +-1 for a single eigenvalue; the skewness of the mean is c sqrt(8 / k)

The mean m is modelled as a shifted chi-squared variable with these three moments.  Its scale and its estimated standard error
grow together, in proportion for one eigenvalue: trace = k m / chi^2_k.  With the cube root of Wilson and Hilferty (1931):

    ends    m + s ((1 - e^2 + e q)^-3 - 1) / (3 e),   e = sqrt(2 / k) c / 3,   s^2 = (2 p_2 / k) (1 + 2 c^2 / k)

which is m - s q for e = 0.  q: quantiles of Student's t whose degrees of freedom are two over the relative variance of s^2.
The variance that s and m share is no error.  It is subtracted as c^6 times its value for one eigenvalue; in theory the factor
is c^2, and c^6 subtracts less where c is uncertain.

The interval is too short where random signs see few entries off the diagonal: all samples can then be equal by chance.  It is
slightly too short where two eigenvalues of opposite signs dominate.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import frexp, inf, sqrt

from jaxtyping import Float, Float64
from torch import Tensor

from landscape.linalg import gram
from landscape.probes import Distribution
from landscape.results import t_quantile

FEWEST = 4  # probes from which p_4 and p_2^2 can be separated


@dataclass(frozen=True)
class PowerSums:
    """Estimates of p_2, p_3, p_4 from one group of probes, in units of unit^2, unit^3, unit^4 to stay in the range of floats.

    pairs: (k - 1) (k + 2) / 2, the weight of the group.  spread: the relative variance of the estimate of p_2 is
    spread p_4 / p_2^2 + 2 / pairs.
    """

    second: float
    third: float
    fourth: float
    pairs: float
    spread: float
    unit: float = 1.0

    def sums(self, unit: float) -> tuple[float, float, float]:
        """p_2, p_3, p_4 in units of powers of `unit`."""
        ratio = self.unit / unit
        return self.second * ratio**2, self.third * ratio**3, self.fourth * ratio**4


def power_sums(Z: Float[Tensor, "n k"], Y: Float[Tensor, "n k"], distribution: Distribution) -> PowerSums:
    """The power sums of S = (A + A^T) / 2, from k >= 4 independent probes Z and the products Y = A Z."""
    k = Z.shape[1]
    B, excess, unit = _gram(Z, Y, distribution)
    square = B @ B
    second, third, fourth = float(square.trace()), float((square * B).sum()), float(square.square().sum())
    pairs = (k - 1) * (k + 2) / 2
    # E tr B^4 = a p_4 + b p_2^2 and E (tr B^2)^2 = g p_4 + d p_2^2: b and d from the many-eigenvalue limit (B a traceless
    # Gaussian orthogonal matrix), a + b and g + d from a single eigenvalue (E |a|^8 of k normal numbers a)
    eighth = k * (k + 2) * (k + 4) * (k + 6)
    d = 4 * pairs * (pairs + 2)
    g = eighth * (1 - 1 / k) ** 2 - d
    b = 2 * k**3 + 5 * k**2 + 5 * k - 24 * pairs / k - 12 / k
    a = eighth * ((1 - 1 / k) ** 4 + (k - 1) / k**4) - b
    return PowerSums(
        second=(second - excess) / (2 * pairs),
        third=third * k / ((k - 1) * (k - 2) * (k + 2) * (k + 4)),
        fourth=(d * fourth - b * second**2) / (a * d - b * g),
        pairs=pairs,
        spread=g / (2 * pairs) ** 2,
        unit=unit,
    )


def _gram(Z: Tensor, Y: Tensor, distribution: Distribution) -> tuple[Float64[Tensor, "k k"], float, float]:
    """B, the excess of tr B^2, and the unit of both: a power of two, so that division by it rounds nothing.

    The variance for random signs does not contain the diagonal of S, so its part sum_r z_ir z_jr S_rr is subtracted from each
    z_i^T S z_j; S_rr is the mean of z (A z) over the k - 2 other probes.  The error of this S_rr is the excess: it raises the
    mean of the squares by the factor 1 + 1 / (k - 2).
    """
    k = Z.shape[1]
    G = gram(Z, Y)
    unit = 2.0 ** frexp(float(G.abs().max()))[1]
    G, excess = (G + G.T) / (2 * unit), 0.0
    samples = G.diagonal().clone()
    if distribution == "rademacher":
        diagonals = (Z * Y).sum(dim=1, keepdim=True)
        G = (k * G - gram(Z, diagonals * Z) / unit) / (k - 2)
        excess = float(G.fill_diagonal_(0).square().sum()) / (k - 1)
    G.diagonal().copy_(samples - samples.mean())
    return G, excess, unit


def mean_interval(
    mean: float, probes: int, groups: Sequence[PowerSums], confidence: float, widening: float = 1.0
) -> tuple[float, float, float]:
    """Standard error and both ends of the interval for tr S, given the mean of z^T S z over all probes.

    widening: factor of the distances between the mean and both ends.
    """
    weight, unit = sum(group.pairs for group in groups), max(group.unit for group in groups)
    second, third, fourth = (
        sum(group.pairs * value for group, value in zip(groups, values, strict=True)) / weight
        for values in zip(*(group.sums(unit) for group in groups), strict=True)
    )
    if not second > 0:
        return 0.0, mean, mean
    c, kurtosis = _ratios(third / second**1.5, fourth / second**2, probes)
    spread = sum(group.pairs**2 * group.spread for group in groups) / weight**2
    common = c**6 * (8 * probes + 24) / (probes * (probes + 2))  # var(m^2) / E(m^2)^2 for one eigenvalue
    relative = max(spread * max(kurtosis, c * c) + 2 / weight - common, 1e-6)
    q = t_quantile(2 / relative, confidence)
    s, e = sqrt(2 * second / probes * (1 + 2 * c * c / probes)), sqrt(2 / probes) * c / 3
    ends = [mean + widening * unit * s * _deviation(e, quantile) for quantile in (q, -q)]
    return unit * sqrt(2 * second / probes), min(ends), max(ends)


def _ratios(skewness: float, kurtosis: float, k: int) -> tuple[float, float]:
    """p_3 / p_2^(3/2) and p_4 / p_2^2, corrected for the bias of a ratio of estimates.

    The correction is exact for one eigenvalue, where tr B^j is proportional to the j-th power of a chi^2_k variable, and for
    infinitely many.  In between chi^2 is given k / c^2 (for the second ratio k p_2^2 / p_4) degrees of freedom, where c is the
    corrected ratio: a fixed-point equation.
    """
    c, fourth = (min(max(value, -1.0), 1.0) for value in (skewness, kurtosis))
    for _ in range(20):  # a contraction, by a factor of at most 0.56 for 8 or more probes
        c = skewness * (1 + 4 * c * c / k) / sqrt(1 + 2 * c * c / k)
        c = min(max(c, -1.0), 1.0)
        fourth = kurtosis * (1 + 4 * fourth / k) * (1 + 6 * fourth / k) / (1 + 2 * fourth / k)
        fourth = min(max(fourth, 0.0), 1.0)
    return c, fourth


def _deviation(e: float, q: float) -> float:
    """((1 - e^2 + e q)^-3 - 1) / (3 e); infinite where no scale can be excluded."""
    if abs(e) < 1e-7:  # the limit e -> 0, where the formula's round-off is eps / e
        return -q
    root = 1 - e * e + e * q
    return (root**-3 - 1) / (3 * e) if root > 0 else inf if e > 0 else -inf
