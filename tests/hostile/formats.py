"""Every format that is read: a good example, how a case breaks it, and what the commands do with it.

A format writes its example into a folder once.  A case breaks one file of it, `use` reads it as the commands do, to the numbers
and pages that follow, and the file is put back.  `use` raises what the reader raises; AssertionError where what was read cannot
be, or differs although a checksum could have told.
"""

import io
import json
import math
import zipfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from PIL import Image

from splat.scenes.scene import Scene, load_scene
from splat.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from splat.training.loop import train
from splat.training.state import Training
from tests.hostile import mutations
from tests.hostile.mutations import Random
from tests.splat.scenes import folders
from tests.splat.tiny import EXTENT, REFERENCE, tiny_config, tiny_gaussians, tiny_views

DRAWN = 0.01  # of the records that are accepted are drawn too, which takes most of the time


def tiny_training() -> Training:
    training = Training.start(tiny_gaussians(), EXTENT, tiny_config())
    next(iter(train(training, tiny_views())))
    return training


class Format:
    """name: in the table of outcomes.  broken: the files that cases break, of those in `root`."""

    name: ClassVar[str]

    def __init__(self, root: Path) -> None:
        self.root, self.chance = root, Random(0)
        self.write()
        self.files = {name: (root / name).read_bytes() for name in self.broken()}
        self.use()

    def write(self) -> None:
        raise NotImplementedError

    def broken(self) -> list[str]:
        raise NotImplementedError

    def use(self) -> None:
        raise NotImplementedError

    def case(self, chance: Random) -> None:
        """Break a file, use the folder, put the file back."""
        name = chance.choice(list(self.files))
        self.chance, self.changed, self.by_bytes = chance, name, False
        try:
            (self.root / name).write_bytes(self.mutated(chance, name, self.files[name]))
            self.use()
        finally:
            (self.root / name).write_bytes(self.files[name])

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if Path(name).suffix in (".txt", ".csv", ".toml", ".json") and chance.random() < 0.6:
            return mutations.of_text(chance, content.decode()).encode()
        if name.endswith(".json") and chance.random() < 0.8:
            tree = mutations.of_tree(chance, json.loads(content))
            return json.dumps(tree).encode("utf-8", "surrogatepass")
        if name.endswith(".npy") and chance.random() < 0.5:
            return saved(mutations.of_array(chance, np.load(io.BytesIO(content))))
        self.by_bytes = True
        return mutations.of_bytes(chance, content)


