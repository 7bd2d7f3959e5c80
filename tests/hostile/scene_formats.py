"""Folders of scenes: models, poses, points, and the pictures and layers beside them."""

import json
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from PIL import Image

from splat.scenes.scene import Scene, load_scene
from tests.hostile import mutations
from tests.hostile.broken import Format
from tests.hostile.mutations import Random
from tests.splat.scenes import folders
from tests.splat.scenes.formats.test_dtu import write_dtu


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


class Blender(SceneFolder):
    name = "transforms_train.json, transforms_test.json"

    def write(self) -> None:
        folders.write_blender(self.root, (0, 1), (2,))

    def broken(self) -> list[str]:
        return self.name.split(", ")


class Dtu(SceneFolder):
    name = "DTU's pos_NNN.txt"

    def write(self) -> None:
        self.parts, self.root = self.root, write_dtu(self.root, views=3)

    def broken(self) -> list[str]:
        return [f"../../Calibration/cal18/pos_{i:03d}.txt" for i in (1, 2, 3)]


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
