"""Time of a training: in its steps alone, over resumes, without loading, saving and scoring; and its peak memory.

RUN/seconds.json holds it, written after every checkpoint.  A kernel that has to be compiled first counts in.
"""

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from time import perf_counter, process_time

import msgspec
import torch

from analysis.records.json_files import read_json
from analysis.records.run_files import SECONDS, Seconds
from splat.training.checkpoint import write_atomically
from splat.training.loop import StepResult

REMEDY = "remove it: nothing but the time until its last checkpoint is lost"


class TrainingTime(Seconds):
    """The time until a step."""

    @classmethod
    def read(cls, run: Path) -> "TrainingTime":
        """Time of a run folder; zero where it has not been saved yet."""
        path = run / SECONDS
        return read_json(path, cls, "the seconds of a training", REMEDY) if path.is_file() else cls(0, 0.0, 0.0)

    def write(self, run: Path) -> None:
        unit = 1 if sys.platform == "darwin" else 1024
        self.peak = max(self.peak or 0, unit * getrusage(RUSAGE_SELF).ru_maxrss)
        write_atomically(run / SECONDS, msgspec.json.encode(self) + b"\n")

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
