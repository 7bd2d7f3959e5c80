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
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.hostile.commands import COMMANDS
from tests.hostile.ended import Ended, attacked, attempts

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def attack(name: str, rounds: int, seed: int) -> list[str]:
    """So many kills and as many signals; what went wrong."""

    def trials(command: Ended) -> Iterator[tuple[str, Callable[[], str]]]:
        for round in range(2 * rounds):
            chance = random.Random(f"{name} {seed} {round}")
            number = signal.SIGKILL if round % 2 else chance.choice(SIGNALS)
            yield f"round {round}, {signal.Signals(number).name}", partial(_ended, command, chance, number)

    with tempfile.TemporaryDirectory() as folder:
        command = COMMANDS[name](Path(folder))
        print(f"{name}: {command.seconds:.1f} s unended", flush=True)
        return attempts(name, trials(command))


def _ended(command: Ended, chance: random.Random, number: int) -> str:
    return f"{'kill' if number == signal.SIGKILL else 'signal'}: {command.round(chance, number)}"


if __name__ == "__main__":
    sys.exit(attacked(__doc__, attack, [*COMMANDS], 50))
