"""Checkpoints: the state of a training and a reference to its scene, in one file; and the door to what is measured.

The file is a `torch.save` of a dictionary of tensors and plain types; its keys are the fields of `_File` and `_Training`.  It
is written atomically, and loaded with `weights_only=True`, so that nothing in it can run code, after a test of its checksums,
which torch omits.  The same training gives the same bytes.
"""

import io
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import inf
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from landscape.errors import InputError, lacks_memory
from splat.model.files.read import KINDS, is_foreign
from splat.model.files.tensor_files import is_archive, loaded
from splat.model.gaussians import Gaussians
from splat.model.typed import MOST, Count, leaves, typed
from splat.model.untrusted import require_content, write_atomically
from splat.training.adam import Adam
from splat.training.densify import ScreenGradients
from splat.training.methods.methods import METHODS
from splat.training.origin.foreign import foreign_training
from splat.training.origin.options import FILE, KIND, OF_ALL, Foreign, require_checkpoint
from splat.training.origin.subject import Checkpoint, SceneReference, Subject
from splat.training.state import Method, TrainConfig, Training

FORMAT, VERSION = "splat-landscape checkpoint", 3
REMEDY = "take another copy of the file, or train anew"


@dataclass(frozen=True)
class _Moments:
    """Adam's moments, (p,) each, and its number of updates."""

    first: Tensor
    second: Tensor
    updates: Count


@dataclass(frozen=True)
class _ScreenGradients:
    """`ScreenGradients`, (n,) each."""

    total: Tensor
    renders: Tensor


@dataclass(frozen=True)
class _Training:
    """A training of n Gaussians with p stored parameters, as `training_state` writes it.

    step: number of steps made.  extent: radius of the scene's cameras, world units.  sh_degree, flat, filter_widths: see
    `Gaussians`.  generator: state of the random generator, uint8.  order: indices of views still to come in this epoch.
    regularizer: `Method.state`; a training in it (such as a second set of Gaussians) has this same form.  config: `TrainConfig`
    as plain types.
    """

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
    filter_widths: Tensor | None = None


@dataclass(frozen=True)
class _File:
    """The keys beside those of the training.

    version: of the format.  torch: the version that wrote the file.  scene: `SceneReference` as plain types.
    """

    format: str
    version: int
    torch: str
    scene: SceneReference


def training_state(training: Training) -> dict[str, Any]:
    """The state of a training as tensors and plain types: the fields of `_Training`."""
    adam, screen, widths = training.adam, training.screen_gradients, training.gaussians.filter_widths
    return {
        **({} if widths is None else {"filter_widths": widths}),
        "step": training.step,
        "extent": training.extent,
        "sh_degree": training.gaussians.sh_degree,
        "flat": training.gaussians.flat,
        "adam": {"first": adam.first.flat, "second": adam.second.flat, "updates": adam.updates},
        "screen_gradients": {"total": screen.total, "renders": screen.renders},
        "generator": training.generator.get_state(),
        "order": training.order,
        "regularizer": {
            key: training_state(value) if isinstance(value, Training) else value
            for key, value in training.method.state().items()
        },
        "config": asdict(training.config),
    }


