"""Traces of the blocks of H by Hutchinson's estimator: E z^T H z = tr H for E z z^T = I (Girard 1989, Hutchinson 1990).

    reading "block"   z lives on one block at a time: a matvec per block and probe.  Variance 2 |H_bb|_F^2 for
                      Gaussian z, the same without the diagonal of H_bb for Rademacher z.
    reading "full"    z lives on all rows and every block reads its part of z * (H z): a matvec per probe for all
                      blocks.  Unbiased, because the cross terms vanish in expectation; each adds |H_bc|_F^2 to the
                      variance.

`PAPER` is StableGS's estimator, Eq. (6): Gaussian z, one block at a time, ten probes.

An adaptive run stops when the t interval's half width is below max(rtol |trace|, atol).  Every look is a chance to stop
on a variance that is too small by luck, so it looks only when the number of probes has grown by half since the last
look, and stops when the tolerance still holds four probes later: a few further samples make up for stopping on one's
own variance (Simons 1968; from 93.5 to 94.5% cover here).  Samples of a trace that one eigenvalue dominates are skewed,
and Student's interval covers less (91% with ten probes on the spectrum 1/i).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf
from time import monotonic
from typing import Literal

import torch

from landscape.operator import RestrictedOperator, SymmetricOperator
from landscape.probes import Distribution, draw_probes, split
from landscape.results import Progress, StopReason, TraceEstimate, t_interval

Reading = Literal["block", "full"]
GROWTH = 1.5  # between two looks
CONFIRMATION = 4  # probes between reaching the tolerance and believing it


@dataclass(frozen=True)
class TraceSettings:
    """How many probe vectors of which kind.  rtol = atol = 0: max_probes of them, unless max_seconds end it."""

    distribution: Distribution = "rademacher"
    reading: Reading = "block"
    rtol: float = 0.05
    atol: float = 0.0
    confidence: float = 0.95
    min_probes: int = 8
    max_probes: int = 100
    max_seconds: float = inf
    batch: int = 4

    def __post_init__(self) -> None:
        if self.distribution not in ("rademacher", "gaussian"):
            raise ValueError(f"expected the distribution 'rademacher' or 'gaussian', got {self.distribution!r}")
        if self.reading not in ("block", "full"):
            raise ValueError(f"expected the reading 'block' or 'full', got {self.reading!r}")
        if not 2 <= self.min_probes <= self.max_probes:
            raise ValueError(f"expected 2 <= min_probes <= max_probes, got {self.min_probes} and {self.max_probes}")
        if self.rtol < 0 or self.atol < 0 or not 0 < self.confidence < 1 or self.batch < 1:
            raise ValueError(
                f"expected rtol, atol >= 0, confidence in (0, 1) and batch >= 1, "
                f"got {self.rtol}, {self.atol}, {self.confidence} and {self.batch}"
            )

    @classmethod
    def fixed(
        cls, probes: int, distribution: Distribution = "rademacher", reading: Reading = "block"
    ) -> "TraceSettings":
        """Exactly this many probes."""
        return cls(distribution, reading, rtol=0.0, min_probes=probes, max_probes=probes)


PAPER = TraceSettings.fixed(10, "gaussian")


def estimate_traces(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: TraceSettings = TraceSettings(),
    blocks: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> dict[str, TraceEstimate]:
    """The trace of each named block (all of the operator's by default) with its standard error and interval.

    Progress counts probe vectors.  With the reading "full" all estimates share probes and matvecs, hence are
    correlated.

    >>> from landscape.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([1.0, 2.0, 3.0])))
    >>> estimate_traces(H, torch.Generator().manual_seed(0))["all"].value  # Rademacher is exact on a diagonal
    6.0
    """
    names = list(operator.blocks) if blocks is None else list(blocks)
    unknown = [name for name in names if name not in operator.blocks]
    if unknown:
        raise ValueError(f"expected blocks out of {', '.join(operator.blocks)}, got {unknown[0]!r}")
    deadline = monotonic() + settings.max_seconds
    if settings.reading == "full":
        rows = {name: operator.blocks[name] for name in names}
        return _Run(operator, rows, split(generator), settings, deadline).estimate(0, settings.max_probes, progress)
    estimates: dict[str, TraceEstimate] = {}
    for index, name in enumerate(names):
        block = RestrictedOperator(operator, name)
        # what is left of the time is shared evenly among the blocks to come
        end = monotonic() + max(deadline - monotonic(), 0) / (len(names) - index)
        run = _Run(block, dict(block.blocks), split(generator), settings, end)
        estimates |= run.estimate(index * settings.max_probes, len(names) * settings.max_probes, progress)
    return estimates


class _Run:
    """One operator, probed until every block of rows has the error asked for."""

    def __init__(
        self,
        operator: SymmetricOperator,
        rows: dict[str, slice],
        generator: torch.Generator,
        settings: TraceSettings,
        deadline: float,
    ) -> None:
        self.operator, self.rows, self.generator = operator, rows, generator
        self.settings, self.deadline = settings, deadline
        self.samples = torch.empty(len(rows), 0, dtype=torch.float64)

    def estimate(self, done_before: int, most: int, progress: Progress | None) -> dict[str, TraceEstimate]:
        settings, probes, look, confirming = self.settings, 0, self.settings.min_probes, False
        if self.operator.dim == 0:
            self.samples = torch.zeros(len(self.rows), 2, dtype=torch.float64)
            return self._estimates("exact", probes=0)
        while True:
            self._draw(min(settings.batch, look - probes))
            probes = self.samples.shape[1]
            if progress:
                progress(done_before + probes, most, f"trace of {', '.join(self.rows)}: {probes} probes")
            late = monotonic() > self.deadline and probes >= settings.min_probes
            if probes < look and not late:
                continue
            estimates = self._estimates("time budget" if late else "matvec budget", probes)
            reached = all(estimate.reason == "tolerance" for estimate in estimates.values())
            if late or probes == settings.max_probes or (reached and confirming):
                return estimates
            look = min(probes + CONFIRMATION if reached else ceil(GROWTH * probes), settings.max_probes)
            confirming = reached

    def _draw(self, count: int) -> None:
        Z = draw_probes(self.operator.dim, count, self.generator, self.operator.dtype, self.settings.distribution)
        products = Z.double() * self.operator.apply(Z).double()
        sums = torch.stack([products[rows].sum(dim=0) for rows in self.rows.values()])
        if not torch.isfinite(sums).all():
            raise ValueError(f"expected finite products H z, got z.Hz = {sums.tolist()} in {', '.join(self.rows)}")
        self.samples = torch.cat([self.samples, sums], dim=1)

    def _estimates(self, reason: StopReason, probes: int) -> dict[str, TraceEstimate]:
        """The estimates so far; those that have the error asked for say so, the others give the reason."""
        settings, results = self.settings, {}
        for (name, rows), samples in zip(self.rows.items(), self.samples, strict=True):
            value, error, low, high = t_interval(samples, settings.confidence)
            reached = (settings.rtol or settings.atol) and (high - low) / 2 <= max(
                settings.rtol * abs(value), settings.atol
            )
            results[name] = TraceEstimate(
                block=name,
                dim=rows.stop - rows.start,
                value=value,
                standard_error=error,
                low=low,
                high=high,
                confidence=settings.confidence,
                probes=probes,
                matvecs=probes,
                reason="tolerance" if reached and probes else reason,
                samples=samples[:probes],
            )
        return results
