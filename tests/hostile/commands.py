"""The commands that write files, on a tiny scene: what is typed, the numbers they come to, and a program that attacks them."""

import argparse
import json
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from analysis.commands.uses.next_view import RECORD as NEXT
from analysis.commands.uses.prune import RECORD
from analysis.commands.uses.uncertainty import RECORD as UNCERTAINTY
from analysis.records.records import ProbeRecord, SliceRecord, read_record
from analysis.records.run_files import COMPARISON, MapRecord
from analysis.runs.compare import PAGE, TABLE
from analysis.runs.sweep.sweep import CELLS_ELSEWHERE
from notebooks.paper import __main__ as paper
from notebooks.uses import __main__ as uses
from splat.model.files.read import read_splats
from splat.training.checkpoint import load_checkpoint
from tests.hostile.ended import TRAINED, Ended, Numbers, bytes_of, digest, leaves, recorded, trained

SHOWN = 50  # trials after which the counts are printed
Trial = tuple[str, Callable[[], str]]  # with words on which it is
QUICK = "probe {} --quick --slice-points 5 --out {}"


def written(name: str, words: str, numbers: Callable[[Path], Numbers]) -> type[Ended]:
    """A command that replaces the folder `out`; numbers: what it came to there."""
    return type(name, (Ended,), {"name": name, "typed": words, "numbers": lambda self: numbers(self.out)})


def told(file: str, *files: str) -> Callable[[Path], Numbers]:
    """What a record in JSON says, and the bytes of the files beside it."""
    return lambda out: leaves(json.loads((out / file).read_text())) | bytes_of(out, *files)


def sliced(out: Path) -> Numbers:
    found = recorded(out, SliceRecord)
    return {name: value for name, value in found.items() if name != ".counts.products"}  # of the last run alone


def pruned(out: Path) -> Numbers:
    json.loads((out / RECORD).read_text())
    return bytes_of(out, "scores.csv", "correlations.csv", "pruned.ply") | trained(out)


class Train(Ended):
    name, goes_on, fresh = "train", True, True
    typed = "train {scene} --iterations 20 --checkpoint-every 2 --out {out}"

    def words(self) -> list[str]:
        return [*super().words(), *(["--resume"] if self.out.exists() else [])]

    def numbers(self) -> Numbers:
        return trained(self.out)

    def check(self) -> None:
        load_checkpoint(self.out / "checkpoint.pt")


class Convert(Ended):
    name, typed, fresh, least = "convert", "convert {checkpoint} {out} --to graphdeco", True, 0.05

    def numbers(self) -> Numbers:
        return {"file": digest(self.out.read_bytes()), "n": str(len(read_splats(self.out).gaussians))}

    def run_to_its_end(self) -> None:
        if not self.out.exists():  # which it refuses
            super().run_to_its_end()


class Sweep(Ended):
    """Its commands are programs of their own, which a kill leaves at work."""

    name, typed, fresh = "sweep", "sweep {file}", True
    content = (
        f'out = "work/out"\nseeds = [0]\niterations = {TRAINED}\n[probe]\nquick = true\nslice_points = 5\n'
        '[scenes.tiny]\npath = "scene"\n[methods.3dgs]\n'
    )

    def numbers(self) -> Numbers:
        run = self.out / "tiny/3dgs/0"
        return trained(run) | recorded(run / "probe", ProbeRecord)

    def run_to_its_end(self) -> None:
        end = time.monotonic() + 600
        while (code := self.begun().wait()) == CELLS_ELSEWHERE and time.monotonic() < end:  # another is at work
            time.sleep(1)
        assert code == 0, f"the same command again ends with {code}"

    def check(self) -> None:
        for checkpoint in self.out.rglob("checkpoint.pt"):
            load_checkpoint(checkpoint)
        for record in self.out.rglob(ProbeRecord.FILE):
            if not record.parent.name.startswith("."):
                read_record(record.parent, ProbeRecord)


class Files(Ended):
    """Replaces each file whole, not the folder.  files: some of them, which have the same bytes each time."""

    files: tuple[str, ...]

    def numbers(self) -> Numbers:
        found = bytes_of(self.out, *(name for name in self.files if (self.out / name).exists()))
        pages = [(self.out / name).read_text() for name in found if name.endswith("html")]
        assert all(page.rstrip().endswith("</html>") for page in pages)
        return found

    def check(self) -> None:
        found = self.numbers()
        changed = [name for name in found if found[name] != self.expected[name]]
        assert not changed, f"other content of {changed} as it was left"


