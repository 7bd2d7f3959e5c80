"""What commands leave for commands to come: slices, the table of a study, and what an interrupted one goes on from."""

import io
import json
from typing import ClassVar
from unittest.mock import patch

import numpy as np
import torch

from tests.hostile import mutations
from tests.hostile.broken import Format
from tests.hostile.mutations import Random
from tests.hostile.run_formats import DRAWN, of_arrays


class SliceFiles(Format):
    """A slice along a line, which is drawn now and then."""

    name = "slice.json, slice.npz"

    def write(self) -> None:
        from tests.recorded import synthetic_line, written

        written(self.root / "slice", *synthetic_line())

    def broken(self) -> list[str]:
        return ["slice/slice.json", "slice/slice.npz"]

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if name.endswith(".json") or chance.random() < 0.3:
            return super().mutated(chance, name, content)
        return of_arrays(chance, content)

    def use(self) -> None:
        import matplotlib.pyplot as plt

        from analysis.records.records import SliceRecord, read_record
        from analysis.slice.command import _conclude
        from figures.make_all import FIGURES, recorded_figures

        record = read_record(self.root / "slice", SliceRecord)
        _conclude(record.data, record.folder)
        if self.chance.random() < DRAWN:
            for name in recorded_figures(record):
                plt.close(FIGURES[name](record))


class StudyCsv(Format):
    name = "study.csv"

    def write(self) -> None:
        from tests.notebooks.test_claims import PAPER, made_up

        made_up(PAPER).to_csv(self.root / self.name, index=False)

    def broken(self) -> list[str]:
        return [self.name]

    def use(self) -> None:
        from rich.console import Console

        from notebooks.paper.__main__ import tell
        from notebooks.paper.figures import captions
        from notebooks.paper.predictors import predictors
        from notebooks.paper.statements import effect_table, judgements
        from notebooks.paper.study import study

        rows = study([self.root / self.name])
        found = judgements(rows)
        effect_table(found).to_csv(index=False)
        with io.StringIO() as quiet:
            tell(rows, found, Console(file=quiet))
        if self.chance.random() < DRAWN:
            predictors(rows)
            captions(rows, ["predictors", "budget", "axes"])


class MapFiles(Format):
    """A map beside a probe, whose page does without it where it is damaged."""

    name = "map.json, map/*.npz, *.png"
    refuses = False

    def write(self) -> None:
        from analysis.records.json_files import plain
        from splat.training.origin.fingerprint import Fingerprint
        from tests.analysis.records.test_report import with_views
        from tests.recorded import synthetic, written_map

        data, _ = synthetic()
        data["provenance"]["fingerprint"] = plain(Fingerprint({}, {}, "00"))
        written_map(self.root / "map", data["provenance"])
        with_views(self.root / "probe", ["a.png"], data)

    def broken(self) -> list[str]:
        return [f"map/{path.name}" for path in sorted((self.root / "map").iterdir())]

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        of_array = name.endswith("npz") and chance.random() < 0.6
        return of_arrays(chance, content) if of_array else super().mutated(chance, name, content)

    def use(self) -> None:
        from analysis.records import report
        from analysis.records.records import read_record

        # without the surface, whose program takes the longest to pack
        with patch.object(report, "interactive_surface", return_value=None):
            text = report.render_report(read_record(self.root / "probe"))
        assert text.rstrip().endswith("</html>") and "photograph" in text, "a page without its own pictures"


class StudyToml(Format):
    """A study of next views, and a cell of it."""

    name = "study.toml, cells/*.json"

    def write(self) -> None:
        (self.root / "study.toml").write_text(
            'out = "out"\nrules = ["d"]\nseeds = [0]\n[scenes."fern 2"]\npath = "fern"\n'
        )
        row = {"scene": "fern", "rule": "d", "seed": 0, "round": 0, "views": 2, "added": "", "psnr": 9.0, "ssim": 0.5}
        (self.root / "cell.json").write_text(json.dumps({"told": "this", "rows": [row]}))

    def broken(self) -> list[str]:
        return ["study.toml", "cell.json"]

    def use(self) -> None:
        from notebooks.uses.study import _kept, read_study

        study = read_study(self.root / "study.toml")
        assert all((self.root / name).parent == self.root for name in study.scenes), "a name that leads out"
        _kept(self.root / "cell.json", "this")


