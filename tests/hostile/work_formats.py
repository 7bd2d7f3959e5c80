"""What commands leave for commands to come: slices, the table of a study, and what an interrupted one goes on from."""

import io
from typing import ClassVar

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

        points = torch.cartesian_prod(*[torch.linspace(-1, 1, 5, dtype=torch.float64)] * 2)
        center, directions = torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[:, :2]
        store = self.root / "points.npz"
        found = GridEvaluations(lambda theta: (theta**2).sum(), center, directions, points, store=store)
        found.require(range(len(points)))
        true = ((center + points @ directions.T) ** 2).sum(dim=1).numpy()
        assert found.known.all() and found.value.dtype == true.dtype, "points without a value"
        if self.by_bytes:
            np.testing.assert_array_equal(found.value, true, "other losses than were rendered")
