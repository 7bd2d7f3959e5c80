"""Commands that are killed, or sent a signal, at a random moment: `python -m tests.hostile.kills [--rounds 50] [COMMAND ...]`.

Each round begins a command in a process of its own and ends it.  What lies there then must be whole: nothing, what was there
before, or what a command writes.  The same command is then run to its end, and its numbers must be the bits of one that nobody
ended.  A signal ends a command that listens with 128 + its number, or 0 where it had come to its end.  A process is a fork of
this one, in which everything is imported but nothing has been run, and which draws no pictures; every fifth is a program of
its own, which does.
"""

import random
import signal
import sys
from collections.abc import Iterator
from functools import partial

from tests.hostile.commands import COMMANDS, Trial, attacked
from tests.hostile.ended import Ended

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def trials(command: Ended, rounds: int, seed: int) -> Iterator[Trial]:
    """So many kills and as many signals."""
    for round in range(2 * rounds):
        chance = random.Random(f"{command.name} {seed} {round}")
        number = signal.SIGKILL if round % 2 else chance.choice(SIGNALS)
        yield f"round {round}, {signal.Signals(number).name}", partial(command.round, chance, number)


if __name__ == "__main__":
    sys.exit(attacked(__doc__, trials, 50, *COMMANDS))
