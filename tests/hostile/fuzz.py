"""Broken files by the thousand: `python -m tests.hostile.fuzz [--cases 10000] [--seed 0] [FORMAT ...]`.

Every case is made from the format's name, the seed and its number alone.  It runs in a process that may take so many bytes more
than at its start, and that is ended where a case takes too long.  Outcomes:

    clean       refused in one sentence            harmless    accepted, and what follows from it is made
    traceback   any other error                    wrong       accepted, and other than what was written or than can be
    memory      more than MOST_BYTES               hang        longer than SECONDS
    crash       the process ended
"""

import argparse
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from unittest.mock import patch

import psutil

SECONDS, MOST_BYTES = 5.0, 2**30  # of a processor; beyond what the process holds at its start
GOOD = ("clean", "harmless")
PATIENCE = 60.0  # seconds by the clock without a word, in which a process may have had no processor
ROOT = Path(__file__).parents[2]


@dataclass
class Found:
    """Outcomes of a format's cases; failures: what to say of those that are not good."""

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def add(self, case: int, outcome: str, said: str) -> None:
        self.outcomes[outcome] += 1
        if outcome not in GOOD:
            self.failures.append(f"case {case}, {outcome}: {said}")


def fuzzed(name: str, cases: int, seed: int = 0) -> Found:
    """What comes of so many cases of a format."""
    found, first = Found(), 0
    while first < cases:
        first = _watched(name, first, cases, seed, found)
    return found


def _watched(name: str, first: int, cases: int, seed: int, found: Found) -> int:
    """Run cases from `first` on in a process, until it ends; returns the next case."""
    receiver, sender = _processes().Pipe(duplex=False)
    with tempfile.NamedTemporaryFile() as errors:
        process = _processes().Process(target=work, args=(name, first, cases, seed, sender, errors.name))
        process.start()
        sender.close()
        case, spent, silent, begun = first - 1, 0.0, 0, False
        assert process.pid is not None
        while True:
            if not receiver.poll(PATIENCE):
                silent += 1
                if _seconds(process.pid) - spent < 4 * SECONDS and silent < 20:
                    continue
                process.kill()
                found.add(case + 1, "hang", f"silent for {_seconds(process.pid) - spent:.0f} s of a processor")
                return case + 2
            try:
                case, outcome, said = receiver.recv()
            except EOFError:
                break
            spent, silent, begun = _seconds(process.pid), 0, True
            if outcome != "begun":
                found.add(case, outcome, said)
        process.join()
        said = errors.read().decode(errors="replace")
        if not begun:
            raise RuntimeError(f"no example of {name}: {said[-2000:]}")
        if case + 1 < cases:
            found.add(case + 1, "crash", f"exit code {process.exitcode}: {said[-300:]}")
            return case + 2
    return cases


@cache
def _processes() -> ForkServerContext:
    """Makes processes that have everything imported, and one thread each."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.hostile.formats"])
    with patch.dict(os.environ, {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}):
        ensure_running()
    return context


def _seconds(process: int) -> float:
    """That it has had of a processor; 0 where it has ended."""
    try:
        times = psutil.Process(process).cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return times.user + times.system


def work(name: str, first: int, cases: int, seed: int, told: Connection, errors: str) -> None:
    """Run cases, and tell of each; errors: the file for what libraries print."""
    from tests.hostile.formats import FORMATS

    warnings.simplefilter("ignore")
    printed = os.open(errors, os.O_WRONLY | os.O_APPEND)
    os.dup2(printed, 1)
    os.dup2(printed, 2)
    with tempfile.TemporaryDirectory() as folder:
        example = FORMATS[name](Path(folder))
        _limit_memory()
        told.send((first - 1, "begun", ""))
        for case in range(first, cases):
            start = time.process_time()
            outcome, said = _outcome(example, random.Random(f"{name} {seed} {case}"))
            if (spent := time.process_time() - start) > SECONDS:
                outcome, said = "hang", f"{spent:.1f} s, {outcome} {said}"
            told.send((case, outcome, said))


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * os.sysconf("SC_PAGE_SIZE") + MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _outcome(example: object, chance: random.Random) -> tuple[str, str]:
    from analysis.console.failures import BAD_INPUT, NO_MEMORY, describe

    try:
        example.case(chance)  # pyright: ignore[reportAttributeAccessIssue]
    except AssertionError as error:
        if (
            "tests/hostile" in traceback.extract_tb(error.__traceback__)[-1].filename
            or "not equal" in str(error).lower()
        ):
            return "wrong", str(error).strip()[:200]
        return "traceback", _where(error)
    except Exception as error:
        code, _ = describe(error)
        if code == NO_MEMORY:
            return "memory", _where(error)
        return ("clean", "") if code == BAD_INPUT else ("traceback", _where(error))
    return "harmless", ""


def _where(error: BaseException) -> str:
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if str(ROOT) in frame.filename]
    place = f"{Path(frames[-1].filename).relative_to(ROOT)}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__} at {place}: {' '.join(str(error).split())[:200]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("formats", nargs="*")
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if find_spec("pytest") is None:
        parser.error(
            "expected the developers' tools, found no pytest; pip install -e '.[dev]', or make test, brings them"
        )
    from tests.hostile.formats import FORMATS

    bad = 0
    for name in options.formats or FORMATS:
        start = time.monotonic()
        found = fuzzed(name, options.cases, options.seed)
        counts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(found.outcomes.items()))
        print(f"{name}: {counts}; {time.monotonic() - start:.0f} s", flush=True)
        kinds = Counter(failure.partition(", ")[2] for failure in found.failures)
        for kind, count in kinds.most_common(12):
            print(f"    {count} x {kind}")
        bad += len(found.failures)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
