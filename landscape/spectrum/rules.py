"""A spectral density as Gauss quadrature rules, one for each start vector, beside eigenvalues known one by one.

**How far a sum may be off.**  A start vector z sees the sum T of f over the n eigenvalues that are not known as n z^T f(H) z.
With d = f(lambda) less its mean and p_j = sum d^j, the mean m of k such samples has the cumulants 2 p_2 / k and 8 p_3 / k^2 for
directions that are uniform.  A few samples tell neither their spread nor their skewness; the rules, which know where the
eigenvalues are, tell p_2 and p_3.  The p_2 of the same start vectors is too small where m is: by the regression of one on the
other, p_2 + (p_3 / p_2) (T - m) is the one that goes with T.  With b = p_3 / (k p_2) and the normal quantile q that of m is
(Cornish and Fisher 1938, to the skewness)

    m = T + (2 / 3) b (q^2 - 1) + q sqrt(2 p_2 / k + 2 b (T - m)),     which solved for T gives

    T = m + (q^2 + 2) b / 3 -+ q sqrt(2 p_2 / k + (4 - q^2) b^2 / 3)

q is of Student's t with as many degrees of freedom as what is left to chance of p_2 has, k / (p_4 / p_2^2 - p_3^2 / p_2^3):
2 k (two eigenvalues, d and -d) or more.

**Signs see less.**  Start vectors of random signs see nothing of the diagonal of f(H): their variance is a share of 2 p_2 / k,
1 for eigenvectors that are spread over all rows, 0 for those along the axes.  The samples' own variance says how large the
share is at most, with the confidence asked for; the interval shrinks with it.  Part of the error allowed, RESERVED, is for
shares that are larger.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import hypot, isfinite, sqrt
from statistics import NormalDist

import scipy
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from landscape.results import Bracket, standard_deviation, t_quantile

RESERVED = 0.2
ROUND_OFFS = 16  # of a sum of weights of 1, as a multiple of EPS
EPS = torch.finfo(torch.float64).eps


@dataclass(frozen=True, eq=False)
class SpectralDensity:
    """The spectrum as seen by stochastic Lanczos quadrature: for every start vector, nodes and weights of a Gauss rule.

    known: simple eigenvalues that were found one by one, ascending.  The density of all the others, normalised to 1, is about
    the mean over start vectors of sum_j weights_j delta(x - nodes_j), exact in expectation for polynomials of degree below
    2 steps (but for a bias too small to be seen, see `density`).  Each row of weights adds up to 1; shorter rules are filled
    up with weights of 0.  dim: how many eigenvalues there are in all, those of a known null space left out.
    complete: for which start vectors the rule is the vector's measure itself (its recurrence ended in an invariant subspace);
    None: for those that have weights of 0.  trace: of the operator, with its standard error, where it is known better than
    from these start vectors.  missed: for each known eigenvalue, how much its residual may change sums of |lambda|^p,
    1 <= p <= 2, as a share of its own term (`of_known`).
    """

    nodes: Float64[Tensor, "starts steps"]
    weights: Float64[Tensor, "starts steps"]
    dim: int
    matvecs: int
    known: Float64[Tensor, " k"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    complete: Bool[Tensor, " starts"] | None = None
    trace: tuple[float, float] | None = None
    missed: Float64[Tensor, " k"] | None = None

    def __repr__(self) -> str:
        shown = ", ".join(f"{value:.4g}" for value in self.known.tolist())
        reach = self.nodes[self.weights > 0]
        ends = f"[{float(reach.min()):.4g}, {float(reach.max()):.4g}]" if reach.numel() else "nothing"
        return (
            f"spectral density of {self.dim:,} eigenvalues, nodes over {ends}\n"
            f"  {len(self.nodes)} start vectors of {self.nodes.shape[1]} Lanczos steps at most, {self.matvecs} products\n"
            f"  known one by one: {shown or 'none'}"
        )

    @property
    def rest(self) -> int:
        """Number of eigenvalues that are not known."""
        return self.dim - len(self.known)

    def rules(self) -> Iterator[tuple[Float64[Tensor, " m"], Float64[Tensor, " m"]]]:
        """Nodes and weights of each start vector; with weights of 0 where they are the measure itself."""
        for i, (nodes, weights) in enumerate(zip(self.nodes, self.weights, strict=True)):
            kept = weights > 0
            whole = self.complete is None or bool(self.complete[i])
            yield (nodes, weights) if whole else (nodes[kept], weights[kept])

    def table(self) -> tuple[Float64[Tensor, "starts m"], Float64[Tensor, "starts m"]]:
        """Nodes and weights of all eigenvalues, for drawing: those that are known are nodes of every start vector."""
        everywhere = self.known.expand(len(self.nodes), -1)
        weights = [self.weights * self.rest, torch.ones_like(everywhere)]
        return torch.cat([self.nodes, everywhere], dim=1), torch.cat(weights, dim=1) / self.dim

    def integral(self, function: Callable[[Tensor], Tensor], confidence: float = 0.95) -> Bracket:
        """sum_i f(lambda_i) over all `dim` eigenvalues, with an interval for what start vectors differ by.

        The error of the Gauss rules themselves is not in it.  ValueError where a sum is beyond the range of floats.
        """
        values = function(self.nodes)
        samples = self.rest * (self.weights * values).sum(dim=1) + function(self.known).sum()
        if not samples.isfinite().all():
            raise ValueError(
                "expected sums of f(lambda) within the range of floats; divide the eigenvalues by their size in f"
            )
        shift, error = self.by_trace(function, confidence)
        value, known = float((samples + shift).mean()), self.of_known(function)
        below, above = self.reach(values - self.slope(function) * self.nodes, samples + shift, confidence, error)
        note = f"spread over {samples.numel()} start vectors"
        return Bracket(value, value - below - known, value + above + known, note)

    def reach(
        self,
        values: Float64[Tensor, "starts steps"],
        samples: Float64[Tensor, " starts"],
        confidence: float,
        other: float = 0.0,
    ) -> tuple[float, float]:
        """Reach of a sum's interval below and above the mean over start vectors (samples).

        values: of the summed function, at the nodes.  other: an independent error of the mean, at the same confidence.
        """
        shares, count = self.weights / len(self.weights), len(samples)
        # d: deviations of f from its mean at the nodes, in units of the largest
        d = torch.where(shares > EPS * EPS, values - (shares * values).sum(), 0.0)  # others are round-off
        unit = float(d.abs().max()) if self.rest and d.numel() else 0.0  # no power leaves the range of floats
        if unit <= ROUND_OFFS * EPS * float((shares * values).abs().sum()):  # all the same: d is the mean's round-off
            return other, other
        # moments of f over the unknown eigenvalues, as the rules know them: p_2, p_3, p_4 a direction
        second, third, fourth = (float((shares * (d / unit) ** power).sum()) for power in (2, 3, 4))
        skewness = third / second
        # degrees of freedom of p_2, for the quantile
        freedom = self.rest * count / (fourth / second / second - skewness * skewness / second)
        q = t_quantile(max(freedom, 2.0 * count), 1 - (1 - RESERVED) * (1 - confidence))
        # the interval of the Cornish-Fisher expansion, solved for T (see the module)
        b, variance = skewness / count, 2 * self.rest * second / count
        seen = 1.0
        # signs see less: the share of the variance that the samples themselves show, at most
        if count > 1:
            own = (float(standard_deviation(samples)) / unit) ** 2 / count
            seen = min(own / variance * (count - 1) / float(scipy.special.chdtri(count - 1, confidence)), 1.0)
        middle = seen * (q * q + 2) * b / 3
        half = q * sqrt(seen * max(variance + (4 - q * q) * b * b / 3, 0.0))
        return hypot(unit * (half - middle), other), hypot(unit * (half + middle), other)

    def of_known(self, function: Callable[[Tensor], Tensor]) -> float:
        """Largest error of sum f(lambda) by the known eigenvalues' residuals, and by round-off of the largest of all.

        With H in the basis of v and its complement, the trace of f(H) less f(lambda) and that of f of the rest is
        sum_j r_j^2 (f'(lambda) - f'(mu_j)) / (lambda - mu_j) to second order: 2 r^2 for lambda^2, and 2 r^2 / |lambda| at most
        for |lambda|.  So `missed` is twice 2 (r / lambda)^2; twice 2 r / |lambda| where r, then round-off, is above |lambda|.
        """
        terms = function(self.known).abs()
        rounding = EPS * self.dim * float(torch.cat([terms, function(self.nodes[self.weights > 0]).abs()]).max())
        return rounding + (0.0 if self.missed is None else float((self.missed * terms).sum()))

    def by_trace(
        self, function: Callable[[Tensor], Tensor], confidence: float
    ) -> tuple[Float64[Tensor, " starts"], float]:
        """Correction of each start vector's sum of f(lambda) by the trace, and its error by that of the trace.

        What start vector z says of the trace is off by what is known of it; c times that is taken off what z says of
        sum f(lambda) (a control variate).  For random signs variances are 2 sum f(lambda)^2 at most, and
        c = sum f(lambda) lambda / sum lambda^2 leaves the least of them; less where the trace has an error of its own.
        """
        slope = self.slope(function)
        if self.trace is None or slope == 0:
            return torch.zeros(len(self.nodes), dtype=torch.float64), 0.0
        trace, error = self.trace
        seen = self.rest * (self.weights * self.nodes).sum(dim=1) + self.known.sum()
        return slope * (trace - seen), abs(slope) * error * NormalDist().inv_cdf((1 + confidence) / 2)

    def slope(self, function: Callable[[Tensor], Tensor]) -> float:
        """c of `by_trace`; 0 where the trace is not known."""
        unit = float(self.nodes.abs().max()) if self.nodes.numel() else 0.0  # of squares that leave the range of floats
        if self.trace is None or not isfinite(self.trace[1]) or unit == 0:
            return 0.0
        starts, x, off = len(self.nodes), self.nodes / unit, self.trace[1] / unit
        squares = float((self.weights * x.square()).sum())
        own = 2 * self.rest * squares / starts**2  # variance of the start vectors' mean
        return float((self.weights * x * function(self.nodes) / unit).sum()) / squares * own / (own + off * off)
