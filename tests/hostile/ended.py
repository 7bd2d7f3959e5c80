"""Commands on a tiny scene that somebody ends at a random moment, and what they come to when nobody does."""

import io
import json
import random
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

import torch

from analysis.commands import cli
from analysis.commands.uses.next_view import RECORD as NEXT
from analysis.commands.uses.prune import RECORD
from analysis.commands.uses.uncertainty import RECORD as UNCERTAINTY
from analysis.records.records import ProbeRecord, SliceRecord, read_record
from analysis.records.run_files import COMPARISON, MapRecord
from analysis.runs.compare import PAGE, TABLE
from figures import paper
from splat.model.files.read import read_splats
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, training_state
from tests.hostile.programs import forked, program

CHANGING = ("second", "provenance", "timing", "created", "skipped")  # in the names of what no two runs have alike
TRAINED = 6  # steps of the run that others read
SHOWN = 50  # trials after which the counts are printed
Numbers = dict[str, str]  # what was found, in words, by its name


def attempts(name: str, trials: Iterable[tuple[str, Callable[[], str]]]) -> list[str]:
    """Try each, which says what became of it, and print how many went which way; what went wrong, by the words of the trial."""
    outcomes, failures, start = Counter[str](), list[str](), time.monotonic()

    def show() -> None:
        done = f"{outcomes.total() + len(failures)} in {time.monotonic() - start:,.0f} s"
        print(f"{name}: {done}: {dict(outcomes)}, {len(failures)} failures", flush=True)

    for number, (words, trial) in enumerate(trials, 1):
        try:
            outcomes[trial()] += 1
        except Exception as error:  # whatever it is, it is what is looked for
            failures.append(f"{name}, {words}: {type(error).__name__} {error}")
            print(failures[-1], flush=True)
        if number % SHOWN == 0:
            show()
    show()
    return failures


class Ended:
    """A command on a tiny scene in `root`, and what it comes to when nobody ends it."""

    name: ClassVar[str]
    module = cli  # whose `main` it is
    apart = 0.2  # share of the rounds that run a program of its own
    goes_on = False  # from files in `out`, which are replaced one by one

    def __init__(self, root: Path) -> None:
        self.out, self.scene, self.checkpoint = root / "work" / "out", root / "scene", root / "run" / "checkpoint.pt"
        self.out.parent.mkdir(parents=True)
        self.made_before()
        self.run_to_its_end()  # compiles
        self.clean()
        start = time.monotonic()
        self.run_to_its_end()
        self.seconds, self.expected = time.monotonic() - start, self.numbers()

    def made_before(self) -> None:
        """The scene and the run that the command reads."""
        settings = SyntheticSettings(gaussians=60, views=5, width=24, height=18)
        assert forked(lambda: write_transforms_scene(synthetic_scene(settings).scene, self.scene) or 0).wait() == 0
        train = ["train", str(self.scene), "--out", str(self.checkpoint.parent), "--iterations", str(TRAINED)]
        assert forked(lambda: cli.main(train)).wait() == 0

    def words(self) -> list[str]:
        raise NotImplementedError

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
        if chance.random() < 0.5:
            self.clean()

    def round(self, chance: random.Random, number: int) -> str:
        """End the command once and go on; what became of it."""
        self.prepare(chance)
        before, apart = self.out.exists(), chance.random() < self.apart
        process = program(self.words(), self.module.__name__) if apart else self.begun()
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
    name, goes_on = "train", True

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
        told = leaves(json.loads((self.out / MapRecord.FILE).read_text()))
        return told | bytes_of(self.out, "fields.ply", "largest.ply", "top.csv")


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


class Prune(Ended):
    name = "prune"

    def words(self) -> list[str]:
        return ["prune", str(self.checkpoint), "--sample", "10", "--out", str(self.out)]

    def numbers(self) -> Numbers:
        json.loads((self.out / RECORD).read_text())
        return bytes_of(self.out, "scores.csv", "correlations.csv", "pruned.ply") | trained(self.out)


