"""Two processes at one folder: `python -m tests.hostile.races [--rounds 1000] [COMMAND ...]`.

Each round begins a command twice, at nearly the same moment; half of those of a training go on from one that was interrupted,
and its checkpoint is read while they are at work.  At least one must come to its end; who does not, with exit code 2, must
say why in one sentence.  The numbers in the end must be the bits of one that was alone.
"""

import random
import signal
import sys
import time
from collections.abc import Iterator
from functools import partial

from tests.hostile.commands import Trial, attacked
from tests.hostile.ended import Ended
from tests.hostile.programs import forked

BAD_INPUT = 2


def race(command: Ended, chance: random.Random) -> str:
    """What became of the two."""
    command.prepare(chance)
    if command.goes_on and chance.random() < 0.5:
        before = command.begun()
        time.sleep(chance.random() * command.seconds)
        before.send_signal(signal.SIGTERM)
        before.wait()
    said = [command.scene.with_name(name) for name in ("first", "second")]
    words = command.words()
    first = forked(lambda: command.module.main(words), said[0])
    late = (0, 0.01, 0.1, chance.random() * command.seconds, chance.uniform(0.9, 1.1) * command.seconds)
    time.sleep(chance.choice(late))
    second = forked(lambda: command.module.main(words), said[1])
    both, codes = [first, second], dict[int, int]()
    while len(codes) < 2:
        for i, process in enumerate(both):
            if i not in codes and (code := process.poll()) is not None:
                codes[i] = code
        if command.goes_on and command.out.exists():  # else a folder is replaced, whose files a reader may lose
            command.check()
        time.sleep(0.02)
    lost = [i for i, code in codes.items() if code]
    for i in lost:
        text = said[i].read_text()
        assert codes[i] == BAD_INPUT, f"exit code {codes[i]}: {text[-300:]}"
        assert text.count("landscape:") == 1 and "expected" in text.rsplit("landscape:")[-1], text[-300:]
    assert len(lost) < 2, f"both lost: {[path.read_text()[-300:] for path in said]}"
    command.require_expected("after a race")
    assert (left := sorted(path.name for path in command.out.parent.iterdir())) == ["out"], f"left: {left}"
    return "one was refused" if lost else "both did it, one after the other"


def trials(command: Ended, rounds: int, seed: int) -> Iterator[Trial]:
    for round in range(rounds):
        yield f"round {round}", partial(race, command, random.Random(f"race {command.name} {seed} {round}"))


if __name__ == "__main__":
    sys.exit(attacked(__doc__, trials, 1000, "train"))