class OriginOfRecord(Format):
    """The provenance of a probe of another tool's file, which compare opens as it was probed."""

    name = "origin of probe.json"

    def write(self) -> None:
        from tests.recorded import synthetic, written

        data, arrays = synthetic()
        preset = {"render": {"antialias": "none"}, "loss": {"opacity_reg": 0.0, "scale_reg": 0.01}}
        origin = {"trained_by": "gsplat", "images": None, "downscale": 2.0, "preset": preset, "notes": ["assumed"]}
        data["provenance"] |= {"origin": origin, "scene_folder": "fern", "views": ["a.png"]}
        written(self.root / "probe", data, arrays)

    def broken(self) -> list[str]:
        return ["probe/probe.json"]

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        data = json.loads(content)
        data["provenance"]["origin"] = mutations.of_tree(chance, data["provenance"]["origin"])
        return json.dumps(data).encode("utf-8", "surrogatepass")

    def use(self) -> None:
        from analysis.records.records import ProbeRecord, read_record
        from analysis.runs.compared import _as_probed

        made = read_record(self.root / "probe", ProbeRecord).data.provenance
        if made.origin and made.scene_folder:
            _as_probed(made)


class KeptStages(Format):
    """Stages of an interrupted probe: what is damaged is measured again."""

    name = "STAGE.msgpack"
    refuses = False
    matrix: ClassVar = torch.diag(torch.linspace(-2, 7, 12, dtype=torch.float64))

    def write(self) -> None:
        self.found = self.measured()

    def broken(self) -> list[str]:
        return [path.name for path in sorted(self.root.glob("*.msgpack"))]

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        return mutations.of_bytes(chance, content)

    def measured(self) -> list[torch.Tensor]:
        from analysis.console.kept import Kept
        from analysis.console.stages import Stages
        from landscape import DenseOperator, EigenEnds, extreme_eigenpairs

        kept = Kept(Stages(), torch.Generator().manual_seed(0), ["ends", "more ends"], lambda: [1], self.root, "this")
        operator = DenseOperator(self.matrix)
        found = [
            kept.run(name, EigenEnds, lambda generator, report, notes: extreme_eigenpairs(operator, generator))
            for name in ("ends", "more ends")
        ]
        return [pairs.vectors for ends in found if ends for pairs in (ends.largest, ends.smallest)]

    def use(self) -> None:
        assert all(map(torch.equal, self.found, self.measured())), "other vectors than were found"


class KeptPoints(Format):
    """Renders of an interrupted slice, which have checksums."""

    name = "evaluations of a slice"

    def write(self) -> None:
        self.by_bytes = False
        self.use()

    def broken(self) -> list[str]:
        return ["points.npz"]

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if chance.random() < 0.5:
            self.by_bytes = True
            return mutations.of_bytes(chance, content)
        return of_arrays(chance, content)

    def use(self) -> None:
        from landscape.slices.grid_evaluations import GridEvaluations
        from splat.model.untrusted import KeptArrays

        points = torch.cartesian_prod(*[torch.linspace(-1, 1, 5, dtype=torch.float64)] * 2)
        center, directions = torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[:, :2]
        store = self.root / "points.npz"
        found = GridEvaluations(lambda theta: (theta**2).sum(), center, directions, points, store=KeptArrays(store))
        found.require(range(len(points)))
        true = ((center + points @ directions.T) ** 2).sum(dim=1).numpy()
        assert found.known.all() and found.value.dtype == true.dtype, "points without a value"
        if self.by_bytes:
            np.testing.assert_array_equal(found.value, true, "other losses than were rendered")
