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
    regularizer         state of the method's regularizer, see `splat/training/state.py`; of a training in it, the
                        keys from `step` to `config`
    config              `TrainConfig` as nested plain types
    scene               `SceneReference` as plain types
"""

import io
import os
import sys
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import torch
from torch import Tensor

from splat.model.gaussians import Gaussians
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split
from splat.training.densify import ScreenGradients
from splat.training.methods.methods import METHODS
from splat.training.optim.adam import Adam
from splat.training.plain_types import fits, short
from splat.training.start import Source
from splat.training.state import Method, Regularizer, ThreeDGS, TrainConfig, Training

FORMAT, VERSION = "splat-landscape checkpoint", 2


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
            raise ValueError(
                f"expected the training's scene {name} in {folder}, got another or a part: {error}"
            ) from None
        for frame, size in zip(found.select(reference.train), reference.sizes, strict=True):
            if [frame.camera.width, frame.camera.height] != size:
                raise ValueError(
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
        "screen_gradients": {
            "total": training.screen_gradients.total,
            "renders": training.screen_gradients.renders,
        },
        "generator": training.generator.get_state(),
        "order": training.order,
        "regularizer": {
            key: training_state(value) if isinstance(value, Training) else value
            for key, value in training.regularizer.state().items()
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

    OSError where there is none or it may not be read; ValueError, which says what is wrong with it, where it is damaged or of
    another kind.
    """
    if not path.is_file():
        found = f"a folder; name the {path / 'checkpoint.pt'} in it" if path.is_dir() else "no such file"
        raise FileNotFoundError(f"expected a checkpoint written by landscape train at {path}, found {found}")
    damaged = ValueError(
        f"expected a checkpoint written by landscape train, got {path}, which is not one or is damaged"
        f"{' (Gaussians from a PLY file cannot be read)' if path.suffix.lower() == '.ply' else ''}"
    )
    with path.open("rb") as file:  # one file throughout: a training may replace it meanwhile
        try:
            with zipfile.ZipFile(file) as archive:
                whole = archive.testzip() is None
            file.seek(0)
            with warnings.catch_warnings(
                action="ignore"
            ):  # torch warns of pickles of another kind before it refuses them
                content = torch.load(file, map_location="cpu", weights_only=True)
        except Exception:  # what torch stumbles over in a file of another kind is of many kinds too
            raise damaged from None
    if not whole:
        raise damaged
    try:
        return _checkpoint(content)
    except ValueError as error:
        raise ValueError(f"expected a checkpoint written by landscape train, got {path}: {error}") from None


def _checkpoint(content: Any) -> Checkpoint:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"it does not hold the format {FORMAT!r}")
    version = _get(content, "version", int)
    if version not in (1, VERSION):
        raise ValueError(f"its format version is {version!r}, this program reads up to {VERSION}")
    if version == 1:
        config = {**_get(content, "config", dict), "method": asdict(ThreeDGS())}
        content = {**content, "config": config, "regularizer": Regularizer(0).state()}
    training = restored_training(content)
    scene = _dataclass(SceneReference, {"start": "scene", "depths": None, **_get(content, "scene", dict)}, "scene")
    if len(scene.sizes) != len(scene.train):
        raise ValueError(f"it has {len(scene.sizes)} sizes for {len(scene.train)} training views")
    if not all(type(index) is int and 0 <= index < len(scene.train) for index in training.order):
        raise ValueError(f"its order does not index its {len(scene.train)} training views")
    return Checkpoint(training, scene, _get(content, "torch", str))


