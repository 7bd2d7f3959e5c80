"""Hutchinson's estimator, E z^T H z = tr H for E z z^T = I (Girard 1989, Hutchinson 1990), with a sequential stopping rule.

An adaptive run stops when half the width of its interval is at most max(rtol |trace|, atol).  Every look at the interval may
find it too short by chance.  So a run that misses its tolerance looks again only after GROWTH times as many probes; one that
meets it looks again CONFIRMATION probes later and stops if it still does (Simons 1968).  For the chance that is left its
interval is WIDENING times as wide.

A block is some of the rows; a group is GROUP probes whose vectors are kept together, for the z_i^T H z_j of every two of them,
which tell the variance (`quadratic`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_dots
from landscape.operators.operator import SymmetricOperator, product
from landscape.probes import Distribution, draw_probes
from landscape.results import Progress
from landscape.traces.estimate import TraceEstimate
from landscape.traces.quadratic import FEWEST, PowerSums, mean_interval, power_sums

Reading = Literal["block", "full"]
Method = Literal["auto", "hutchinson", "hutch++", "xtrace"]
LEAST = 8  # probes, for an interval by `quadratic`
GROWTH = 1.5  # ratio of the numbers of probes at two looks
CONFIRMATION = 4  # probes between reaching the tolerance and stopping
WIDENING = 1.05  # factor of the interval of an adaptive run
GROUP = 32  # probes whose vectors are kept at a time, for the pairs in `quadratic`


@dataclass(frozen=True)
class TraceSettings:
    """Number and kind of probe vectors, and the method.

    distribution: entries of a probe are random signs ("rademacher") or standard normal ("gaussian").
    reading, method: see `landscape.traces.trace`.
    rtol, atol: a run is done when half the width of every interval is at most max(rtol |trace|, atol).  With both 0 every
        block takes max_probes.  confidence: of the interval.
    min_probes: probes before the first look at the error.  max_probes: largest number of matvecs of a block by any method.
    batch: vectors the operator takes at once.
    memory: GiB for the vectors that a sketch keeps; XTrace stops when it is full.
    """

    distribution: Distribution = "rademacher"
    reading: Reading = "block"
    rtol: float = 0.05
    atol: float = 0.0
    confidence: float = 0.95
    min_probes: int = LEAST
    max_probes: int = 100
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
        positive = self.rtol >= 0 and self.atol >= 0 and self.batch >= 1 and self.memory > 0
        if not (positive and 0 < self.confidence < 1):
            raise InputError(
                f"expected rtol, atol >= 0, confidence in (0, 1), batch >= 1 and memory > 0, "
                f"got {self.rtol}, {self.atol}, {self.confidence}, {self.batch} and {self.memory}"
            )

    @classmethod
    def fixed(
        cls,
        probes: int,
        distribution: Distribution = "rademacher",
        reading: Reading = "block",
        method: Method = "hutchinson",
    ) -> "TraceSettings":
        """Settings for exactly this many probes; for methods other than "hutchinson", matvecs."""
        return cls(distribution, reading, rtol=0.0, min_probes=probes, max_probes=probes, method=method)

    @property
    def least(self) -> int:
        """The fewest matvecs of the method: LEAST for each part, Hutch++'s sketch, range and probes, XTrace's two."""
        return LEAST * {"auto": 1, "hutchinson": 1, "hutch++": 3, "xtrace": 2}[self.method]

    @property
    def adaptive(self) -> bool:
        return (self.rtol > 0 or self.atol > 0) and self.min_probes < self.max_probes

    def reached(self, value: float, low: float, high: float) -> bool:
        """Whether an interval is short enough."""
        asked = self.rtol > 0 or self.atol > 0
        return asked and (high - low) / 2 <= max(self.rtol * abs(value), self.atol)


class StoppingRule:
    """When an adaptive run looks at its interval, and when it ends.

    first: probes at the first look; most: probes at which the run ends in any case; confirmation: probes between the look that
    reaches the tolerance and the one that confirms it.  next: number of probes at the next look.
    """

    def __init__(self, first: int, most: int, confirmation: int = CONFIRMATION) -> None:
        self.next, self._most, self._confirmation, self._confirming = first, most, confirmation, False

    def end(self, probes: int, reached: bool) -> bool:
        """Whether the run ends with this look.  reached: whether the error is small enough now."""
        if probes == self._most or (reached and self._confirming):
            return True
        self.next = min(probes + self._confirmation if reached else ceil(GROWTH * probes), self._most)
        self._confirming = reached
        return False


class Hutchinson:
    """Hutchinson's estimator on one operator, for several blocks at once.

    rows: of the blocks, by name.  samples: (blocks, probes), the sum of z_r (H z)_r over a block's rows r.  known: part of the
    trace that the operator lacks, of a single block; else 0.  spent: matvecs for `known`.  keep: most probes that stay, with
    their products, in `kept`, which is emptied when there are more.
    """

    def __init__(
        self,
        operator: SymmetricOperator,
        rows: Mapping[str, slice],
        generator: torch.Generator,
        settings: TraceSettings,
        known: float = 0.0,
        spent: int = 0,
        keep: int = 0,
    ) -> None:
        self.operator, self.rows, self.generator = operator, rows, generator
        self.settings, self.known, self.spent, self.keep = settings, known, spent, keep
        self.samples = torch.empty(len(rows), 0, dtype=torch.float64)
        assert not known or len(rows) == 1
        self.groups: dict[str, list[PowerSums]] = {name: [] for name in rows}
        self.current: list[tuple[Tensor, Tensor]] = []  # Z and H Z of the probes that are in no full group yet
        self.kept: list[tuple[Tensor, Tensor]] = []

    def estimate(self, progress: Progress | None = None) -> dict[str, TraceEstimate]:
        """The trace of every block.  Progress counts matvecs."""
        *_, (estimates, _) = self.looks(self.settings.min_probes, progress)  # of the last look
        return estimates

    def looks(self, first: int, progress: Progress | None = None) -> Iterator[tuple[dict[str, TraceEstimate], bool]]:
        """The estimates at every look, the first one after `first` probes, and whether the run ends there.

        Before it ends, the reason of an estimate that misses its tolerance means nothing.
        """
        settings, probes, rule, ended = self.settings, 0, StoppingRule(first, self.settings.max_probes), False
        if self.operator.dim == 0:
            known = (self.known, settings.confidence, self.spent)  # value, confidence, matvecs
            yield {name: TraceEstimate.exact(name, 0, *known) for name in self.rows}, True
            return
        while not ended:
            # no further than the next look or the end of a group
            self.draw(min(settings.batch, rule.next - probes, GROUP - probes % GROUP))
            probes = self.samples.shape[1]
            if progress:
                progress(probes, settings.max_probes, f"trace of {', '.join(self.rows)}: {probes} probes")
            if probes < rule.next:
                continue
            estimates = self._estimates()
            ended = rule.end(probes, all(found.reason == "tolerance" for found in estimates.values()))
            yield estimates, ended

    def draw(self, count: int) -> None:
        """Add this many probes and their products with H."""
        Z = draw_probes(self.operator.dim, count, self.generator, self.operator.dtype, self.settings.distribution)
        Y = product(self.operator, Z).clone()  # kept below; an operator may return the same buffer again
        sums = torch.stack([column_dots(Z[r], Y[r]) for r in self.rows.values()])
        self.samples = torch.cat([self.samples, sums.cpu()], dim=1)
        self.kept = [*self.kept, (Z, Y)] if self.samples.shape[1] <= self.keep else []
        self.current.append((Z, Y))
        if self.samples.shape[1] % GROUP == 0:
            for name, group in self._open_group().items():
                self.groups[name].append(group)
            self.current = []

    def _open_group(self) -> dict[str, PowerSums]:
        """Power sums of every block, from the probes that are in no full group yet; {} for fewer than FEWEST."""
        if sum(Z.shape[1] for Z, _ in self.current) < FEWEST:
            return {}
        Z, Y = joined(self.current)
        kind = self.settings.distribution
        return {name: power_sums(Z[rows], Y[rows], kind) for name, rows in self.rows.items()}

    def _estimates(self) -> dict[str, TraceEstimate]:
        """The estimates so far."""
        settings, results, opened = self.settings, {}, self._open_group()
        probes = self.samples.shape[1]
        widening = WIDENING if settings.adaptive else 1.0
        for samples, (name, rows) in zip(self.samples + self.known, self.rows.items(), strict=True):
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
                reason="tolerance" if settings.reached(value, low, high) else "matvec budget",
                samples=samples,
            )
        return results


def joined(pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n k"]]:
    """The probes and the products of all pairs (Z, H Z), side by side."""
    Z, Y = (torch.cat(parts, dim=1) for parts in zip(*pairs, strict=True))
    return Z, Y
