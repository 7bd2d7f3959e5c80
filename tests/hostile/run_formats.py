"""What a run's folder holds, and a sweep's file."""

import io
import json
import math
import zipfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.loop import train
from splat.training.origin.subject import Checkpoint
from splat.training.state import Training
from tests.hostile import mutations
from tests.hostile.broken import Format
from tests.hostile.mutations import Random
from tests.splat.tiny import EXTENT, REFERENCE, tiny_config, tiny_gaussians, tiny_views

DRAWN = 0.01  # of the records that are accepted are drawn too, which takes most of the time
BOMB = 3 * 10**6  # zeros, a hundred times what the file takes


def tiny_training() -> Training:
    training = Training.start(tiny_gaussians(), EXTENT, tiny_config())
    next(iter(train(training, tiny_views())))
    return training


KINDS = (torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.cfloat)


def odd_tensor(chance: Random, value: Any) -> Any:
    """Something else in place of a tensor, or a tensor in place of something else."""
    plain = isinstance(value, torch.Tensor) and not value.is_nested and value.layout is torch.strided
    plain = plain and value.device.type == "cpu" and not value.is_quantized and value.numel() < 10**6
    n = value.numel() if plain else 3
    base = value if plain else torch.ones(3)  # a second change may meet what the first one made
    made: list[Callable[[], Any]] = [
        lambda: torch.zeros(n, dtype=chance.choice(KINDS)),
        lambda: torch.zeros(chance.choice([0, 1, n + 1, 7, 14 * 10**4])),
        lambda: torch.zeros(1).expand(chance.choice([n, 10**10])),
        lambda: torch.full((n,), chance.choice([math.nan, math.inf, -1.0, 1e38, 1e-45, 300.0])),
        lambda: torch.zeros(n).to_sparse(),
        lambda: torch.zeros(n, requires_grad=True),
        lambda: torch.nn.Parameter(torch.zeros(n)),
        lambda: torch.nested.nested_tensor([torch.zeros(n)]),
        lambda: torch.zeros(n, device="meta"),
        lambda: torch.quantize_per_tensor(torch.zeros(n), 0.1, 0, torch.qint8),
        lambda: base[::2],
        lambda: base.reshape(1, -1),
        lambda: torch.view_as_complex(torch.zeros(n, 2)).conj(),
        lambda: torch.zeros(n)._neg_view(),
        lambda: base.clone().index_fill_(0, torch.tensor([0]), chance.choice([2, 100, -3])) if base.numel() else base,
    ]  # fmt: skip
    return chance.choice(made)()


class CheckpointFile(Format):
    name = "checkpoint.pt"

    def write(self) -> None:
        save_checkpoint(self.root / self.name, tiny_training(), REFERENCE)
        self.by_bytes, self.views = False, tiny_views()
        self.content = torch.load(self.root / self.name, weights_only=True)
        self.flat = self.content["flat"].clone()

    def broken(self) -> list[str]:
        return [self.name]

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if chance.random() < 0.3:
            self.by_bytes = True
            return mutations.of_bytes(chance, content)
        tree: Any = mutations.of_tree(chance, self.content, odd_tensor)
        buffer = io.BytesIO()
        torch.save(tree, buffer)
        return rezipped(chance, buffer.getvalue()) if chance.random() < 0.1 else buffer.getvalue()

    def use(self) -> None:
        training = load_checkpoint(self.root / self.name).training
        if self.by_bytes:
            assert torch.equal(training.gaussians.flat, self.flat), "other numbers than were saved"
        if training.gaussians.flat.dtype == torch.float32 and not training.config.method.name.startswith("cor"):
            try:
                next(iter(train(training, self.views)), None)
            except NotImplementedError:
                return
        save_checkpoint(self.root / "again.pt", training, REFERENCE)
        load_checkpoint(self.root / "again.pt")


def of_arrays(chance: Random, content: bytes, changes: int = 1, zipped_anew: float = 0.2) -> bytes:
    """An archive of NumPy with so many changes of an array, some of them `rezipped`."""
    arrays: dict[str, Any] = dict(np.load(io.BytesIO(content)))
    for _ in range(changes):
        key = chance.choice(list(arrays))
        arrays[key] = mutations.of_array(chance, arrays[key])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return rezipped(chance, buffer.getvalue()) if chance.random() < zipped_anew else buffer.getvalue()


def rezipped(chance: Random, content: bytes) -> bytes:
    """The same members compressed, in another order, one doubled, or one of a bomb's size."""
    result = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(content)) as old,
        zipfile.ZipFile(result, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new,
    ):
        members = old.namelist()
        chance.shuffle(members)
        for member in members:
            data = old.read(member)
            new.writestr(member, data + bytes(chance.choice([0, 0, 0, BOMB])))
        if chance.random() < 0.2:
            new.writestr(
                chance.choice(["x.npy", "../x.npy", "archive/data/99", members[0]]), bytes(chance.choice([0, BOMB]))
            )
    return result.getvalue()


