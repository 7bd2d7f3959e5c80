"""Subjects: what is measured, pictured and used, a checkpoint with its scene; `splat.open_subject` opens them."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from landscape.errors import InputError, TooLittleMemory
from landscape.results import ShortRepr
from splat.backend.memory import free_memory
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.typed import leaves
from splat.model.untrusted import loose_json
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split, spread_views
from splat.scenes.view import Frame
from splat.training.origin.fingerprint import Data, Fingerprint, ViewData, changes, in_short, state_of
from splat.training.origin.frames import posed
from splat.training.start import Source
from splat.training.state import Training

PLANES, COPIES = 12, 4  # in memory: planes of a view, its loss's included; copies of the Gaussians


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


@dataclass(frozen=True, eq=False, repr=False)
class Checkpoint(ShortRepr):
    """A saved training and its scene.

    origin: what was assumed of another tool's file (`foreign_training`).  all_views: number of views that it was trained on,
    where the scene names fewer (`thinned`).  changed: what is not as it was in the training, where that was accepted.  notes:
    of the scene, once it is opened.
    """

    training: Training
    scene: SceneReference
    origin: dict[str, Any] | None = None
    all_views: int | None = None
    changed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def assumptions(self) -> list[str]:
        """Sentences on what was assumed of the scene and of another tool's file, and on what was accepted."""
        changed = [f"not as in the training, and accepted: {each}" for each in self.changed]
        if self.origin is None:
            return [*self.notes, *changed]
        summary = "trained by {trained_by} ({trained_by_source}), training views: {views}; {psnr:.1f} dB on two of them"
        return [*self.notes, summary.format(**self.origin), *self.origin["notes"], *changed]

    @property
    def state(self) -> str:
        """Digest of the Gaussians, by which records are known to be its own."""
        return state_of(self.training.gaussians, self.training.step)

    def fingerprint(
        self,
        settings: Mapping[str, Any],
        seed: int,
        loss: LossSettings | None = None,
        further: Mapping[str, ViewData] | None = None,
    ) -> Fingerprint:
        """What numbers of this checkpoint are about.

        settings: of the command, that change them.  loss: the training's by default.  further: views beside the training's.
        """
        config, scene, gaussians = self.training.config, self.scene, self.training.gaussians
        rounded = None if scene.similarity is None else [f"{value:.9g}" for row in scene.similarity for value in row]
        objective = {
            "loss": asdict(loss or config.loss),
            "render": asdict(config.render),
            "background": config.background,
        }
        objective |= {"views": scene.train, "of": self.all_views or len(scene.train)}
        objective |= {"similarity": rounded, "centred": scene.centred, "dtype": str(gaussians.flat.dtype)}
        trained = asdict(config) | {"extent": f"{self.training.extent:.9g}"}
        question = leaves({"objective": objective, "training": trained, "settings": dict(settings), "seed": seed})
        data = {name: scene.views[name] for name in scene.train} | dict(further or {})
        return Fingerprint(data, loose_json(json.dumps(question, default=str)), self.state)  # as it is read again

    def thinned(self, scene: Scene, count: int | None) -> "Checkpoint":
        """The same with at most `count` of its training views, spread evenly over their cameras; None: all."""
        if count is None or count >= len(self.scene.train):
            return self
        chosen = set(spread_views(scene.select(self.scene.train), count))
        train = [name for name in self.scene.train if name in chosen]
        return replace(self, scene=replace(self.scene, train=train), all_views=self.all_views or len(self.scene.train))

    def with_scene(self, path: Path, folder: Path | None = None, *, accept: bool = False) -> "Subject":
        """The checkpoint, which was read from path, with its views as they are now, and its scene.

        folder: where the scene has moved to.  InputError that says what has changed since the training, unless accepted;
        and as `SceneReference.load`.
        """
        reference = self.scene
        scene = reference.load(path, self.training.config.background, folder)
        now = data_of(scene, list(reference.views))
        changed = tuple(changes(reference.views, now))
        if not accept:
            reference.require_unchanged(now, scene.root, "restore them, train anew, or go on with --accept-changed")
        scene = posed(scene, reference.similarity, centred=reference.centred)
        return Subject(
            path, replace(self, scene=replace(reference, views=now), changed=changed, notes=scene.notes), scene
        )


@dataclass(frozen=True, eq=False, repr=False)
class Subject(ShortRepr):
    """A checkpoint and its scene, in the world of the Gaussians, both as they are now.  path: of the checkpoint."""

    path: Path
    checkpoint: Checkpoint
    scene: Scene

    def objective(
        self, views: Sequence[str] | None = None, loss: LossSettings | None = None, *, keep_unseen: bool = False
    ) -> SceneObjective:
        """The objective at its Gaussians, on the training's background: the loss whose Hessian is studied.

        views: names, by default those of the training.  loss: the training's by default.  keep_unseen: see `SceneObjective`.
        """
        training, frames = self.checkpoint.training, self.scene.select(views or self.checkpoint.scene.train)
        _require_room(frames, training.gaussians)
        config = replace(training.config, loss=loss or training.config.loss)
        read = self.scene.load([frame.name for frame in frames])
        return config.objective(training.gaussians, read, keep_unseen=keep_unseen)


def _require_room(frames: Sequence[Frame], gaussians: Gaussians) -> None:
    """TooLittleMemory that says what would fit, where pictures and Gaussians alone take more than is free."""
    each = [PLANES * 4 * frame.camera.width * frame.camera.height for frame in frames]
    fixed, left = COPIES * gaussians.flat.nbytes, free_memory(torch.device("cpu"))
    if (needed := fixed + sum(each)) <= left:
        return
    some = (left - fixed) // max(each)
    more = f"allow or free at least {(needed - left) / 1e6:.3g} MB more"
    enough = f"--max-views {some} would fit" if some > 0 else more
    raise TooLittleMemory(
        f"expected {needed / 1e6:.3g} MB of memory beside what is taken, for {len(frames)} pictures and "
        f"{len(gaussians):,} Gaussians, got {left / 1e6:.3g} MB; {enough}"
    )
