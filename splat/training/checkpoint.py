"""Checkpoints: a training under way and where its scene lies, in one file.

The file is a `torch.save` of tensors and plain types, loaded with `weights_only=True` (nothing in it can run code), and
written whole or not at all.  Its checksums are compared, which torch leaves out.  The same training gives the same bytes.
Keys (p parameters, n Gaussians):

    format, version     "splat-landscape checkpoint", 2; version 1 knew no methods: it is 3DGS, and has no regularizer
    torch               version of torch that wrote it
    step, extent        steps made; radius of the scene's cameras, world units
    sh_degree, flat     the Gaussians: bands in use, (p,) stored parameters
    adam                {"first": (p,), "second": (p,), "updates": int}
    screen_gradients    {"total": (n,), "renders": (n,)}
    generator, order    state of the random generator, uint8; views still to come in this epoch
    regularizer         `Method.state`; of a training in it (a second field), the keys from `step` to `config`
    config              `TrainConfig` as nested plain types
    scene               `SceneReference` as plain types
"""

import io
import os
import sys
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from splat.model.gaussians import Gaussians
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split
from splat.training.densify import ScreenGradients
from splat.training.methods.methods import METHODS
from splat.training.optim.adam import Adam
from splat.training.start import Source
from splat.training.state import Method, MethodSettings, ThreeDGS, TrainConfig, Training
from splat.training.typed import Count, leaves, typed

FORMAT, VERSION = "splat-landscape checkpoint", 2
KIND = "expected a checkpoint written by landscape train"
REMEDY = "take another copy of the file, or train anew"


@dataclass(frozen=True)
class SceneReference:
    """Which scene a training belongs to, and how to load it as it was.

    absolute, relative: the scene's folder, and the same from the checkpoint's folder.  images: the folder of images in
    it, where one was named; downscale: the factor by which its images were reduced further.  train, test: names of the views;
    sizes: (width, height) of the training views, px.  start: what the Gaussians started from (`splat/training/start.py`);
    depths:
    the folder of depth maps, where one was named.  Older files have neither; they are read as "scene" and None.
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


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A training as it was saved, the scene that it belongs to, and the version of torch that wrote it."""

    training: Training
    scene: SceneReference
    torch_version: str

    def load_scene(self, path: Path, scene: Path | None = None) -> Scene:
        """The scene that this checkpoint, read from path, belongs to; scene: its folder, where it has moved.

        `scene.load(checkpoint.scene.train)` then gives the training views.  A COLMAP model's points, from which the Gaussians
        started, are not read again.  FileNotFoundError where there is no such folder; ValueError where the scene lacks a view
        or has one of another size.
        """
        reference = self.scene
        folder = reference.find(path) if scene is None else scene
        try:
            found = load_scene(
                folder, reference.images, reference.downscale, self.training.config.background, points=False
            )
            found.select([*reference.train, *reference.test])
        except (ValueError, FileNotFoundError) as error:
            if scene is None or not folder.is_dir():
                raise
            name = Path(reference.absolute).name
            raise InputError(
                f"expected the training's scene {name} in {folder}, got another or a part: {error}"
            ) from None
        for frame, size in zip(found.select(reference.train), reference.sizes, strict=True):
            if [frame.camera.width, frame.camera.height] != size:
                raise InputError(
                    f"expected view {frame.name!r} of {folder} at {size[0]} x {size[1]} px, as in the training, got "
                    f"{frame.camera.width} x {frame.camera.height}; its images have changed, restore them or train anew"
                )
        return found


def training_state(training: Training) -> dict[str, Any]:
    """All that a training depends on, as tensors and plain types: the keys from `step` to `config`."""
    return {
        "step": training.step,
        "extent": training.extent,
        "sh_degree": training.gaussians.sh_degree,
        "flat": training.gaussians.flat,
        "adam": {
            "first": training.adam.first.flat,
            "second": training.adam.second.flat,
            "updates": training.adam.updates,
        },
        "screen_gradients": {"total": training.screen_gradients.total, "renders": training.screen_gradients.renders},
        "generator": training.generator.get_state(),
        "order": training.order,
        "regularizer": {
            key: training_state(value) if isinstance(value, Training) else value
            for key, value in training.method.state().items()
        },
        "config": asdict(training.config),
    }