def saved(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


KINDS = (torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.cfloat)


def odd_tensor(chance: Random, value: Any) -> Any:
    """Something else in place of a tensor, or a tensor in place of something else."""
    n = value.numel() if isinstance(value, torch.Tensor) else 3
    base = value if isinstance(value, torch.Tensor) else torch.ones(3)
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


def rezipped(chance: Random, content: bytes) -> bytes:
    """The same members compressed, in another order, one doubled, or one of a bomb's size."""
    result = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(result, "w", zipfile.ZIP_DEFLATED) as new:
        members = old.namelist()
        chance.shuffle(members)
        for member in members:
            data = old.read(member)
            new.writestr(member, data + bytes(chance.choice([0, 0, 0, 3 * 10**7])))
        if chance.random() < 0.2:
            new.writestr(
                chance.choice(["x.npy", "../x.npy", "archive/data/99", members[0]]),
                bytes(chance.choice([0, 3 * 10**7])),
            )
    return result.getvalue()


class Records(Format):
    """A run's folder with a probe."""

    def write(self) -> None:
        from tests.analysis.runs.test_compare import record

        record(self.root / "probe", 1.0)
        self.second = self.root / "other"
        record(self.second / "probe", 0.5)
        self.checkpoint = Checkpoint(tiny_training(), REFERENCE, "")
        self.by_bytes = False

    def use(self) -> None:
        from rich.console import Console

        from analysis.records.findings import findings
        from analysis.records.records import ProbeRecord, read_record
        from analysis.records.report import render_report
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
        render_report(record, None if self.chance.random() < 5 * DRAWN else "")
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
        arrays: dict[str, Any] = dict(np.load(io.BytesIO(content)))
        for _ in range(chance.choice((1, 1, 2))):
            key = chance.choice(list(arrays))
            arrays[key] = mutations.of_array(chance, arrays[key])
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        return rezipped(chance, buffer.getvalue()) if chance.random() < 0.3 else buffer.getvalue()

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
        clock = {"wall": 1.0, "cpu": 2.0, "threads": 2}
        metrics = {"step": 3, "gaussians": 5, "train": scores, "test": scores, "seconds": clock}
        (self.root / "metrics.json").write_text(json.dumps(metrics))
        (self.root / "seconds.json").write_text(json.dumps({"step": 3, **clock}))
        (self.root / "compare.json").write_text(json.dumps({"runs": {"a": "probe"}}))

    def broken(self) -> list[str]:
        return ["metrics.json", "seconds.json", "compare.json"]

    def use(self) -> None:
        from analysis.records.run_files import read_comparison, read_scores, read_seconds
        from analysis.train.training_time import TrainingTime

        read_scores(self.root)
        read_seconds(self.root)
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


class SceneFolder(Format):
    """A folder of a scene, whose pictures are read and from whose points a training would start."""

    downscale = 1.0

    def use(self) -> None:
        scene = load_scene(self.root, downscale=self.downscale, **self.layers)
        for view in scene.load():
            assert torch.isfinite(view.image).all() and 0 <= view.image.min() <= view.image.max() <= 1, "a picture"
        for frame in scene.frames:
            assert torch.isfinite(frame.camera.rotation).all() and torch.isfinite(frame.camera.centre).all(), "a pose"
        if scene.points is not None:
            assert torch.isfinite(scene.points.xyz).all(), "points that are not finite"
            assert (scene.points.rgb >= 0).all() and (scene.points.rgb <= 1).all(), "colours out of range"
        self.check(scene)

    layers: ClassVar[dict[str, Any]] = {}

    def check(self, scene: Scene) -> None:
        pass


class ColmapBinary(SceneFolder):
    name = "COLMAP, binary"

    def write(self) -> None:
        folders.write_colmap(self.root)

    def broken(self) -> list[str]:
        return [f"sparse/0/{path.name}" for path in sorted((self.root / "sparse/0").iterdir())]


class ColmapText(ColmapBinary):
    name = "COLMAP, text"

    def write(self) -> None:
        folders.write_colmap(self.root, text=True)


class Llff(SceneFolder):
    name = "poses_bounds.npy"

    def write(self) -> None:
        folders.write_llff(self.root)

    def broken(self) -> list[str]:
        return [self.name]


class Transforms(SceneFolder):
    name = "transforms.json"

    def write(self) -> None:
        folders.write_transforms(self.root)
        content = json.loads((self.root / self.name).read_text())
        content |= {"k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV", "background": [0, 0.5, 1]}
        (self.root / self.name).write_text(json.dumps(content))

    def broken(self) -> list[str]:
        return [self.name]


class Ply(SceneFolder):
    name = "points.ply"

    def write(self) -> None:
        folders.write_transforms(self.root, ply_file_path=self.name)
        (self.root / self.name).write_bytes(self.header() + b"".join(map(self.row, range(6))))

    def header(self) -> bytes:
        lines = ["ply", f"format {'ascii' if self.text else 'binary_little_endian'} 1.0", "element vertex 6"]
        lines += [f"property double {axis}" for axis in "xyz"]
        lines += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
        return "\n".join([*lines, "property list uint int views", "end_header", ""]).encode()

    def row(self, i: int) -> bytes:
        xyz, rgb, seen = folders.XYZ[i], folders.RGB[i], folders.SEEN[i]
        if self.text:
            return f"{' '.join(map(str, [*xyz.tolist(), *rgb.tolist(), len(seen), *seen]))}\n".encode()
        return xyz.astype("<f8").tobytes() + rgb.tobytes() + np.array([len(seen), *seen], "<i4").tobytes()

    text = False

    def broken(self) -> list[str]:
        return [self.name]


class PlyText(Ply):
    name = "points.ply, text"
    text = True

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        return mutations.of_text(chance, content.decode()).encode()


class Pictures(SceneFolder):
    name = "PNG, JPEG, mask, depth"
    layers = {}
    suffixes = (".png", ".jpg", ".webp")

    def write(self) -> None:
        folders.write_transforms(self.root)
        content = json.loads((self.root / "transforms.json").read_text())
        for frame, suffix in zip(content["frames"], self.suffixes, strict=True):
            old = self.root / frame["file_path"]
            new = old.with_suffix(suffix)
            Image.open(old).save(new)
            frame["file_path"] = f"images/{new.name}"
        (self.root / "transforms.json").write_text(json.dumps(content))
        names = [Path(frame["file_path"]).stem for frame in content["frames"]]
        (self.root / "masks").mkdir()
        (self.root / "depths").mkdir()
        width, height = folders.SIZE
        inside = np.zeros((height, width), np.uint8)
        inside[4:12, 4:16] = 255
        for i, name in enumerate(names):
            Image.fromarray(inside).save(self.root / f"masks/{name}.png")
            depth = np.linspace(1, 2 + i, height * width).reshape(height, width)
            if i:
                np.save(self.root / f"depths/{name}.npy", depth.astype(np.float32))
            else:
                Image.fromarray((depth * 1e4).astype(np.uint16)).save(self.root / f"depths/{name}.png")
        self.layers = {"depths": self.root / "depths"}  # pyright: ignore[reportAttributeAccessIssue]
        self.by_bytes, self.changed = False, ""

    def broken(self) -> list[str]:
        folder = [path for name in ("images", "masks", "depths") for path in sorted((self.root / name).iterdir())]
        return [str(path.relative_to(self.root)) for path in folder]

    @cached_property
    def image(self) -> torch.Tensor:
        return load_scene(self.root).load()[0].image

    def check(self, scene: Scene) -> None:
        if not self.changed:
            assert len(self.image)  # as it was written
        elif self.by_bytes and self.changed == "images/a.png":
            assert torch.equal(scene.load()[0].image, self.image), "another picture than was written"


FORMATS: dict[str, type[Format]] = {
    each.name: each
    for each in (
        CheckpointFile, ProbeJson, ProbeArrays, TrajectoryCsv, RunFiles, SweepToml, ColmapBinary, ColmapText, Llff, Transforms,
        Ply, PlyText, Pictures,
    )
}  # fmt: skip
