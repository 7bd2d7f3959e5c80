"""Gaussians that other tools trained, in the folder of a training, opened on their scene as a probe does."""

import gzip
import io
import json
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, ClassVar

import torch

from splat.model.files.read import read_splats
from splat.model.gaussians import Gaussians
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import open_subject
from splat.training.origin.options import Foreign
from tests.hostile import mutations
from tests.hostile.broken import Format
from tests.hostile.mutations import Random
from tests.hostile.run_formats import odd_tensor, rezipped
from tests.splat.model.files import written
from tests.splat.model.files.test_quantised import sog, zipped

CFG_ARGS = (
    "Namespace(sh_degree=3, eval=True, images='images', resolution=-1, white_background=False, antialiasing=False)"
)
CAMERAS = json.dumps([{"id": i, "img_name": f"view_{i:03d}", "width": 24} for i in range(4)])
LIST = "list.txt"
FRAME = '{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0}'


class Model(Format):
    """A file of Gaussians that are the photographs' own, and what its tool lays beside it.

    beside: name -> text.  trained_by: whose conventions to follow.  has_checksum: damaged bytes cannot go unnoticed.
    """

    file: ClassVar[str]
    made: ClassVar[Callable[[Gaussians], bytes]]
    degree: ClassVar[int] = 1
    beside: ClassVar[dict[str, str]] = {}
    trained_by: ClassVar[str] = "splat-landscape"
    has_checksum: ClassVar[bool] = False

    def write(self) -> None:
        made = synthetic_scene(SyntheticSettings(gaussians=50, views=4, width=24, height=16))
        write_transforms_scene(made.scene, self.root / "scene")
        self.by_bytes, self.flat = False, torch.empty(0)
        path = self.root / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(type(self).made(made.truth.select(torch.arange(len(made.truth)), self.degree)))
        for name, text in self.beside.items():
            (self.root / name).write_text(text)
        self.flat = read_splats(path).gaussians.flat

    def broken(self) -> list[str]:
        return [self.file, *self.beside]

    def use(self) -> None:
        listed = self.root / LIST if LIST in self.beside else None
        ask = Foreign(trained_by=self.trained_by, scene=self.root / "scene", train_list=listed, guess_views=True)
        subject = open_subject(self.root / self.file, ask)
        flat, names = subject.checkpoint.training.gaussians.flat, subject.checkpoint.scene.train
        assert torch.isfinite(flat).all() and set(names) <= {*subject.scene.names}, "a scene that cannot be"
        if self.by_bytes and self.has_checksum and self.changed == self.file:
            assert torch.equal(flat, self.flat), "other numbers than were written"


class PointCloud(Model):
    name = "point_cloud.ply, cfg_args, cameras.json"
    file = "model/point_cloud/iteration_7/point_cloud.ply"
    made = lambda gaussians: written.ply(written.columns(gaussians))  # noqa: E731
    beside: ClassVar = {"model/cfg_args": CFG_ARGS, "model/cameras.json": CAMERAS}


class TextPly(Model):
    name = "Gaussians as text"
    file = "text.ply"
    made = lambda gaussians: written.ply(written.columns(gaussians), order="")  # noqa: E731

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        return mutations.of_text(chance, content.decode()).encode()


class DotSplat(Model):
    name = ".splat, --train-list"
    beside: ClassVar = {LIST: "images/view_000.png\nimages/view_001.png\n"}
    file = "scene.splat"
    made = written.dot_splat
    degree = 0


class Tensors(Model):
    """What torch.save wrote: bytes, structure, pickles with right checksums, compressed or doubled members."""

    has_checksum = True

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if name != self.file or chance.random() < 0.3:
            return super().mutated(chance, name, content)
        if chance.random() < 0.3:
            members = unzipped(content)
            pickle = next(member for member in members if member.endswith("data.pkl"))
            return zipped({**members, pickle: mutations.of_bytes(chance, members[pickle])})
        tree: Any = torch.load(io.BytesIO(content), weights_only=False)  # our own
        buffer = io.BytesIO()
        torch.save(mutations.of_tree(chance, tree, odd_tensor), buffer)
        return rezipped(chance, buffer.getvalue()) if chance.random() < 0.1 else buffer.getvalue()


def unzipped(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


class Graphdeco(Tensors):
    name = "chkpntN.pth"
    file = "chkpnt7.pth"
    made = lambda gaussians: written.graphdeco_pth(gaussians, 1)  # noqa: E731


class Gsplat(Tensors):
    name = "ckpt_STEP_rankR.pt"
    file = "ckpt_6_rank0.pt"
    made = written.gsplat_pt


class Splatfacto(Tensors):
    name = "step-STEP.ckpt, dataparser_transforms.json"
    file = "step-9.ckpt"
    made = written.splatfacto
    beside: ClassVar = {"dataparser_transforms.json": FRAME}
    trained_by = "nerfstudio"


class Spz(Model):
    """Broken before it was compressed as often as after."""

    name = ".spz"
    file = "scene.spz"
    made = written.spz

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if name != self.file or chance.random() < 0.5:
            return super().mutated(chance, name, content)
        return gzip.compress(mutations.of_bytes(chance, gzip.decompress(content)), 1)


class CompressedPly(Model):
    name = "compressed PLY"
    file = "compressed.ply"

    @staticmethod
    def made(gaussians: Gaussians) -> bytes:
        import gsply  # pyright: ignore[reportMissingImports]

        a = written.parts(gaussians)
        columns = (a["means"], a["log_scales"], a["quats"], a["opacity_logits"], a["sh"][:, 0], a["sh"][:, 1:])
        return gsply.compress_to_bytes(gsply.GSData.from_arrays(*columns, format="ply"))


class Sog(Model):
    """Members broken as often as the whole."""

    name = ".sog"
    file = "scene.sog"
    made = lambda gaussians: zipped(sog(gaussians))  # noqa: E731
    degree = 0

    def mutated(self, chance: Random, name: str, content: bytes) -> bytes:
        if name != self.file or chance.random() < 0.3:
            return super().mutated(chance, name, content)
        members = unzipped(content)
        member = chance.choice(list(members))
        return zipped({**members, member: super().mutated(chance, member, members[member])})


QUANTISED = (Spz, CompressedPly, Sog) if find_spec("gsply") else ()