class Records(Format):
    """A run's folder with a probe."""

    def write(self) -> None:
        from tests.analysis.runs.test_compare import record

        self.second = self.root / "other"
        self.second.mkdir()
        for run, scale in ((self.root, 1.0), (self.second, 0.5)):
            save_checkpoint(run / "checkpoint.pt", tiny_training(), REFERENCE)
            record(run / "probe", scale)
        self.checkpoint = Checkpoint(tiny_training(), REFERENCE)
        self.by_bytes = False

    def use(self) -> None:
        from rich.console import Console

        from analysis.records import report
        from analysis.records.findings import findings
        from analysis.records.records import ProbeRecord, read_record
        from analysis.records.tables import family_table, probe_table
        from analysis.runs.compare import cautions, render_page
        from analysis.runs.compare_table import Run, compare_table, comparison, frame

        record = read_record(self.root / "probe", ProbeRecord)
        other = read_record(self.second / "probe", ProbeRecord)
        self.check(record.arrays)
        with io.StringIO() as quiet:
            console = Console(file=quiet, width=100)
            console.print(probe_table(record.data))
            console.print(family_table(record.data))
            findings(record.data)
            runs = [
                Run(self.root, name, self.checkpoint, None, each.data) for name, each in (("a", record), ("b", other))
            ]
            rows = comparison(runs)
            frame(rows, ["a", "b"]).to_csv(index=False)
            console.print(compare_table(rows, ["a", "b"]))
        render_page(runs, ["a", "b"], rows, [], cautions(runs), self.root)
        if self.chance.random() < 5 * DRAWN:
            report.render_report(record)
        else:  # without the surface, whose program takes the longest to pack
            with patch.object(report, "interactive_surface", return_value=None):
                report.render_report(record)
        if self.chance.random() < DRAWN:
            self.draw(record)

    def draw(self, record: Any) -> None:
        import matplotlib.pyplot as plt

        from figures.make_all import FIGURES, recorded_figures

        for name in recorded_figures(record):
            if name != "surface":
                plt.close(FIGURES[name](record))

    def check(self, arrays: dict[str, dict[str, np.ndarray]]) -> None:
        pass


class ProbeJson(Records):
    name = "probe.json"

    def broken(self) -> list[str]:
        return ["probe/probe.json"]


class ProbeArrays(Records):
    name = "*.npz"

    def broken(self) -> list[str]:
        return [f"probe/{path.name}" for path in sorted((self.root / "probe").glob("*.npz"))]

    @cached_property
    def arrays(self) -> dict[str, dict[str, np.ndarray]]:
        return {name: dict(np.load(io.BytesIO(content))) for name, content in self.files.items()}

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if chance.random() < 0.4:
            self.by_bytes = True
            return mutations.of_bytes(chance, content)
        return of_arrays(chance, content, changes=chance.choice((1, 1, 2)), zipped_anew=0.3)

    def check(self, arrays: dict[str, dict[str, np.ndarray]]) -> None:
        if not self.by_bytes:
            return
        for name, array in arrays[Path(self.changed).stem].items():
            np.testing.assert_array_equal(array, self.arrays[self.changed][name], "other numbers than were written")


class TrajectoryCsv(Format):
    name = "trajectory.csv"

    def write(self) -> None:
        from tests.figures.test_trajectory_figure import rows

        rows().to_csv(self.root / self.name, index=False)

    def broken(self) -> list[str]:
        return [self.name]

    def use(self) -> None:
        from analysis.runs.trajectories import first_and_last, gathered
        from analysis.train.trajectory import _read_rows

        table = gathered([self.root])
        first_and_last(table)
        _read_rows(self.root / self.name, 10**6)
        if self.chance.random() < DRAWN:
            import matplotlib.pyplot as plt

            from figures.trajectory import draw

            plt.close(draw(table))


class RunFiles(Format):
    name = "metrics.json, seconds.json, compare.json"

    def write(self) -> None:
        scores = {
            "psnr": 20.0,
            "ssim": 0.5,
            "lpips": None,
            "masked": False,
            "views": {"a": {"psnr": 20.0, "ssim": 0.5}},
        }
        clock = {"step": 3, "wall": 1.0, "cpu": 2.0, "threads": 2}
        metrics = {"step": 3, "gaussians": 5, "train": scores, "test": scores, "seconds": clock}
        (self.root / "metrics.json").write_text(json.dumps(metrics))
        (self.root / "seconds.json").write_text(json.dumps(clock))
        (self.root / "compare.json").write_text(json.dumps({"runs": {"a": "probe"}}))

    def broken(self) -> list[str]:
        return ["metrics.json", "seconds.json", "compare.json"]

    def use(self) -> None:
        from analysis.records.run_files import read_comparison, read_scores
        from analysis.train.training_time import TrainingTime

        read_scores(self.root)
        read_comparison(self.root)
        TrainingTime.read(self.root)


class SweepToml(Format):
    name = "sweep.toml"

    def write(self) -> None:
        (self.root / self.name).write_text(
            'out = "runs"\nseeds = [0, 1]\niterations = 30\nviews = 3\n[probe]\nseconds = 4.5\n'
            '[scenes.fern]\npath = "fern"\nviews = 3\n[methods.3dgs]\n[methods."asp only"]\nmethod = "stablegs"\n'
            'set = { vsp_weight = 0, probe.attributes = ["means"] }\n'
        )

    def broken(self) -> list[str]:
        return [self.name]

    def use(self) -> None:
        from analysis.runs.sweep.sweep_file import arguments, read_sweep

        for cell in read_sweep(self.root / self.name).cells:
            arguments("train", cell.training)
