"""What the estimators return: frozen records, each number with its error and each run with the reason it stopped.

    interval        [low, high], the truth inside with the probability `confidence`
    standard error  of a mean over probe vectors: s / sqrt(probes)
    residual        |H v - lambda v| for a unit v: an eigenvalue lies within it of lambda, whatever v is
    reason          why the work ended: "tolerance" (the error asked for is reached), "noise floor" (more work would not
                    help: the error left is the matvec's own), "matvec budget", "evaluation budget", "time budget", "exact",
                    or "not asked for"

`record()` gives the scalars of a result as plain Python values for JSON; what is infinite or undefined is None there.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import inf, isfinite, sqrt
from statistics import NormalDist
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float64
from scipy.special import stdtrit
from torch import Tensor

StopReason = Literal[
    "tolerance", "noise floor", "matvec budget", "evaluation budget", "time budget", "exact", "not asked for"
]
Sign = Literal["positive", "negative", "zero", "undetermined"]
Number = float | None

Progress = Callable[[int, int, str], None]
"""progress(done, most, state): units of work done, the most there can be, and a few words on the state of the estimate."""


def finite_or_none(value: float) -> Number:
    """A float that JSON can hold."""
    return float(value) if isfinite(value) else None


def t_quantile(freedom: float, confidence: float) -> float:
    """What Student's t of so many degrees of freedom stays within, on both sides, with this probability.

    >>> round(t_quantile(9, 0.95), 3)
    2.262
    """
    return float(stdtrit(freedom, (1 + confidence) / 2))


def standard_deviation(samples: Float64[Tensor, "s *shape"]) -> Float64[Tensor, "*shape"]:
    """Along the first axis; in units of the largest sample, as squares may leave the range of floats."""
    unit = float(samples.abs().max()) or 1.0
    return unit * (samples / unit).std(dim=0)


def t_interval(samples: Float64[Tensor, " s"], confidence: float) -> tuple[float, float, float, float]:
    """Mean, standard error and both ends of Student's interval; a single sample has an infinite error."""
    count, mean = samples.numel(), float(samples.mean())
    if count < 2:
        return mean, inf, -inf, inf
    error = float(standard_deviation(samples)) / sqrt(count)
    half = t_quantile(count - 1, confidence) * error
    return mean, error, mean - half, mean + half


@dataclass(frozen=True, eq=False)
class TraceEstimate:
    """The trace of one block of H.

    block, dim: its name and number of rows.  low, high: the interval in which the trace lies with the probability `confidence`.
    samples: one for each of `probes` random vectors, in order; value is their mean, standard_error its error.  Both are empty
    or 0 where method is "exact".  matvecs: products with H that it took; blocks that were read from the same products each
    count them all.  method: "hutchinson", "hutch++", "xtrace" or "exact" (`landscape.trace`).
    """

    block: str
    dim: int
    value: float
    standard_error: float
    low: float
    high: float
    confidence: float
    probes: int
    matvecs: int
    reason: StopReason
    samples: Float64[Tensor, " probes"]
    method: str = "hutchinson"

    @classmethod
    def exact(cls, block: str, dim: int, value: float, confidence: float, matvecs: int = 0) -> "TraceEstimate":
        """A trace without error: no part of it was sampled."""
        none = torch.zeros(0, dtype=torch.float64)
        return cls(block, dim, value, 0.0, value, value, confidence, 0, matvecs, "exact", none, "exact")

    @property
    def half_width(self) -> float:
        """Half the interval's length."""
        return (self.high - self.low) / 2

    @property
    def sign(self) -> Sign:
        """The sign of the trace where the interval decides it ("zero": it is exactly 0), else "undetermined"."""
        if self.low == self.high == 0:
            return "zero"
        if self.low > 0:
            return "positive"
        return "negative" if self.high < 0 else "undetermined"

    def record(self) -> dict[str, Number | int | str]:
        return {
            "value": finite_or_none(self.value),
            "standard_error": finite_or_none(self.standard_error),
            "low": finite_or_none(self.low),
            "high": finite_or_none(self.high),
            "confidence": self.confidence,
            "sign": self.sign,
            "dim": self.dim,
            "probes": self.probes,
            "matvecs": self.matvecs,
            "reason": self.reason,
            "method": self.method,
        }