class NextStudy(Files):
    """Goes on from the cells that there are."""

    name, module, typed = "notebooks.uses", uses, "{file}"
    files = ("study.csv", "cells/tiny-d-0.json", "cells/tiny-random-0.json")
    content = (
        'out = "work/out"\nrules = ["d", "random"]\nseeds = [0]\nrounds = 1\nfirst_steps = 4\nsteps = 2\n'
        '[scenes.tiny]\npath = "scene"\n'
    )


class Compare(Files):
    name, files, typed = "compare", (TABLE, COMPARISON, PAGE), "compare {run} {other} --out {out}"

    def made_before(self) -> None:
        super().made_before()
        self.typed_as(f"train {{scene}} --out {{other}} --iterations {TRAINED} --seed 1")
        for run in ("{run}", "{other}"):
            self.typed_as(QUICK.format(run, f"{run}/probe"))

    def numbers(self) -> Numbers:
        """The page's without its pictures, which only programs draw."""
        found, pictures = super().numbers(), "<figure>.*?</figure>|<p>No pictures were drawn.</p>"
        if PAGE in found:
            page = re.sub(pictures, "", (self.out / PAGE).read_text(), flags=re.DOTALL)
            found[PAGE] = digest(page.encode())
        return found


class Trajectory(Files):
    name, files, typed = "trajectory", ("trajectories.csv",), "trajectory {run} --out {out}"

    def made_before(self) -> None:
        super().made_before()
        shutil.rmtree(self.checkpoint.parent)
        self.typed_as("train {scene} --out {run} --iterations 4 --probe-every 2")


class Paper(Files):
    """`python -m notebooks.paper`; its PDFs hold the time."""

    name, module, typed = "notebooks.paper", paper, "--out {out}"
    files = ("study.csv", "claims.csv", "predictors.csv", "claims.png", "budget.png", "axes.png", "captions.md")


KINDS = (
    Train,
    written("probe", QUICK.format("{checkpoint}", "{out}"), lambda out: recorded(out, ProbeRecord)),
    written("slice", "slice {checkpoint} --points 9 --all-points --out {out}", sliced),
    written("map", "map {checkpoint} --out {out}", told(MapRecord.FILE, "fields.ply", "largest.ply", "top.csv")),
    Convert,
    Sweep,
    written("prune", "prune {checkpoint} --sample 10 --out {out}", pruned),
    written("next-view", "next-view {checkpoint} --out {out}", told(NEXT, "gains.csv")),
    NextStudy,
    written("uncertainty", "uncertainty {checkpoint} --out {out}", told(UNCERTAINTY, "agreement.csv", "view-000.npz")),
    Compare,
    Trajectory,
    Paper,
)
COMMANDS: dict[str, type[Ended]] = {each.name: each for each in KINDS}


def attacked(about: str | None, trials: Callable[[Ended, int, int], Iterable[Trial]], rounds: int, *usual: str) -> int:
    """The program that attacks commands, the usual ones unless others are named, from a seed; 1 where something went wrong."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("commands", nargs="*", default=usual)
    parser.add_argument("--rounds", type=int, default=rounds)
    parser.add_argument("--seed", type=int, default=0)
    options, wrong = parser.parse_args(), 0
    for name in options.commands:
        with tempfile.TemporaryDirectory() as folder:
            command = COMMANDS[name](Path(folder))
            print(f"{name}: {command.seconds:.1f} s unended", flush=True)
            wrong += _failures(name, [*trials(command, options.rounds, options.seed)])
    return int(wrong > 0)


def _failures(name: str, trials: list[Trial]) -> int:
    """Try each, which says what became of it; what went wrong, and how many went which way, is printed."""
    outcomes, start = Counter[str](), time.monotonic()
    for number, (words, trial) in enumerate(trials, 1):
        try:
            outcome = trial()
        except Exception as error:  # whatever it is, it is what is looked for
            outcome = "failure"
            print(f"{name}, {words}: {type(error).__name__} {error}", flush=True)
        outcomes[outcome] += 1
        if number % SHOWN == 0 or number == len(trials):
            print(f"{name}: {number} in {time.monotonic() - start:,.0f} s: {dict(outcomes)}", flush=True)
    return outcomes["failure"]