def save_checkpoint(path: Path, training: Training, scene: SceneReference) -> None:
    """Write the checkpoint, replacing one that is there only once the new one is complete on disk."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "torch": str(torch.__version__),
        **training_state(training),
        "scene": asdict(scene),
    }
    buffer = io.BytesIO()  # a file's own name would be among the bytes
    torch.save(_interned(content), buffer)
    write_atomically(path, buffer.getvalue())


def _interned(content: Any) -> Any:
    """The same content with one object for equal strings: pickle writes a string that it has met as a reference to it."""
    if isinstance(content, dict):
        return {_interned(key): _interned(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return type(content)(map(_interned, content))
    return sys.intern(content) if type(content) is str else content


def write_atomically(path: Path, content: bytes) -> None:
    """Put content at path, so that a reader or a crash sees either what was there before or all of it."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename is None:
            error.filename = str(path)  # a full disk's error has none
        raise


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint, its tensors on the CPU.

    OSError where there is none or the system does not give it, MemoryError where it does not fit; ValueError, of one line, that
    says what is wrong with it where it is damaged or of another kind.
    """
    if not path.is_file():
        found = f"a folder; name the {path / 'checkpoint.pt'} in it" if path.is_dir() else "no such file"
        raise FileNotFoundError(f"{KIND} at {path}, found {found}")
    with path.open("rb") as file:  # one file throughout: a training may replace it meanwhile
        content = _read(file, path)
    try:
        return _checkpoint(content)
    except ValueError as error:
        raise InputError(f"{KIND}, got {path}: {error}; {REMEDY}") from error


def _read(file: BinaryIO, path: Path) -> Any:
    """What torch saved, once the checksums are found to be right."""
    try:
        with zipfile.ZipFile(file) as archive:
            if wrong := archive.testzip():
                raise zipfile.BadZipFile(f"the checksum of {wrong} is wrong")
        file.seek(0)
        with warnings.catch_warnings(action="ignore"):  # torch warns of pickles of another kind before it refuses them
            return torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, MemoryError):
        raise  # of the system, not of the file
    except Exception as error:  # a file of another kind fails in torch in as many ways
        if "can't allocate memory" in str(error):  # torch's own MemoryError is a RuntimeError
            raise MemoryError(f"not enough memory to read {path}") from error
        ply = " (Gaussians from a PLY file cannot be read)" if path.suffix.lower() == ".ply" else ""
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise InputError(f"{KIND}, got {path}, which is not one or is damaged{ply}: {reason}; {REMEDY}") from error


@dataclass(frozen=True)
class _Moments:
    first: Tensor
    second: Tensor
    updates: Count


@dataclass(frozen=True)
class _ScreenGradients:
    total: Tensor
    renders: Tensor


@dataclass(frozen=True)
class _Training:
    """What `training_state` writes."""

    step: Count
    extent: float
    sh_degree: int
    flat: Tensor
    adam: _Moments
    screen_gradients: _ScreenGradients
    generator: Tensor
    order: list[Count]
    regularizer: dict[str, Any]
    config: dict[str, Any]


@dataclass(frozen=True)
class _File:
    """What a file has beside its training, for every version."""

    format: str
    version: int
    torch: str
    config: dict[str, Any]
    scene: dict[str, Any]


def _checkpoint(content: Any) -> Checkpoint:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"it does not hold the format {FORMAT!r}")
    file = typed(_File, content)
    if file.version not in (1, VERSION):
        raise InputError(f"its format version is {file.version}, this program reads up to {VERSION}")
    if file.version == 1:
        plain = ThreeDGS()
        content = {**content, "config": {**file.config, "method": asdict(plain)}, "regularizer": plain.create(0).state()}
    training, scene = restored_training(content), typed(SceneReference, file.scene, "scene")
    if len(scene.sizes) != len(scene.train):
        raise InputError(f"it has {len(scene.sizes)} sizes for {len(scene.train)} training views")
    if not all(index < len(scene.train) for index in training.order):
        raise InputError(f"its order does not index its {len(scene.train)} training views")
    return Checkpoint(training, scene, file.torch)


def restored_training(content: dict[str, Any]) -> Training:
    """The training of a state.  ValueError that says what is wrong with it."""
    saved = typed(_Training, content)
    adam, screen, shape, dtype = saved.adam, saved.screen_gradients, saved.flat.shape, saved.flat.dtype
    gaussians = Gaussians(_numbers("flat", saved.flat, (saved.flat.numel(),), dtype), saved.sh_degree)
    if not len(gaussians):
        raise InputError("it holds no Gaussian")
    gaussians.require_finite()
    config = _config(saved.config)
    each = (len(gaussians),)
    training = Training(
        config=config,
        extent=saved.extent,
        gaussians=gaussians,
        adam=Adam(
            gaussians.with_flat(_finite("adam.first", adam.first, shape, dtype, signed=True)),
            gaussians.with_flat(_finite("adam.second", adam.second, shape, dtype)),
            adam.updates,
        ),
        screen_gradients=ScreenGradients(
            _finite("screen_gradients.total", screen.total, each, dtype),
            _finite("screen_gradients.renders", screen.renders, each, dtype),
        ),
        generator=_generator(saved.generator),
        method=_method(config, saved.regularizer),
        order=saved.order,
        step=saved.step,
    )
    if training.step > config.iterations:
        raise InputError(f"its step {training.step} is not among its {config.iterations} iterations")
    if not 0 < training.extent < float("inf"):
        raise InputError(f"its extent is {training.extent}")
    if adam.updates > training.step:
        raise InputError(f"its optimiser has made {adam.updates} updates in {training.step} steps")
    return training


def _config(content: dict[str, Any]) -> TrainConfig:
    """The settings, each of which has to be there, but for those that older files did not know."""
    method, render = typed(dict[str, Any], content.get("method"), "config.method"), content.get("render")
    name = typed(str, method.get("name"), "config.method.name")
    if name not in METHODS:
        raise InputError(f"'config.method' has the unknown name {name[:80]!r}, expected one of {', '.join(METHODS)}")
    kind: type[MethodSettings] = METHODS[name]
    content = {**content, "method": {**kind.BEFORE, **method}}
    if isinstance(render, dict):
        content["render"] = {"sums": "ordered", **render}
    settings = typed(kind, content["method"], "config.method")
    config = replace(typed(TrainConfig, {**content, "method": {}}, "config"), method=settings)
    if different := leaves({"config": content}).keys() ^ leaves({"config": asdict(config)}).keys():
        raise InputError(f"'config' has missing or unknown keys: {', '.join(sorted(map(str, different)))}")
    return config


def _method(config: TrainConfig, state: dict[str, Any]) -> Method:
    method = config.method.create(config.seed)
    try:
        trainings = {key: restored_training(value) for key, value in state.items() if _is_training(value)}
        method.restore(state | trainings)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"'regularizer' is not the state of the method {config.method.name} ({error})") from error
    return method


def _is_training(value: Any) -> bool:
    return isinstance(value, dict) and "regularizer" in value


def _generator(state: Tensor) -> torch.Generator:
    try:
        return torch.Generator().set_state(state)
    except (RuntimeError, TypeError) as error:
        raise InputError(f"'generator' is not the state of a random generator ({error})") from error


def _numbers(key: str, value: Tensor, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """The tensor, if it holds as many numbers of this type, one by one, in memory."""
    kind = f"{value.dtype} of shape {tuple(value.shape)}"
    if tuple(value.shape) != tuple(shape) or value.dtype != dtype or dtype not in (torch.float32, torch.float64):
        raise InputError(f"'{key}' is {kind}, expected {dtype} {tuple(shape)}")
    if value.device.type != "cpu" or not value.is_contiguous():
        raise InputError(f"'{key}' is {kind} that does not hold its numbers one by one")
    return value


def _finite(key: str, value: Tensor, shape: Sequence[int], dtype: torch.dtype, signed: bool = False) -> Tensor:
    value = _numbers(key, value, shape, dtype)
    if not (value.isfinite() & (signed | (value >= 0))).all():
        raise InputError(f"'{key}' holds a number that is not finite{'' if signed else ', or a negative one'}")
    return value
