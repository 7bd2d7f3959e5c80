"""Commands that are killed, or sent a signal, at a random moment: `python -m tests.hostile.kills [--rounds 50] [COMMAND ...]`.

Each round begins a command in a process of its own and ends it.  What lies there then must be whole: nothing, what was there
before, or what a command writes.  The same command is then run to its end, and its numbers must be the bits of one that nobody
ended.  After signals the exit code is 128 + the number, or 0 where the command had come to its end.  A process is a fork of
this one, in which everything is imported but nothing has been run, and which draws no pictures; every fifth is a program of
its own, which does.
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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

import torch

import splat.raster.cpu.raster  # noqa: F401
from analysis.commands.cli import main
from analysis.commands.map import command as _map  # noqa: F401
from analysis.console import drawing, recording
from analysis.console.interruption import ignored, raising
from analysis.records.records import ProbeRecord, SliceRecord, read_record
from analysis.records.run_files import MapRecord
from splat.model.files.read import read_splats
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, training_state

ROOT = Path(__file__).parents[2]
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
CHANGING = ("second", "provenance", "timing", "created", "skipped")  # in the names of what no two runs have alike
TRAINED = 6  # steps of the run that others read
Numbers = dict[str, str]  # what was found, in words, by its name


class Ended:
    """A command on a tiny scene in `root`, and what it comes to when nobody ends it."""

    name: ClassVar[str]
    apart = 0.2  # share of the rounds that run a program of its own

    def __init__(self, root: Path) -> None:
        self.out, self.scene, self.checkpoint = root / "work" / "out", root / "scene", root / "run" / "checkpoint.pt"
        self.out.parent.mkdir(parents=True)
        settings = SyntheticSettings(gaussians=60, views=5, width=24, height=18)
        assert forked(lambda: write_transforms_scene(synthetic_scene(settings).scene, self.scene) or 0).wait() == 0
        train = ["train", str(self.scene), "--out", str(self.checkpoint.parent), "--iterations", str(TRAINED)]
        assert forked(lambda: main(train)).wait() == 0
        self.run_to_its_end()  # compiles
        self.clean()
        start = time.monotonic()
        self.run_to_its_end()
        self.seconds, self.expected = time.monotonic() - start, self.numbers()

    def words(self) -> list[str]:
        raise NotImplementedError

    def numbers(self) -> Numbers:
        """All that does not depend on the time.  InputError where the result is not whole."""
        raise NotImplementedError

    def run_to_its_end(self) -> None:
        if (code := self.begun().wait()) != 0:
            raise AssertionError(f"the same command again ends with {code}")

    def begun(self) -> "forked":
        return forked(lambda: main(self.words()))

    def clean(self) -> None:
        shutil.rmtree(self.out.parent)
        self.out.parent.mkdir()

    def prepare(self, chance: random.Random) -> None:
        """What is there before: nothing, or what the command wrote before."""
        if chance.random() < 0.5:
            self.clean()

    def round(self, chance: random.Random, number: int) -> str:
        """End the command once and go on; what became of it."""
        self.prepare(chance)
        before, apart = self.out.exists(), chance.random() < self.apart
        process = program(self.words()) if apart else self.begun()
        time.sleep(chance.random() * (self.seconds + 3 * apart))
        process.send(number)
        code = process.wait()
        allowed = {-9, 0} if number == signal.SIGKILL else {128 + number, 0} | ({-number} if apart else set())
        assert code in allowed, f"exit code {code}"
        aside = self.out.with_name(f".{self.out.name}.previous")
        assert not before or self.out.exists() or (number == signal.SIGKILL and aside.exists()), (
            "what was there is gone"
        )
        if self.out.exists():
            self.check()
        self.run_to_its_end()
        self.require_expected("after the same command again")
        assert (left := sorted(path.name for path in self.out.parent.iterdir())) == ["out"], f"left: {left}"
        return "had ended" if code == 0 else "ended and went on to the same bits"

    def check(self) -> None:
        """What lies there although the command did not come to its end must be whole."""
        self.require_expected("as it was left")

    def require_expected(self, when: str) -> None:
        found = self.numbers()
        changed = [name for name in {**found, **self.expected} if found.get(name) != self.expected.get(name)]
        shown = [f"{name} {found.get(name, '')[:30]} for {self.expected.get(name, '')[:30]}" for name in changed[:4]]
        assert not changed, f"{len(changed)} other numbers {when}: {', '.join(shown)}"


class Train(Ended):
    name = "train"

    def words(self) -> list[str]:
        more = ["--resume"] if self.out.exists() else []
        return [
            "train",
            str(self.scene),
            "--iterations",
            "20",
            "--checkpoint-every",
            "2",
            "--out",
            str(self.out),
            *more,
        ]

    def numbers(self) -> Numbers:
        return trained(self.out)

    def prepare(self, chance: random.Random) -> None:
        self.clean()

    def check(self) -> None:
        load_checkpoint(self.out / "checkpoint.pt")


class Probe(Ended):
    name = "probe"

    def words(self) -> list[str]:
        return ["probe", str(self.checkpoint), "--quick", "--slice-points", "5", "--out", str(self.out)]

    def numbers(self) -> Numbers:
        return recorded(self.out, ProbeRecord)


class Slice(Ended):
    name = "slice"

    def words(self) -> list[str]:
        return ["slice", str(self.checkpoint), "--points", "9", "--all-points", "--out", str(self.out)]

    def numbers(self) -> Numbers:
        found = recorded(self.out, SliceRecord)
        return {name: value for name, value in found.items() if name != ".counts.products"}  # of the last run alone


class Map(Ended):
    name = "map"

    def words(self) -> list[str]:
        return ["map", str(self.checkpoint), "--out", str(self.out)]

    def numbers(self) -> Numbers:
        found = {name: digest((self.out / name).read_bytes()) for name in ("fields.ply", "largest.ply", "top.csv")}
        return found | leaves(json.loads((self.out / MapRecord.FILE).read_text()))


class Convert(Ended):
    name = "convert"

    def words(self) -> list[str]:
        return ["convert", str(self.checkpoint), str(self.out), "--to", "graphdeco"]

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.seconds = max(self.seconds, 0.05)

    def numbers(self) -> Numbers:
        return {"file": digest(self.out.read_bytes()), "n": str(len(read_splats(self.out).gaussians))}

    def prepare(self, chance: random.Random) -> None:
        self.clean()

    def run_to_its_end(self) -> None:
        if not self.out.exists():  # which it refuses
            super().run_to_its_end()


class Sweep(Ended):
    """Its commands are programs of their own, which a kill leaves at work."""

    name = "sweep"

    def words(self) -> list[str]:
        file = self.scene.with_name("sweep.toml")
        file.write_text(
            f'out = "work/out"\nseeds = [0]\niterations = {TRAINED}\n[probe]\nquick = true\nslice_points = 5\n'
            f'[scenes.tiny]\npath = "{self.scene}"\n[methods.3dgs]\n'
        )
        return ["sweep", str(file)]

    def numbers(self) -> Numbers:
        run = self.out / "tiny/3dgs/0"
        return trained(run) | recorded(run / "probe", ProbeRecord)

    def prepare(self, chance: random.Random) -> None:
        self.clean()

    def run_to_its_end(self) -> None:
        end = time.monotonic() + 600
        while (code := self.begun().wait()) == 2 and time.monotonic() < end:  # another is at work
            time.sleep(1)
        assert code == 0, f"the same command again ends with {code}"

    def check(self) -> None:
        for checkpoint in self.out.rglob("checkpoint.pt"):
            load_checkpoint(checkpoint)
        for record in self.out.rglob(ProbeRecord.FILE):
            if not record.parent.name.startswith("."):
                read_record(record.parent, ProbeRecord)


COMMANDS: dict[str, type[Ended]] = {each.name: each for each in (Train, Probe, Slice, Map, Convert, Sweep)}


def digest(content: bytes) -> str:
    return sha256(content).hexdigest()


def trained(run: Path) -> Numbers:
    buffer = io.BytesIO()
    torch.save(training_state(load_checkpoint(run / "checkpoint.pt").training), buffer)
    return {"training": digest(buffer.getvalue())}


def recorded(folder: Path, kind: Any) -> Numbers:
    record = read_record(folder, kind)
    arrays = {
        f"{group}.{name}": f"{array.shape} {digest(array.tobytes())}"
        for group, arrays in record.arrays.items()
        for name, array in arrays.items()
    }
    return arrays | leaves(json.loads((folder / kind.FILE).read_text()))


def leaves(tree: Any, name: str = "") -> Numbers:
    if isinstance(tree, dict):
        kept = {key: value for key, value in tree.items() if not any(each in key for each in CHANGING)}
        return {k: v for key, value in kept.items() for k, v in leaves(value, f"{name}.{key}").items()}
    if isinstance(tree, list):
        return {k: v for i, value in enumerate(tree) for k, v in leaves(value, f"{name}[{i}]").items()}
    return {name: repr(tree)}


@contextmanager
def nothing_drawn(*_: Any) -> Iterator[Callable[[Path], list[str]]]:
    yield lambda _: []


class forked:
    """A fork that runs a function, quietly and without pictures, and ends with what it returns.  Its signals raise by then."""

    def __init__(self, run: Callable[[], int]) -> None:
        ready, begun = os.pipe()
        self.process = os.fork()
        if self.process == 0:
            drawing.drawing, recording.draw = nothing_drawn, lambda *_: []
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            code = 70
            try:
                with raising():
                    os.write(begun, b".")
                    code = run()
                    with ignored():
                        os._exit(code)
            finally:
                os._exit(code)
        os.close(begun)
        os.read(ready, 1)
        os.close(ready)

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