def save_checkpoint(path: Path, training: Training, scene: SceneReference) -> None:
    """Write the checkpoint atomically: an existing file is replaced once the new one is complete on disk."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "torch": str(torch.__version__),
        **training_state(training),
        "scene": asdict(scene),
    }
    buffer = io.BytesIO()  # in place of a file, whose name torch would write into it
    torch.save(_interned(content), buffer)
    write_atomically(path, buffer.getvalue())


def _interned(content: Any) -> Any:
    """The same content with one object for equal strings; else pickle's references, and so the bytes, would vary."""
    if isinstance(content, dict):
        return {_interned(key): _interned(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return type(content)(map(_interned, content))
    return sys.intern(content) if type(content) is str else content


def open_subject(path: str | Path, foreign: Foreign = Foreign(), out: Path | None = None) -> Subject:
    """A run, a checkpoint or another tool's file, with its scene: the door to all that can be measured.

    foreign: what the file does not say.  out: a refusal of another tool's file may leave a picture, OUT-mismatch.png; by
    default beside the file.  Errors: see `load_checkpoint`, `foreign_training` and `Checkpoint.with_scene`.

    >>> open_subject("nowhere/fern")
    Traceback (most recent call last):
        ...
    FileNotFoundError: expected a checkpoint written by landscape train at nowhere/fern, found no such file; name ...
    """
    path = Path(path)
    path = inside if (inside := path / FILE).is_file() else path
    checkpoint = open_checkpoint(path, foreign, out or path)
    subject = checkpoint.with_scene(path, foreign.scene, accept=foreign.accept_changed)
    return replace(subject, checkpoint=subject.checkpoint.thinned(subject.scene, foreign.max_views))


def open_checkpoint(path: Path, foreign: Foreign, out: Path, train: Sequence[str] | None = None) -> Checkpoint:
    """The checkpoint of `load_checkpoint`, or another tool's file as one; the others: see `foreign_training`.

    InputError also where something is said of another tool's file, and path is a checkpoint.
    """
    if is_foreign(path):
        return Checkpoint(*foreign_training(path, foreign, out.with_name(f"{out.name}-mismatch.png"), train))
    own, usual = load_checkpoint(path), vars(Foreign())
    if needless := [name for name, value in vars(foreign).items() if value != usual[name] and name not in OF_ALL]:
        raise InputError(
            f"expected no --{needless[0].replace('_', '-')} for {path}: a checkpoint of landscape train holds that already"
        )
    return own


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint, its tensors on the CPU.

    OSError where there is none or it cannot be read; MemoryError, or torch's error, where memory is short; InputError, which
    says what is wrong, where it is damaged or of another kind.

    >>> load_checkpoint("nowhere/checkpoint.pt")
    Traceback (most recent call last):
        ...
    FileNotFoundError: expected a checkpoint written by landscape train at nowhere/checkpoint.pt, found no such file; name ...
    """
    path = Path(path)
    require_checkpoint(path)
    require_content(path)
    with path.open("rb") as file:  # one file throughout: a training may replace it meanwhile
        content = _read(file, path)
    try:
        return _checkpoint(content)
    except InputError as error:
        raise InputError(f"{KIND}, got {path}: {error}; {REMEDY}") from error


def _read(file: BinaryIO, path: Path) -> Any:
    """The content that torch saved, after a test of its checksums."""
    try:
        return loaded(file)
    except InputError as error:
        runs = [folder for folder in path.absolute().parents[:2] if (folder / FILE).is_file()]
        if runs and path.name != FILE and not is_archive(file):
            raise InputError(f"{KIND}, got {path}, another file of the run {runs[0]}; name that run") from error
        if path.suffix.lower() not in (".pt", ".pth", ".ply") and not is_archive(file):
            raise InputError(f"{KIND}, or a file of Gaussians ({KINDS}), got {path}, which is neither") from error
        ply = " (of other tools' files, probe, slice and convert read those)" if path.suffix.lower() == ".ply" else ""
        raise InputError(f"{KIND}, got {path}, which is not one or is damaged{ply}: {error}; {REMEDY}") from error


def _checkpoint(content: Any) -> Checkpoint:
    """The checkpoint with this content.  InputError that says what is wrong with it."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"it does not hold the format {FORMAT!r}")
    if (version := typed(Count, content.get("version"), "format version")) != VERSION:
        raise InputError(f"its format version is {version}, this program reads {VERSION}")
    file = typed(_File, content)
    training, scene = restored_training(content), file.scene
    if unseen := [name for name in (*scene.train, *scene.test) if name not in scene.views]:
        raise InputError(f"it does not say what was seen of {len(unseen)} of its views, such as {unseen[0][:80]!r}")
    if not all(index < len(scene.train) for index in training.order):
        raise InputError(f"its order does not index its {len(scene.train)} training views")
    return Checkpoint(training, scene)


def restored_training(content: dict[str, Any]) -> Training:
    """The training of a `training_state`.  InputError that says what is wrong with it."""
    saved = typed(_Training, content)
    adam, screen, p, dtype = saved.adam, saved.screen_gradients, saved.flat.numel(), saved.flat.dtype
    gaussians = Gaussians(_numbers("flat", saved.flat, p, dtype), saved.sh_degree)
    n = len(gaussians)
    if saved.filter_widths is not None:
        gaussians = gaussians.with_filter(_numbers("filter_widths", saved.filter_widths, n, dtype))
    gaussians.require_finite()
    config = _config(saved.config)
    if saved.step > config.iterations:
        raise InputError(f"its step {saved.step} is not among its {config.iterations} iterations")
    if not 0 < saved.extent <= MOST:
        raise InputError(f"its extent is {saved.extent}")
    if adam.updates > saved.step:
        raise InputError(f"its optimiser has made {adam.updates} updates in {saved.step} steps")
    first, second = _numbers("first", adam.first, p, dtype, -inf), _numbers("second", adam.second, p, dtype, 0.0)
    sums = _numbers("total", screen.total, n, dtype, 0.0), _numbers("renders", screen.renders, n, dtype, 0.0)
    return Training(
        config=config,
        extent=saved.extent,
        gaussians=gaussians,
        adam=Adam(gaussians.with_flat(first), gaussians.with_flat(second), adam.updates),
        screen_gradients=ScreenGradients(*sums),
        generator=_generator(saved.generator),
        method=_method(config, saved.regularizer),
        order=saved.order,
        step=saved.step,
    )


def _config(content: dict[str, Any]) -> TrainConfig:
    """The settings of a training: all have to be there."""
    method = typed(dict[str, Any], content.get("method"), "config.method")
    name = typed(str, method.get("name"), "config.method.name")
    if name not in METHODS:
        raise InputError(f"'config.method' has the unknown name {name[:80]!r}, expected one of {', '.join(METHODS)}")
    config = typed(TrainConfig, {**content, "method": {}}, "config")
    config = replace(config, method=typed(METHODS[name], method, "config.method"))
    if different := leaves(content).keys() ^ leaves(asdict(config)).keys():
        raise InputError(f"'config' has missing or unknown keys: {', '.join(sorted(map(str, different)))}")
    return config


def _method(config: TrainConfig, state: dict[str, Any]) -> Method:
    """The method with its state; a dictionary with a "regularizer" in it is a training."""
    method = config.method.create(config.seed)
    trainings = {key: value for key, value in state.items() if isinstance(value, dict) and "regularizer" in value}
    try:
        method.restore(state | {key: restored_training(value) for key, value in trainings.items()})
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        if lacks_memory(error):
            raise
        raise InputError(f"'regularizer' is not the state of the method {config.method.name} ({error})") from error
    return method


def _generator(state: Tensor) -> torch.Generator:
    try:
        return torch.Generator().set_state(state)
    except (RuntimeError, TypeError) as error:
        raise InputError(f"'generator' is not the state of a random generator ({error})") from error


def _numbers(key: str, value: Tensor, count: int, dtype: torch.dtype, least: float | None = None) -> Tensor:
    """The tensor, if it has shape (count,) and dtype, is contiguous and on the CPU; least: also finite and not below this."""
    if value.is_nested or value.layout != torch.strided or value.requires_grad:
        raise InputError(f"'{key}' is a tensor of another kind than numbers in a row")
    kind = f"{value.dtype} of shape {tuple(value.shape)}"
    if tuple(value.shape) != (count,) or value.dtype != dtype or dtype not in (torch.float32, torch.float64):
        raise InputError(f"'{key}' is {kind}, expected {dtype} {(count,)}")
    if value.device.type != "cpu" or not value.is_contiguous():
        raise InputError(f"'{key}' is {kind} that does not hold its numbers one by one")
    if least is not None and not ((value >= least) & value.isfinite()).all():
        raise InputError(f"'{key}' holds a number that is not finite{', or a negative one' if least == 0 else ''}")
    return value
