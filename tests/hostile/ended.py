"""Commands on a tiny scene that somebody ends at a random moment, and what they come to when nobody does."""

import io
import json
import random
import shutil
import signal
import time
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

import torch

from analysis.commands import cli
from analysis.records.records import read_record
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, training_state
from tests.hostile.programs import forked, program

CHANGING = ("second", "provenance", "timing", "created")  # in the names of what no two runs have alike
TRAINED = 6  # steps of the run that others read
Numbers = dict[str, str]  # what was found, in words, by its name


class Ended:
    """A command on a tiny scene in `root`, and what it comes to when nobody ends it."""

    name: ClassVar[str]
    typed: str  # with {scene}, {checkpoint} and {run} that it reads, {other} and {file} beside them, and {out}
    content = ""  # of the file
    module: Any = cli  # whose `main` it is
    apart = 0.2  # share of the rounds that run a program of its own
    goes_on = False  # from files in `out`, which are replaced one by one
    fresh = False  # whether each round begins with nothing
    least = 0.0  # seconds

    def __init__(self, root: Path) -> None:
        self.out, self.scene, self.checkpoint = root / "work" / "out", root / "scene", root / "run" / "checkpoint.pt"
        self.out.parent.mkdir(parents=True)
        self.made_before()
        self.run_to_its_end()  # compiles
        self.clean()
        start = time.monotonic()
        self.run_to_its_end()
        self.seconds, self.expected = max(time.monotonic() - start, self.least), self.numbers()

    def made_before(self) -> None:
        """The scene, the run and the file that the command reads."""
        settings = SyntheticSettings(gaussians=60, views=5, width=24, height=18)
        assert forked(lambda: write_transforms_scene(synthetic_scene(settings).scene, self.scene) or 0).wait() == 0
        self.typed_as(f"train {{scene}} --out {{run}} --iterations {TRAINED}")
        self.scene.with_name("file.toml").write_text(self.content)

    def typed_as(self, words: str) -> None:
        assert forked(lambda: cli.main(self.filled(words))).wait() == 0

    def filled(self, words: str) -> list[str]:
        root = self.scene.parent
        names = {"run": root / "run", "other": root / "other", "file": root / "file.toml"}
        return words.format(scene=self.scene, checkpoint=self.checkpoint, out=self.out, **names).split()

    def words(self) -> list[str]:
        return self.filled(self.typed)

    def numbers(self) -> Numbers:
        """All that does not depend on the time.  InputError where the result is not whole."""
        raise NotImplementedError

    def run_to_its_end(self) -> None:
        if (code := self.begun().wait()) != 0:
            raise AssertionError(f"the same command again ends with {code}")

    def begun(self) -> "forked":
        return forked(lambda: self.module.main(self.words()))

    def clean(self) -> None:
        shutil.rmtree(self.out.parent)
        self.out.parent.mkdir()

    def prepare(self, chance: random.Random) -> None:
        """What is there before: nothing, or what the command wrote before."""
        if self.fresh or chance.random() < 0.5:
            self.clean()

    def round(self, chance: random.Random, number: int) -> str:
        """End the command once and go on; what became of it."""
        self.prepare(chance)
        before, apart = self.out.exists(), chance.random() < self.apart
        process = program(self.words(), self.module.__name__) if apart else self.begun()
        time.sleep(chance.random() * (self.seconds + 3 * apart))
        process.send_signal(number)
        code = process.wait()
        allowed = {-number, 0} if number == signal.SIGKILL else {-number, 128 + number, 0}
        assert code in allowed, f"exit code {code}"
        aside = self.out.with_name(f".{self.out.name}.previous")
        assert not before or self.out.exists() or (number == signal.SIGKILL and aside.exists()), "nothing is left"
        if self.out.exists():
            self.check()
        self.run_to_its_end()
        self.require_expected("after the same command again")
        assert (left := sorted(path.name for path in self.out.parent.iterdir())) == ["out"], f"left: {left}"
        return f"{signal.Signals(number).name}: " + ("had ended" if code == 0 else "ended and went on to the same bits")

    def check(self) -> None:
        """What lies there although the command did not come to its end must be whole."""
        self.require_expected("as it was left")

    def require_expected(self, when: str) -> None:
        found = self.numbers()
        changed = [name for name in {**found, **self.expected} if found.get(name) != self.expected.get(name)]
        shown = [f"{name} {found.get(name, '')[:30]} for {self.expected.get(name, '')[:30]}" for name in changed[:4]]
        assert not changed, f"{len(changed)} other numbers {when}: {', '.join(shown)}"


def bytes_of(folder: Path, *names: str) -> Numbers:
    return {name: digest((folder / name).read_bytes()) for name in names}


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