class NextView(Ended):
    name = "next-view"

    def words(self) -> list[str]:
        return ["next-view", str(self.checkpoint), "--out", str(self.out)]

    def numbers(self) -> Numbers:
        return leaves(json.loads((self.out / NEXT).read_text())) | bytes_of(self.out, "gains.csv")


class Uncertainty(Ended):
    name = "uncertainty"

    def words(self) -> list[str]:
        return ["uncertainty", str(self.checkpoint), "--out", str(self.out)]

    def numbers(self) -> Numbers:
        told = leaves(json.loads((self.out / UNCERTAINTY).read_text()))
        return told | bytes_of(self.out, "agreement.csv", "view-000.npz")


class Files(Ended):
    """Replaces each file whole, not the folder.  files: some of them, which have the same bytes each time."""

    files: tuple[str, ...]

    def numbers(self) -> Numbers:
        found = bytes_of(self.out, *(name for name in self.files if (self.out / name).exists()))
        assert all(
            (self.out / name).read_text().rstrip().endswith("</html>") for name in found if name.endswith("html")
        )
        return found

    def check(self) -> None:
        found = self.numbers()
        changed = [name for name in found if found[name] != self.expected[name]]
        assert not changed, f"other content of {changed} as it was left"


class NextStudy(Files):
    """Goes on from the cells that there are."""

    name, files = "next-view-study", ("study.csv", "cells/tiny-d-0.json", "cells/tiny-random-0.json")

    def words(self) -> list[str]:
        file = self.scene.with_name("study.toml")
        file.write_text(
            'out = "work/out"\nrules = ["d", "random"]\nseeds = [0]\nrounds = 1\nfirst_steps = 4\nsteps = 2\n'
            f'[scenes.tiny]\npath = "{self.scene}"\n'
        )
        return ["next-view", str(file)]


class Compare(Files):
    name, files = "compare", (TABLE, COMPARISON, PAGE)

    def __init__(self, root: Path) -> None:
        self.runs = [root / "run", root / "other"]
        super().__init__(root)

    def made_before(self) -> None:
        super().made_before()
        train = ["train", str(self.scene), "--out", str(self.runs[1]), "--iterations", str(TRAINED), "--seed", "1"]
        assert forked(lambda: cli.main(train)).wait() == 0
        for run in self.runs:
            probe = ["probe", str(run), "--quick", "--slice-points", "5", "--out", str(run / "probe")]
            assert forked(lambda words=probe: cli.main(words)).wait() == 0

    def words(self) -> list[str]:
        return ["compare", *map(str, self.runs), "--out", str(self.out)]


class Trajectory(Files):
    name, files = "trajectory", ("trajectories.csv",)

    def made_before(self) -> None:
        super().made_before()
        out, steps = ["--out", str(self.checkpoint.parent)], ["--iterations", "4", "--probe-every", "2"]
        shutil.rmtree(self.checkpoint.parent)
        train = ["train", str(self.scene), *out, *steps, "--probe-share", "inf"]
        assert forked(lambda: cli.main(train)).wait() == 0

    def words(self) -> list[str]:
        return ["trajectory", str(self.checkpoint.parent), "--out", str(self.out)]


class Claims(Files):
    name, files = "claims", ("study.csv", "claims.csv", "predictors.csv", "claims.json")

    def words(self) -> list[str]:
        return ["claims", str(paper.RESULTS / "study.csv"), "--out", str(self.out)]


class Paper(Files):
    """`python -m figures.paper`; its PDFs hold the time."""

    name, module, files = (
        "figures.paper",
        paper,
        ("claims.png", "predictors.png", "budget.png", "axes.png", "captions.md"),
    )

    def words(self) -> list[str]:
        return ["--out", str(self.out)]


KINDS = (
    Train,
    Probe,
    Slice,
    Map,
    Convert,
    Sweep,
    Prune,
    NextView,
    NextStudy,
    Uncertainty,
    Compare,
    Trajectory,
    Claims,
    Paper,
)
COMMANDS: dict[str, type[Ended]] = {each.name: each for each in KINDS}


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
