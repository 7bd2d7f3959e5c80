"""Broken files by the thousand: `python -m tests.hostile.fuzz [--cases 10000] [--seed 0] [READER ...]`.

Every case is made from the reader's name, the seed and its number alone.  It runs in a process that may take so many bytes more
than at its start, and that the system ends where a case takes too long.  Outcomes:

    clean       refused in one sentence            harmless    accepted, and what follows from it is made
    traceback   any other error                    wrong       accepted, and other than what was written or than can be
    memory      more than MOST_BYTES               ended       the process: killed by SIGPROF where SECONDS are over
"""

import argparse
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

SECONDS, MOST_BYTES = 5, 2**30  # of a processor; beyond what the process holds at its start
PATIENCE = 3600.0  # seconds by the clock for all cases of a process, which may wait for something
GOOD = ("clean", "harmless")
TOLD = re.compile(r"^CASE (-?\d+) (\w+) ?(.*)$", re.MULTILINE)
ROOT = Path(__file__).parents[2]


@dataclass
class Found:
    """Outcomes of a reader's cases; failures: what to say of those that are not good."""

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def add(self, case: int, outcome: str, said: str) -> None:
        self.outcomes[outcome] += 1
        if outcome not in GOOD:
            self.failures.append(f"case {case}, {outcome}: {said}")


def fuzzed(name: str, cases: int, seed: int = 0) -> Found:
    """What comes of so many cases of a reader: as many processes as it takes to come to the last."""
    from tests.forks import processes  # needs pytest, and `main` says so

    found, first = Found(), 0
    while first < cases:
        with tempfile.NamedTemporaryFile() as told:
            process = processes().Process(target=work, args=(name, range(first, cases), seed, told.name))
            process.start()
            process.join(PATIENCE)
            process.kill()
            process.join()
            said = told.read().decode(errors="replace")
        if not (lines := TOLD.findall(said)):
            raise RuntimeError(f"no example of {name}: {said[-2000:]}")
        for case, outcome, words in lines[1:]:
            found.add(int(case), outcome, words)
        first = int(lines[-1][0]) + 1
        if first < cases:
            found.add(first, "ended", f"exit code {process.exitcode}: {said[-300:]}")
            first += 1
    return found


def work(name: str, cases: range, seed: int, told: str) -> None:
    """Run cases; told: the file for a line on each, and for what libraries print."""
    from tests.hostile.broken import Example
    from tests.hostile.readers import READERS

    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    printed = os.open(told, os.O_WRONLY | os.O_APPEND)
    os.dup2(printed, 1)
    os.dup2(printed, 2)
    with tempfile.TemporaryDirectory() as folder:
        example = Example(READERS[name], Path(folder))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * os.sysconf("SC_PAGE_SIZE") + MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        print(f"\nCASE {cases[0] - 1} begun", flush=True)
        for case in cases:
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            outcome, said = _outcome(example, random.Random(f"{name} {seed} {case}"))
            signal.setitimer(signal.ITIMER_PROF, 0)
            print(f"\nCASE {case} {outcome} {said!r}", flush=True)


def _outcome(example: object, chance: random.Random) -> tuple[str, str]:
    from analysis.console.failures import BAD_INPUT, NO_MEMORY, describe

    try:
        example.case(chance)  # pyright: ignore[reportAttributeAccessIssue]
    except AssertionError as error:
        ours = "tests/hostile" in traceback.extract_tb(error.__traceback__)[-1].filename
        return ("wrong", str(error).strip()[:200]) if ours else ("traceback", _where(error))
    except Exception as error:
        code, _ = describe(error)
        return ("clean", "") if code == BAD_INPUT else ("memory" if code == NO_MEMORY else "traceback", _where(error))
    return "harmless", ""


def _where(error: BaseException) -> str:
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if str(ROOT) in frame.filename]
    place = f"{Path(frames[-1].filename).relative_to(ROOT)}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__} at {place}: {' '.join(str(error).split())[:200]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readers", nargs="*")
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if find_spec("pytest") is None:
        parser.error(
            "expected the developers' tools, found no pytest; pip install -e '.[dev]', or make test, brings them"
        )
    from tests.hostile.readers import READERS

    bad = 0
    for name in options.readers or READERS:
        start = time.monotonic()
        found = fuzzed(name, options.cases, options.seed)
        counts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(found.outcomes.items()))
        print(f"{name}: {counts} in {time.monotonic() - start:,.0f} s", *found.failures[:20], sep="\n    ", flush=True)
        bad += len(found.failures)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