@dataclass(frozen=True, eq=False)
class Eigenpairs:
    """k eigenpairs of one end of the spectrum, the outermost first.

    vectors: columns of unit length; of Lanczos with their largest entries positive.
    residuals: |H v - lambda v|.  Where the recurrence's own estimate of it plus a margin for the matvec's noise meets the goal,
        this sum (`krylov`); else measured by a last application of the operator.
    vector_errors: residual over the distance to the nearest other approximate eigenvalue, about the sine of the angle
        between v and the true eigenvector; infinite where that distance is not known.
    reason: why the search for this end stopped.
    """

    values: Float64[Tensor, " k"]
    vectors: Float[Tensor, "n k"]
    residuals: Float64[Tensor, " k"]
    vector_errors: Float64[Tensor, " k"]
    reason: StopReason

    def __len__(self) -> int:
        return self.values.numel()

    def interval(self, index: int = 0) -> tuple[float, float]:
        """[value - residual, value + residual] of the pair at this index: an eigenvalue of H lies in it."""
        value, residual = float(self.values[index]), float(self.residuals[index])
        return value - residual, value + residual

    def record(self, index: int = 0) -> dict[str, Number | str]:
        return {
            "value": finite_or_none(float(self.values[index])),
            "residual": finite_or_none(float(self.residuals[index])),
            "vector_error": finite_or_none(float(self.vector_errors[index])),
            "reason": self.reason,
        }


@dataclass(frozen=True, eq=False)
class EigenEnds:
    """Both ends of the spectrum.

    largest, smallest: by signed value; an end that was not asked for has no pairs.
    method: "lanczos" or "power iteration".  matvecs: products that both ends took together.
    beyond: with the probability 0.99 over the random start, no eigenvalue lies farther than this outside
        [smallest[0], largest[0]] (a worst-case bound over all spectra, far from sharp; infinite where there is none).
    noise: the length of the error (round-off and any other) of one matvec of a unit vector: measured where a residual asked for
        was near it; else estimated from how far products are from symmetric; nan where neither was possible.
    ritz: all approximate eigenvalues of the last basis, ascending, and below them estimates of their residuals; None where
        the method has no basis.
    """

    largest: Eigenpairs
    smallest: Eigenpairs
    method: str
    matvecs: int
    beyond: float
    noise: float
    ritz: Float64[Tensor, "2 m"] | None = None

    def record(self) -> dict[str, object]:
        return {
            "max": [self.largest.record(i) for i in range(len(self.largest))],
            "min": [self.smallest.record(i) for i in range(len(self.smallest))],
            "method": self.method,
            "matvecs": self.matvecs,
            "beyond": finite_or_none(self.beyond),
            "noise": finite_or_none(self.noise),
        }


@dataclass(frozen=True)
class Bracket:
    """A number derived from other results, in [low, high], whose ends carry the errors of these results.

    value is None where the number is undefined or cannot be told; low and high may be infinite.  note: what limits it, or what
    the bracket rests on, in a few words.
    """

    value: Number
    low: float
    high: float
    note: str = ""

    def record(self) -> dict[str, Number | str]:
        value = None if self.value is None else finite_or_none(self.value)
        return {"value": value, "low": finite_or_none(self.low), "high": finite_or_none(self.high), "note": self.note}

    def __str__(self) -> str:
        if self.value is not None:
            return f"{self.value:.4g} in [{self.low:.4g}, {self.high:.4g}]" + (f" ({self.note})" if self.note else "")
        if not isfinite(self.low):
            return f"undefined: {self.note}"
        ends = f"in [{self.low:.4g}, {self.high:.4g}]" if isfinite(self.high) else f">= {self.low:.4g}"
        return f"{ends}: {self.note}"


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

    @property
    def rest(self) -> int:
        """How many eigenvalues are not known."""
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
        """sum_i f(lambda_i) over all `dim` eigenvalues, with an interval from its spread over start vectors.

        The error of the Gauss rules themselves is not in it.

        Student's interval, which takes samples for normal: of squares, which are skewed, it covers 86 to 95% at the nominal 95%
        with four start vectors (eight spectra, 200 seeds); `effective_rank`, which asks it for more, 93 to 100%.
        """
        samples = self.rest * (self.weights * function(self.nodes)).sum(dim=1) + function(self.known).sum()
        shift, error = self.by_trace(function, confidence)
        value, _, low, high = t_interval(samples + shift, confidence)
        error += self.of_known(function)
        return Bracket(value, low - error, high + error, f"spread over {samples.numel()} start vectors")

    def of_known(self, function: Callable[[Tensor], Tensor]) -> float:
        """How far the known eigenvalues' residuals may take sum f(lambda) off.

        With H in the basis of v and its complement, the trace of f(H) less f(lambda) and that of f of the rest is
        sum_j r_j^2 (f'(lambda) - f'(mu_j)) / (lambda - mu_j) to second order: 2 r^2 for lambda^2, and 2 r^2 / |lambda| at most
        for |lambda|.  So `missed` is twice 2 (r / lambda)^2.
        """
        return 0.0 if self.missed is None else float((self.missed * function(self.known).abs()).sum())

    def by_trace(
        self, function: Callable[[Tensor], Tensor], confidence: float
    ) -> tuple[Float64[Tensor, " starts"], float]:
        """What the trace corrects in each start vector's sum of f(lambda), and how far its own error may take that off.

        What start vector z says of the trace is off by what is known of it; c times that is taken off what z says of
        sum f(lambda) (a control variate).  For random signs variances are 2 sum f(lambda)^2 at most, and
        c = sum f(lambda) lambda / sum lambda^2 leaves the least of them; less where the trace has an error of its own.
        """
        shift = torch.zeros(len(self.nodes), dtype=torch.float64)
        unit = float(self.nodes.abs().max()) if self.nodes.numel() else 0.0  # of squares that leave the range of floats
        if self.trace is None or not isfinite(self.trace[1]) or unit == 0:
            return shift, 0.0
        trace, error = self.trace
        starts, x, off = len(self.nodes), self.nodes / unit, error / unit
        squares = float((self.weights * x.square()).sum())
        own = 2 * self.rest * squares / starts**2  # variance of the start vectors' mean
        slope = float((self.weights * x * function(self.nodes) / unit).sum()) / squares * own / (own + off * off)
        seen = self.rest * (self.weights * self.nodes).sum(dim=1) + self.known.sum()
        return slope * (trace - seen), abs(slope) * error * NormalDist().inv_cdf((1 + confidence) / 2)


