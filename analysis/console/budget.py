"""The time of a probe, divided among its stages, and what each of them may use."""

from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from time import monotonic

import torch

from landscape.probes import split
from landscape.results import Progress

Stage = Callable[[str], AbstractContextManager[Progress]]

# shares of the time; measured on 8,000 Gaussians in 3 views of 504 x 378 pixels
SHARES = {
    "traces": 4.0,
    "eigenvalues": 4.0,
    "power iteration": 2.5,
    "density": 4.0,
    "finite probe": 2.0,
    "slice": 4.0,
    "depth": 2.0,
}
# what is said of a stage that was not asked for
LEFT_OUT = {
    "density": "the spectral density was left out, and the indices that need it",
    "finite probe": "the finite probe was left out",
    "depth": "positions along and across the rays were left out",
}


@dataclass(frozen=True, eq=False)
class Share:
    """What a stage may use: its seconds and its own random numbers; whom it tells how far it is, and where it says what it
    left out."""

    seconds: float
    generator: torch.Generator
    report: Progress
    notes: list[str]


class Budget:
    """Divides the time that is left among the stages to come, in proportion to their shares.  It runs from now on.

    unasked: stages that were not asked for, of which `notes` says so; generator: every stage draws from its own stream;
    stage(name): see `analysis.console.stages`.
    """

    def __init__(self, seconds: float, unasked: Collection[str], generator: torch.Generator, stage: Stage) -> None:
        self._end, self._begin = monotonic() + seconds, stage
        self._to_come = {name: share for name, share in SHARES.items() if name not in unasked}
        self._streams = {name: split(generator) for name in SHARES}
        self.notes = [note for name, note in LEFT_OUT.items() if name in unasked]

    @contextmanager
    def stage(self, name: str) -> Iterator[Share]:
        """Begin a stage, once, with its share of what is left."""
        with self._begin(name) as report:
            part = self._to_come[name] / sum(self._to_come.values())
            del self._to_come[name]
            yield Share(max(self._end - monotonic(), 0.0) * part, self._streams[name], report, self.notes)
