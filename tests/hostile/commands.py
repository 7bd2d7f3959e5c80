"""The commands that write files, on a tiny scene: what is typed, and which numbers they come to."""

import json
import random
import re
import shutil
import time
from pathlib import Path

from analysis.commands import cli
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
from tests.hostile.programs import forked


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
        while (code := self.begun().wait()) == CELLS_ELSEWHERE and time.monotonic() < end:  # another is at work
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

    name, module = "notebooks.uses", uses
    files = ("study.csv", "cells/tiny-d-0.json", "cells/tiny-random-0.json")

    def words(self) -> list[str]:
        file = self.scene.with_name("study.toml")
        file.write_text(
            'out = "work/out"\nrules = ["d", "random"]\nseeds = [0]\nrounds = 1\nfirst_steps = 4\nsteps = 2\n'
            f'[scenes.tiny]\npath = "{self.scene}"\n'
        )
        return [str(file)]


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

    def numbers(self) -> Numbers:
        """The page's without its pictures, which only programs draw."""
        found = super().numbers()
        if PAGE in found:
            page = (self.out / PAGE).read_text()
            found[PAGE] = digest(
                re.sub("<figure>.*?</figure>|<p>No pictures were drawn.</p>", "", page, flags=re.DOTALL).encode()
            )
        return found

    def words(self) -> list[str]:
        return ["compare", *map(str, self.runs), "--out", str(self.out)]


class Trajectory(Files):
    name, files = "trajectory", ("trajectories.csv",)

    def made_before(self) -> None:
        super().made_before()
        out, steps = ["--out", str(self.checkpoint.parent)], ["--iterations", "4", "--probe-every", "2"]
        shutil.rmtree(self.checkpoint.parent)
        train = ["train", str(self.scene), *out, *steps]
        assert forked(lambda: cli.main(train)).wait() == 0

    def words(self) -> list[str]:
        return ["trajectory", str(self.checkpoint.parent), "--out", str(self.out)]


class Paper(Files):
    """`python -m notebooks.paper`; its PDFs hold the time."""

    name, module, files = (
        "notebooks.paper",
        paper,
        ("study.csv", "claims.csv", "predictors.csv", "claims.png", "budget.png", "axes.png", "captions.md"),
    )

    def words(self) -> list[str]:
        return ["--out", str(self.out)]


KINDS = (Train, Probe, Slice, Map, Convert, Sweep, Prune, NextView, NextStudy, Uncertainty, Compare, Trajectory, Paper)
COMMANDS: dict[str, type[Ended]] = {each.name: each for each in KINDS}
