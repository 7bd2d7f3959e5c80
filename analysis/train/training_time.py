"""Time of a training: in its steps alone, over resumes, without loading, saving and scoring; and its peak memory.

RUN/seconds.json    {"step", "wall", "cpu", "threads", "peak"}, written after every checkpoint: seconds by the clock and of
                    all processors together up to that step, the threads that a kernel might use (null where a resume
                    changed them), and the most bytes that the process held until then, loading too (of a GPU's none).
                    A kernel that has to be compiled first counts in
"""

import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from time import perf_counter, process_time

import torch

from analysis.records.run_files import SECONDS, read_seconds
from splat.training.checkpoint import write_atomically
from splat.training.loop import StepResult


@dataclass
class TrainingTime:
    """The time until a step."""

    step: int = 0
    wall: float = 0.0
    cpu: float = 0.0
    threads: int | None = 1
    peak: int | None = None

    @classmethod
    def read(cls, run: Path) -> "TrainingTime":
        """Time of a run folder; zero where it has not been saved yet."""
        if not (run / SECONDS).is_file():
            return cls()
        found = read_seconds(run)
        return cls(found.step, found.wall, found.cpu, found.threads, found.peak)

    def write(self, run: Path) -> None:
        unit = 1 if sys.platform == "darwin" else 1024
        self.peak = max(self.peak or 0, unit * getrusage(RUSAGE_SELF).ru_maxrss)
        write_atomically(run / SECONDS, (json.dumps(asdict(self)) + "\n").encode())

    def timed(self, steps: Iterable[StepResult]) -> Iterator[StepResult]:
        """The same steps; the time that each takes is added up as it is made."""
        iterator = iter(steps)
        threads = torch.get_num_threads()
        self.threads = threads if self.threads == threads or self.step == 0 else None
        while True:
            wall, cpu = perf_counter(), process_time()
            done = next(iterator, None)
            if done is None:
                return
            self.step = done.step
            self.wall += perf_counter() - wall
            self.cpu += process_time() - cpu
            yield done
