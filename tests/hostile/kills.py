"""Commands that are killed, or sent a signal, at a random moment: `python -m tests.hostile.kills [--rounds 50] [COMMAND ...]`.

Each round begins a command in a process of its own and ends it.  What lies there then must be whole: nothing, what was there
before, or what a command writes.  The same command is then run to its end, and its numbers must be the bits of one that nobody
ended.  A signal ends a command that listens with 128 + its number, or 0 where it had come to its end.  A process is a fork of
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
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.hostile.commands import COMMANDS
from tests.hostile.ended import Ended, attempts

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def attack(name: str, rounds: int, seed: int, minutes: float) -> list[str]:
    """So many kills and as many signals, or as many as there is time for; what went wrong."""
    end = time.monotonic() + 60 * minutes

    def trials(command: Ended) -> Iterator[tuple[str, Callable[[], str]]]:
        for round in range(2 * rounds):
            if time.monotonic() > end:
                return
            chance = random.Random(f"{name} {seed} {round}")
            number = signal.SIGKILL if round % 2 else chance.choice(SIGNALS)
            words = f"round {round}, {signal.Signals(number).name}"
            yield words, partial(_ended, command, chance, number)

    with tempfile.TemporaryDirectory() as folder:
        command = COMMANDS[name](Path(folder))
        print(f"{name}: {command.seconds:.1f} s unended", flush=True)
        return attempts(name, trials(command))


def _ended(command: Ended, chance: random.Random, number: int) -> str:
    return f"{'kill' if number == signal.SIGKILL else 'signal'}: {command.round(chance, number)}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commands", nargs="*", default=[*COMMANDS])
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=math.inf, help="for each command")
    options = parser.parse_args()
    failures = [attack(name, options.rounds, options.seed, options.minutes) for name in options.commands]
    sys.exit(any(map(bool, failures)))
