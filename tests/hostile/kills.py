"""Commands that are killed, or sent a signal, at a random moment: `python -m tests.hostile.kills [--rounds 50] [COMMAND ...]`.

Each round begins a command in a process of its own and ends it.  What lies there then must be whole: nothing, what was there
before, or what a command writes.  The same command is then run to its end, and its numbers must be the bits of one that nobody
ended.  After signals the exit code is 128 + the number, or 0 where the command had come to its end.  A process is a fork of
this one, in which everything is imported but nothing has been run; every fifth is a program of its own.
"""

import argparse
import io
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

import splat.raster.cpu.raster  # noqa: F401
from analysis.commands.cli import main
from analysis.records.records import ProbeRecord, SliceRecord, read_record
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, training_state

ROOT = Path(__file__).parents[2]
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
CHANGING = ("second", "provenance", "timing", "created", "skipped")  # in the names of what no two runs have alike


class Ended:
    """A command on a tiny scene in `root`, and what it comes to when nobody ends it."""

    def __init__(self, name: str, root: Path) -> None:
        self.name, self.root, self.out = name, root, root / "work" / "out"
        self.scene, run = root / "scene", root / "run"
        self.out.parent.mkdir(parents=True)
        settings = SyntheticSettings(gaussians=60, views=5, width=24, height=18)
        if forked(lambda: write_transforms_scene(synthetic_scene(settings).scene, self.scene) or 0).wait() != 0:
            raise SystemExit("no scene")
        if (
            name != "train"
            and forked(lambda: main(["train", str(self.scene), "--out", str(run), "--iterations", "6"])).wait()
        ):
            raise SystemExit("no run")
        checkpoint = str(run / "checkpoint.pt")
        self.words = {
            "train": ["train", str(self.scene), "--iterations", "20", "--checkpoint-every", "2"],
            "probe": ["probe", checkpoint, "--quick"],
            "slice": ["slice", checkpoint, "--points", "9", "--all-points"],
        }[name] + ["--out", str(self.out)]
        self.run_to_its_end()  # compiles
        self.clean()
        start = time.monotonic()
        self.run_to_its_end()
        self.seconds, self.expected = time.monotonic() - start, self.numbers()

    def run_to_its_end(self) -> None:
        more = ["--resume"] if self.name == "train" and self.out.exists() else []
        if (code := forked(lambda: main([*self.words, *more])).wait()) != 0:
            raise AssertionError(f"the same command again ends with {code}")

    def numbers(self) -> str:
        """A digest of all that does not depend on the time; AssertionError or InputError where the result is not whole."""
        digest = sha256()
        if self.name == "train":
            buffer = io.BytesIO()
            torch.save(training_state(load_checkpoint(self.out / "checkpoint.pt").training), buffer)
            return sha256(buffer.getvalue()).hexdigest()
        record = read_record(self.out, ProbeRecord if self.name == "probe" else SliceRecord)
        for group, arrays in sorted(record.arrays.items()):
            for name, array in sorted(arrays.items()):
                digest.update(f"{group} {name} {array.shape}".encode() + array.tobytes())
        digest.update(json.dumps(steady(json.loads((self.out / record.data.FILE).read_text()))).encode())
        return digest.hexdigest()

    def clean(self) -> None:
        shutil.rmtree(self.out.parent)
        self.out.parent.mkdir()

    def round(self, chance: random.Random, number: int) -> str:
        """End the command once and go on; what became of it."""
        self.clean()
        apart = chance.random() < 0.2
        process = program(self.words) if apart else forked(lambda: main(self.words))
        time.sleep(chance.random() * (self.seconds + 3 * apart))
        process.send(number)
        code = process.wait()
        allowed = {-9, 0} if number == signal.SIGKILL else {128 + number, 0} | ({-number} if apart else set())
        assert code in allowed, f"exit code {code}"
        if self.out.exists():
            if self.name == "train":
                load_checkpoint(self.out / "checkpoint.pt")
            else:
                assert self.numbers() == self.expected, "a record of other numbers"
        self.run_to_its_end()
        assert self.numbers() == self.expected, "other numbers"
        assert (left := sorted(path.name for path in self.out.parent.iterdir())) == ["out"], f"left: {left}"
        return "had ended" if code == 0 else "ended and went on to the same bits"


def steady(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: steady(value) for key, value in sorted(tree.items()) if not any(each in key for each in CHANGING)}
    return [steady(value) for value in tree] if isinstance(tree, list) else tree


class forked:
    """A fork that runs a function, quietly, and ends with what it returns."""

    def __init__(self, run: Any) -> None:
        self.process = os.fork()
        if self.process == 0:
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            code = 70
            try:
                code = run()
            finally:
                os._exit(code)

    def send(self, number: int) -> None:
        os.kill(self.process, number)

    def wait(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])


class program:
    """The command as a program of its own."""

    def __init__(self, words: list[str]) -> None:
        command = [sys.executable, "-m", "analysis.commands.cli", *words]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def wait(self) -> int:
        return self.process.wait()


def attack(name: str, rounds: int, seed: int, minutes: float) -> list[str]:
    """So many kills and as many signals, or as many as there is time for; what went wrong."""
    outcomes, failures, end = Counter[str](), list[str](), time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory() as folder:
        command = Ended(name, Path(folder))
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
    parser.add_argument("commands", nargs="*", default=["train", "probe", "slice"])
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=math.inf, help="for each command")
    options = parser.parse_args()
    failures = [attack(name, options.rounds, options.seed, options.minutes) for name in options.commands]
    sys.exit(any(failures))
