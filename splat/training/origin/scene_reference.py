"""Reference to the scene of a training, to load it as it was."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from landscape.errors import InputError
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split
from splat.scenes.view import digests
from splat.training.origin.frames import posed
from splat.training.start import Source


@dataclass(frozen=True)
class SceneReference:
    """Reference to the scene of a training, to load it as it was.

    absolute, relative: the scene's folder, and the same from the checkpoint's folder.  images: the folder of images in
    it, where one was named; downscale: the factor by which its images were reduced further.  train, test: names of the views;
    sizes: (width, height) of the training views, px.  start: what the Gaussians started from (`splat/training/start.py`);
    depths: the folder of depth maps, where one was named.  similarity, centred: as `posed` takes them, where another tool
    trained in another world.  photographs: `digests` of the training views.  Older files have none of these.
    """

    absolute: str
    relative: str
    images: str | None
    downscale: float
    train: list[str]
    test: list[str]
    sizes: list[list[int]]
    start: Source = "scene"
    depths: str | None = None
    similarity: list[list[float]] | None = None
    centred: bool = False
    photographs: list[str] | None = None

    @classmethod
    def to(
        cls,
        scene: Scene,
        checkpoint: Path,
        split: Split,
        images: str | None,
        downscale: float,
        start: Source = "scene",
        depths: Path | None = None,
    ) -> "SceneReference":
        """The scene, loaded with these images, downscale and depths, as seen from where the checkpoint will lie."""
        return cls(
            absolute=str(scene.root),
            relative=os.path.relpath(scene.root, checkpoint.parent.resolve()),
            images=images,
            downscale=float(downscale),
            train=list(split.train),
            test=list(split.test),
            sizes=[[frame.camera.width, frame.camera.height] for frame in scene.select(split.train)],
            start=start,
            depths=None if depths is None else str(depths.resolve()),
            photographs=digests(scene.select(split.train)),
        )

    def find(self, checkpoint: Path) -> Path:
        """The scene's folder: seen from the checkpoint, else where it lay.  FileNotFoundError if in neither."""
        candidates = [(checkpoint.parent / self.relative).resolve(), Path(self.absolute)]
        for folder in candidates:
            if folder.is_dir():
                return folder
        raise FileNotFoundError(
            f"expected the scene of {checkpoint} at {' or '.join(str(c) for c in dict.fromkeys(candidates))}, "
            "found no such folder; pass where it is now with --scene"
        )

    def load(self, checkpoint: Path, background: tuple[float, float, float], folder: Path | None = None) -> Scene:
        """The scene, on this background.  checkpoint: the file that this was read from; folder: where the scene has moved to.

        `load(...).load(self.train)` then gives the training views.  A COLMAP model's points, from which the Gaussians
        started, are not read again.  FileNotFoundError where there is no such folder; InputError where the scene lacks a view
        or has another photograph of it.
        """
        there = self.find(checkpoint) if folder is None else folder
        try:
            scene = load_scene(there, self.images, self.downscale, background, points=False)
            scene.select([*self.train, *self.test])
        except (InputError, FileNotFoundError) as error:
            if folder is None or not there.is_dir():
                raise
            name = Path(self.absolute).name
            raise InputError(
                f"expected the training's scene {name} in {there}, got another or a part: {error}"
            ) from error
        for frame, size in zip(scene.select(self.train), self.sizes, strict=True):
            if [frame.camera.width, frame.camera.height] != size:
                raise InputError(
                    f"expected view {frame.name!r} of {there} at {size[0]} x {size[1]} px, as in the training, got "
                    f"{frame.camera.width} x {frame.camera.height}; its images have changed, restore them or train anew"
                )
        self.require_photographs(digests(scene.select(self.train)), there)
        return posed(scene, self.similarity, centred=self.centred)

    def require_photographs(self, found: Sequence[str] | None, folder: Path) -> None:
        """InputError where the photographs of the training views are others than they were, as far as that is known."""
        changed = [name for name, was, now in zip(self.train, self.photographs or (), found or ()) if was != now]
        if changed:
            raise InputError(
                f"expected the photographs of {folder} as they were in the training, got another file for {changed[0]!r} "
                f"({len(changed)} of {len(self.train)} training views have one); restore them or train anew"
            )
