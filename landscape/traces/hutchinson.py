"""Hutchinson's estimator, E z^T H z = tr H for E z z^T = I (Girard 1989, Hutchinson 1990), until the error is small enough.

An adaptive run stops when the interval's half width is below max(rtol |trace|, atol).  Every look is a chance to stop on a
spread that is too small by luck, so it looks only when the number of probes has grown by half since the last look, stops
when the tolerance still holds four probes later (Simons 1968), and takes its interval 5% wider.  Cover measured over 2,000
seeds, tolerances that take 12 to 70 probes, relative and absolute: 93 to 97.1% on all spectra of `quadratic`; up to 97.7%
where the tolerance is as large as the trace of one dominant eigenvalue, and the first look decides.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, inf
from time import monotonic
from typing import Literal

import torch
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_dots
from landscape.operators.operator import SymmetricOperator, product
from landscape.probes import Distribution, draw_probes
from landscape.results import Progress, StopReason
from landscape.traces.estimate import TraceEstimate
from landscape.traces.quadratic import FEWEST, PowerSums, mean_interval, power_sums

Reading = Literal["block", "full"]
Method = Literal["auto", "hutchinson", "hutch++", "xtrace"]
LEAST = 8  # probes: with fewer no interval can be trusted
GROWTH = 1.5  # between two looks
CONFIRMATION = 4  # probes between reaching the tolerance and believing it
WIDENING = 1.05  # of the interval of an adaptive run
GROUP = 32  # probes whose vectors are kept for the law of the mean


@dataclass(frozen=True)
class TraceSettings:
    """How many probe vectors of which kind, and by which method.

    distribution: entries of a probe are random signs ("rademacher") or standard normal ("gaussian").
    reading, method: see `landscape.traces.trace`.
    rtol, atol: a block is done when half the width of its interval is max(rtol |trace|, atol) or less; both 0: every block
        takes max_probes, unless max_seconds end it.  confidence: of the interval.
    min_probes: before the error is first looked at.  max_probes: the most matvecs of a block, by any method (a probe of
        Hutchinson's is one; a sketch takes more for each).
    max_seconds: for all blocks together, after min_probes.  batch: vectors in one application of the operator.
    memory: GiB for the vectors that a sketch keeps; XTrace stops where they are full.
    """

    distribution: Distribution = "rademacher"
    reading: Reading = "block"
    rtol: float = 0.05
    atol: float = 0.0
    confidence: float = 0.95
    min_probes: int = LEAST
    max_probes: int = 100
    max_seconds: float = inf
    batch: int = 4
    method: Method = "auto"
    memory: float = 2.0

    def __post_init__(self) -> None:
        if self.distribution not in ("rademacher", "gaussian"):
            raise InputError(f"expected the distribution 'rademacher' or 'gaussian', got {self.distribution!r}")
        if self.reading not in ("block", "full"):
            raise InputError(f"expected the reading 'block' or 'full', got {self.reading!r}")
        if self.method not in ("auto", "hutchinson", "hutch++", "xtrace"):
            raise InputError(f"expected the method 'auto', 'hutchinson', 'hutch++' or 'xtrace', got {self.method!r}")
        if self.method in ("hutch++", "xtrace") and self.reading == "full":
            raise InputError(f"expected the reading 'block' with the method {self.method!r}, got 'full'")
        if not LEAST <= self.min_probes <= self.max_probes or self.max_probes < self.least:
            raise InputError(
                f"expected {LEAST} <= min_probes <= max_probes and max_probes >= {self.least} with the method {self.method!r}, "
                f"got {self.min_probes} and {self.max_probes}"
            )
        positive = self.rtol >= 0 and self.atol >= 0 and self.max_seconds >= 0 and self.batch >= 1 and self.memory > 0
        if not (positive and 0 < self.confidence < 1):
            raise InputError(
                f"expected rtol, atol >= 0, confidence in (0, 1), max_seconds >= 0, batch >= 1 and memory > 0, "
                f"got {self.rtol}, {self.atol}, {self.confidence}, {self.max_seconds}, {self.batch} and {self.memory}"
            )

    @classmethod
    def fixed(
        cls,
        probes: int,
        distribution: Distribution = "rademacher",
        reading: Reading = "block",
        method: Method = "hutchinson",
    ) -> "TraceSettings":
        """Exactly this many probes, whatever the error (a method other than "hutchinson" counts matvecs)."""
        return cls(distribution, reading, rtol=0.0, min_probes=probes, max_probes=probes, method=method)

    @property
    def least(self) -> int:
        """The fewest matvecs of the method: LEAST for each of its tasks."""
        return LEAST * {"auto": 1, "hutchinson": 1, "hutch++": 3, "xtrace": 2}[self.method]

    @property
    def adaptive(self) -> bool:
        return (self.rtol > 0 or self.atol > 0) and self.min_probes < self.max_probes

    def reached(self, value: float, low: float, high: float) -> bool:
        """Whether an interval is as short as was asked for."""
        asked = self.rtol > 0 or self.atol > 0
        return asked and (high - low) / 2 <= max(self.rtol * abs(value), self.atol)


class StoppingRule:
    """When an adaptive run looks at its error, and whether it may then stop.  next: the number of probes at the next look."""

    def __init__(self, first: int, most: int, confirmation: int = CONFIRMATION) -> None:
        self.next, self._most, self._confirmation, self._confirming = first, most, confirmation, False

    def end(self, probes: int, reached: bool) -> bool:
        """Whether the run ends with this look, at which the error asked for was reached or not."""
        if probes == self._most or (reached and self._confirming):
            return True
        self.next = min(probes + self._confirmation if reached else ceil(GROWTH * probes), self._most)
        self._confirming = reached
        return False


class Hutchinson:
    """One operator, probed until every one of its groups of rows has the error asked for.

    known: a part of the trace that is not in the operator; spent: matvecs that it took.
    """

    def __init__(
        self,
        operator: SymmetricOperator,
        rows: Mapping[str, slice],
        generator: torch.Generator,
        settings: TraceSettings,
        deadline: float = inf,
        known: float = 0.0,
        spent: int = 0,
    ) -> None:
        self.operator, self.rows, self.generator = operator, rows, generator
        self.settings, self.deadline, self.known, self.spent = settings, deadline, known, spent
        self.samples = torch.empty(len(rows), 0, dtype=torch.float64)  # z^T H z, a line for each group of rows
        self.groups: dict[str, list[PowerSums]] = {name: [] for name in rows}
        self.current: list[tuple[Tensor, Tensor]] = []  # Z and H Z of the probes that are in no group yet

    def estimate(
        self, done_before: int = 0, most: int = 0, progress: Progress | None = None
    ) -> dict[str, TraceEstimate]:
        """Progress counts matvecs, from done_before to most."""
        settings, probes, looks = self.settings, 0, StoppingRule(self.first_look, self.settings.max_probes)
        if self.operator.dim == 0:
            exact = (self.known, settings.confidence, self.spent)
            return {name: TraceEstimate.exact(name, 0, *exact) for name in self.rows}
        while True:
            self.draw(min(settings.batch, looks.next - probes, GROUP - probes % GROUP))
            probes = self.samples.shape[1]
            if progress:
                progress(done_before + probes, most, f"trace of {', '.join(self.rows)}: {probes} probes")
            late = monotonic() > self.deadline and probes >= settings.min_probes
            if probes < looks.next and not late:
                continue
            estimates = self._estimates("time budget" if late else "matvec budget")
            reached = all(estimate.reason == "tolerance" for estimate in estimates.values())
            if late or looks.end(probes, reached) or (not reached and self.leaves(estimates)):
                return estimates

    @property
    def first_look(self) -> int:
        return self.settings.min_probes

    def leaves(self, estimates: Mapping[str, TraceEstimate]) -> bool:
        """Whether these estimates are where this method ends, because another one does better."""
        return False

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        """Probes and their products with H, taken into account."""
        Z = draw_probes(self.operator.dim, count, self.generator, self.operator.dtype, self.settings.distribution)
        Y = product(self.operator, Z).clone()  # kept below, and an operator may give the same buffer again
        sums = torch.stack([column_dots(Z[r], Y[r]) for r in self.rows.values()])
        self.samples = torch.cat([self.samples, sums.cpu()], dim=1)
        self.current.append((Z, Y))
        if self.samples.shape[1] % GROUP == 0:
            for name, group in self._open_groups().items():
                self.groups[name].append(group)
            self.current = []
        return Z, Y

    def _open_groups(self) -> dict[str, PowerSums]:
        """The power sums of every block from the probes in no group yet."""
        if sum(parts[0].shape[1] for parts in self.current) < FEWEST:
            return {}
        Z, Y = (torch.cat(parts, dim=1) for parts in zip(*self.current, strict=True))
        kind = self.settings.distribution
        return {name: power_sums(Z[rows], Y[rows], kind) for name, rows in self.rows.items()}

    def _estimates(self, reason: StopReason) -> dict[str, TraceEstimate]:
        """The estimates so far; those that have the error asked for say so, the others give the reason."""
        settings, results, opened = self.settings, {}, self._open_groups()
        probes = self.samples.shape[1]
        widening = WIDENING if settings.adaptive else 1.0
        for i, (name, rows) in enumerate(self.rows.items()):
            samples = self.samples[i] + self.known
            groups = self.groups[name] + ([opened[name]] if opened else [])
            value = float(samples.mean())
            error, low, high = mean_interval(value, probes, groups, settings.confidence, widening)
            results[name] = TraceEstimate(
                block=name,
                dim=rows.stop - rows.start,
                value=value,
                standard_error=error,
                low=low,
                high=high,
                confidence=settings.confidence,
                probes=probes,
                matvecs=self.spent + probes,
                reason="tolerance" if settings.reached(value, low, high) else reason,
                samples=samples,
                method="hutchinson",
            )
        return results