def restored_training(content: dict[str, Any]) -> Training:
    """The training of a state.  ValueError that says what is wrong with it."""
    flat = _get(content, "flat", Tensor)
    gaussians = Gaussians(_tensor(content, "flat", (flat.numel(),), flat.dtype), _get(content, "sh_degree", int))
    if not len(gaussians):
        raise ValueError("it holds no Gaussian")
    gaussians.require_finite()
    config = _get(content, "config", dict)
    if isinstance(thresholds := config.get("render"), dict):
        config = {**config, "render": {"sums": "ordered", **thresholds}}  # a choice that older checkpoints did not have
    config = _dataclass(TrainConfig, config, "config")
    regularizer = config.method.regularizer(config.seed)
    _restore(regularizer, _get(content, "regularizer", dict))
    adam, screen = _get(content, "adam", dict), _get(content, "screen_gradients", dict)
    training = Training(
        config=config,
        extent=_get(content, "extent", float),
        gaussians=gaussians,
        adam=Adam(
            gaussians.with_flat(_finite(adam, "first", flat.shape, flat.dtype, signed=True)),
            gaussians.with_flat(_finite(adam, "second", flat.shape, flat.dtype)),
            _get(adam, "updates", int),
        ),
        screen_gradients=ScreenGradients(
            _finite(screen, "total", (len(gaussians),), flat.dtype),
            _finite(screen, "renders", (len(gaussians),), flat.dtype),
        ),
        generator=_generator(_get(content, "generator", Tensor)),
        regularizer=regularizer,
        order=_get(content, "order", list),
        step=_get(content, "step", int),
    )
    if not 0 <= training.step <= config.iterations:
        raise ValueError(f"its step {training.step} is not among its {config.iterations} iterations")
    if not 0 < training.extent < float("inf"):
        raise ValueError(f"its extent is {training.extent}")
    if not 0 <= training.adam.updates <= training.step:
        raise ValueError(f"its optimiser has made {short(training.adam.updates)} updates in {training.step} steps")
    return training


T = TypeVar("T")


def _get(content: dict, key: str, kind: type[T]) -> T:
    if key not in content:
        raise ValueError(f"{key!r} is missing")
    value = content[key]
    if not isinstance(value, kind):
        raise ValueError(f"{key!r} is {type(value).__name__}, expected {kind.__name__}")
    return value


def _tensor(content: dict, key: str, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    value = _get(content, key, Tensor)
    kind = f"{value.dtype} of shape {tuple(value.shape)}"
    if tuple(value.shape) != tuple(shape) or value.dtype != dtype or dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{key!r} is {kind}, expected {dtype} {tuple(shape)}")
    if value.device.type != "cpu" or not value.is_contiguous():
        raise ValueError(f"{key!r} is {kind} that does not hold its numbers one by one")
    return value


def _finite(content: dict, key: str, shape: Sequence[int], dtype: torch.dtype, signed: bool = False) -> Tensor:
    value = _tensor(content, key, shape, dtype)
    if not (value.isfinite() & (signed | (value >= 0))).all():
        raise ValueError(f"{key!r} holds a number that is not finite{'' if signed else ', or a negative one'}")
    return value


def _is_training(value: Any) -> bool:
    return isinstance(value, dict) and "regularizer" in value


def _restore(regularizer: Regularizer, state: dict) -> None:
    try:
        regularizer.restore(
            {key: restored_training(value) if _is_training(value) else value for key, value in state.items()}
        )
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"'regularizer' is not the state of its method ({error}); take another copy of the file, or train anew"
        ) from None


def _generator(state: Tensor) -> torch.Generator:
    generator = torch.Generator()
    try:
        return generator.set_state(state)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"'generator' is not the state of a random generator ({error})") from None


def _dataclass(kind: type[T], content: dict, where: str) -> T:
    """A dataclass, and those in it, from what `asdict` made of it; its own checks apply."""
    hints = get_type_hints(kind)
    if set(content) != set(hints):
        different = sorted(map(str, set(content) ^ set(hints)))
        raise ValueError(f"{where!r} has missing or unknown keys: {', '.join(different)}")
    values = {}
    for key, hint in hints.items():
        value = content[key]
        if inner := _nested(hint, value, f"{where}.{key}"):
            value = _dataclass(inner, _get(content, key, dict), f"{where}.{key}")
        elif not fits(value, hint):
            raise ValueError(f"'{where}.{key}' is {short(value)}, expected {getattr(hint, '__name__', hint)}")
        values[key] = value
    return kind(**values)


def _nested(hint: Any, value: Any, where: str) -> type | None:
    """The dataclass that a value is of, a method's by its name; None where no dataclass is expected."""
    if hint is not Method:
        return hint if isinstance(hint, type) and is_dataclass(hint) else None
    name = value.get("name") if isinstance(value, dict) else value
    if isinstance(name, str) and name in METHODS:
        return METHODS[name]
    raise ValueError(f"'{where}' has the unknown name {short(name)}")
