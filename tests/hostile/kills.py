"""Commands that are killed, or sent a signal, at a random moment: `python -m tests.hostile.kills [--rounds 50] [COMMAND ...]`.

Each round begins a command in a process of its own and ends it.  What lies there then must be whole: nothing, what was there
before, or what a command writes.  The same command is then run to its end, and its numbers must be the bits of one that nobody
ended.  After signals the exit code is 128 + the number, or 0 where the command had come to its end.  A process is a fork of
this one, in which everything is imported but nothing has been run, and which draws no pictures; every fifth is a program of
its own, which does.
"""

import argparse
import math
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.hostile.ended import COMMANDS

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def attack(name: str, rounds: int, seed: int, minutes: float) -> list[str]:
    """So many kills and as many signals, or as many as there is time for; what went wrong."""
    outcomes, failures, end = Counter[str](), list[str](), time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory() as folder:
        command = COMMANDS[name](Path(folder))
        for round in range(2 * rounds):
            if time.monotonic() > end:
                break
            chance = random.Random(f"{name} {seed} {round}")
            number = signal.SIGKILL if round % 2 else chance.choice(SIGNALS)
            try:
                outcomes[f"{'kill' if round % 2 else 'signal'}: {command.round(chance, number)}"] += 1
            except Exception as error:  # whatever it is, it is what is looked for
                failures.append(f"{name}, round {round}, {signal.Signals(number).name}: {type(error).__name__} {error}")
                print(failures[-1], flush=True)
    print(f"{name}: {dict(outcomes)}, {len(failures)} failures; {command.seconds:.1f} s unended", flush=True)
    return failures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commands", nargs="*", default=[*COMMANDS])
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=math.inf, help="for each command")
    options = parser.parse_args()
    failures = [attack(name, options.rounds, options.seed, options.minutes) for name in options.commands]
    sys.exit(any(map(bool, failures)))