@dataclass(frozen=True)
class Anisotropy:
    """The index family of `landscape.anisotropy`: how unequal the curvatures are.  None: the density it needs was not given."""

    literal: Bracket
    saddle: Bracket
    share: Bracket | None = None
    effective_rank: Bracket | None = None
    mass_quantile: Bracket | None = None

    def record(self) -> dict[str, object]:
        members = {
            "literal": self.literal,
            "saddle": self.saddle,
            "share": self.share,
            "effective_rank": self.effective_rank,
            "mass_quantile": self.mass_quantile,
        }
        return {name: bracket.record() for name, bracket in members.items() if bracket is not None}


@dataclass(frozen=True, eq=False)
class Slice:
    """The objective on a grid center + sum_d x_d directions[:, d], d = 1 or 2, beside its quadratic model.

    coordinates: increasing x_d of the grid, in multiples of the directions.
    loss has one axis per direction (rows follow coordinates[0], columns coordinates[1]): the objective itself at points that
    are `evaluated`, interpolated elsewhere.  holdout: |prediction - objective| at the random points of the last hold-out, which
    tells how good the interpolation is; empty where none was drawn.
    model: center_loss + slope . x + x^T curvature x / 2, with slope and curvature the derivatives of the objective in x; the
    three are None where neither gradient nor operator was given.  crossed marks evaluated points whose signature (order of
    sorting, visible set) differs from the centre's, so that the objective may jump on the way there; at points that are not
    evaluated it is False and nothing is known.  evaluations: of the objective, the centre's too.
    looks: hold-outs that were drawn, one after the other, until one was good enough or a budget ended it.
    """

    coordinates: tuple[Float64[Tensor, " _"], ...]
    loss: Float64[Tensor, "..."]
    evaluated: Bool[Tensor, "..."]
    holdout: Float64[Tensor, " m"]
    center_loss: float
    model: Float64[Tensor, "..."] | None
    slope: Float64[Tensor, " d"] | None
    curvature: Float64[Tensor, "d d"] | None
    crossed: Bool[Tensor, "..."] | None
    evaluations: int
    reason: StopReason
    looks: int = 1

    @property
    def difference(self) -> Float64[Tensor, "..."] | None:
        """Objective minus quadratic model."""
        return None if self.model is None else self.loss - self.model

    @property
    def range(self) -> float:
        """The largest difference between finite evaluated values."""
        finite = self.loss[self.evaluated & self.loss.isfinite()]
        return float(finite.max() - finite.min()) if finite.numel() else 0.0

    @property
    def interpolation_error(self) -> float:
        """The largest error of the hold-out as a share of the range; 0 where every point is evaluated, infinite without any."""
        if self.evaluated.all():
            return 0.0
        if not self.holdout.numel():
            return inf
        if not self.holdout.any():
            return 0.0
        return float(self.holdout.max()) / self.range if self.range else inf

    @property
    def share_beyond(self) -> float:
        """With 95% confidence, at most this share of the interpolated points is off by more than interpolation_error.

        If a share p were, a hold-out of m random points would miss all of them with the probability (1 - p)^m at most.  p is
        where that is 0.05 / 2^k at the k-th look: with many looks it is likelier that one of them is lucky.
        """
        if self.evaluated.all():
            return 0.0
        return 1 - (0.05 / 2**self.looks) ** (1 / self.holdout.numel()) if self.holdout.numel() else 1.0

    def record(self) -> dict[str, Number | int | str]:
        return {
            "points": self.loss.numel(),
            "evaluated_points": int(self.evaluated.sum()),
            "crossed_points": 0 if self.crossed is None else int(self.crossed.sum()),
            "evaluations": self.evaluations,
            "center_loss": self.center_loss,
            "interpolation_error": finite_or_none(self.interpolation_error),
            "holdout_points": self.holdout.numel(),
            "share_beyond": self.share_beyond,
            "reason": self.reason,
        }
