"""Reference to the scene of a training, to load it as it was."""

import os
from dataclasses import dataclass
from pathlib import Path

from landscape.errors import InputError
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split
from splat.training.origin.fingerprint import Data, ViewData, changes, in_short
from splat.training.start import Source


@dataclass(frozen=True)
class SceneReference:
    """Reference to the scene of a training, to load it as it was.

    absolute, relative: the scene's folder, and the same from the checkpoint's folder.  images: the folder of images in
    it, where one was named; downscale: the factor by which its images were reduced further.  train, test: names of the views;
    views: what was seen of each.  start: what the Gaussians started from (`splat/training/start.py`); depths, masks: the
    folders of depth maps and masks, where one was named.  similarity, centred: as `posed` takes them, where another tool
    trained in another world.
    """

    absolute: str
    relative: str
    images: str | None
    downscale: float
    train: list[str]
    test: list[str]
    views: dict[str, ViewData]
    start: Source = "scene"
    depths: str | None = None
    masks: str | None = None
    similarity: list[list[float]] | None = None
    centred: bool = False

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
        masks: Path | None = None,
    ) -> "SceneReference":
        """The scene, loaded with these images, downscale, depths and masks, as seen from where the checkpoint will lie."""
        return cls(
            absolute=str(scene.root),
            relative=os.path.relpath(scene.root, checkpoint.parent.resolve()),
            images=images,
            downscale=float(downscale),
            train=list(split.train),
            test=list(split.test),
            views=data_of(scene, [*split.train, *split.test]),
            start=start,
            depths=None if depths is None else str(depths.resolve()),
            masks=None if masks is None else str(masks.resolve()),
        )

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of the training views, px."""
        return [self.views[name].size for name in self.train]

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
        """The scene as its files have it now, in its own world, on this background.

        checkpoint: the file that this was read from; folder: where the scene has moved to.  A COLMAP model's points, from which
        the Gaussians started, are not read again.  FileNotFoundError where there is no such folder; InputError where the scene
        lacks a view.
        """
        there = self.find(checkpoint) if folder is None else folder
        masks = Path(self.masks) if self.masks and Path(self.masks).is_dir() else None
        try:
            scene = load_scene(there, self.images, self.downscale, background, masks, points=False)
            scene.select([*self.train, *self.test])
        except (InputError, FileNotFoundError) as error:
            if folder is None or not there.is_dir():
                raise
            name = Path(self.absolute).name
            raise InputError(
                f"expected the training's scene {name} in {there}, got another or a part: {error}"
            ) from error
        return scene

    def require_unchanged(self, now: Data, folder: Path | str, remedy: str = "restore them or train anew") -> None:
        """InputError that says what has changed in the views since the training."""
        if changed := changes(self.views, now):
            raise InputError(
                f"expected the views of {folder} as they were in the training, got changes in {len(changed)} of "
                f"{len(self.views)}: {in_short(changed)}; {remedy}"
            )


def data_of(scene: Scene, names: list[str]) -> dict[str, ViewData]:
    """What there is now to be seen of these views."""
    return {frame.name: ViewData.of(frame) for frame in scene.select(names)}
