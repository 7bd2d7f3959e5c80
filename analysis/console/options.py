"""Types that the options of several commands share.

Each command's options are a plain dataclass beside the command, in an `options.py` that imports nothing heavy: help is quick.
The help keeps the line breaks of their docstrings: a line is a sentence.
"""

from collections.abc import Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, Suppress, arg
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from landscape.errors import InputError, did_you_mean
from splat.training.origin.options import Foreign, Trainer

DeviceName = Literal["auto", "cpu", "cuda"]
Device = Annotated[DeviceName, arg(metavar="NAME", help="cpu, cuda; auto: a GPU that can be used, else the CPU.")]
QUIET = "quiet"  # a mark of dataclasses that `registry` has read


def require_known(option: str, given: str, known: Sequence[str]) -> None:
    """InputError unless an option has one of the known values."""
    if given not in known:
        raise InputError(f"expected --{option} {', '.join(known)}, got {given!r}{did_you_mean(given, known)}")


def registry(*, foreign: bool = True) -> ConstructorRegistry:
    """How tyro reads options.  foreign: whether it reads, and its help shows, those of other tools' files.

    None and flags go unsaid as defaults; a flag is only what it changes.
    """
    made = ConstructorRegistry()

    def kind(of: Any, field: StructFieldSpec) -> Any:
        if isinstance(field.default, Trainer):
            return field.type if foreign else Annotated[field.type, Suppress]
        quiet = (arg(help_behavior_hint=""), FlagCreatePairsOff) if isinstance(field.default, bool | None) else ()
        within = (arg(prefix_name=False),) if issubclass(of, Trainer) else ()  # a group of their own
        return Annotated[(field.type, *quiet, *within, None)]

    @made.struct_rule
    def _(info: StructTypeInfo) -> StructConstructorSpec | None:
        if not is_dataclass(info.type) or QUIET in info.markers:
            return None
        found = ConstructorRegistry.get_struct_spec(replace(info, markers=(*info.markers, QUIET)))
        assert isinstance(found, StructConstructorSpec)
        return replace(found, fields=tuple(replace(each, type=kind(info.type, each)) for each in found.fields))

    return made


CheckpointPath = Annotated[
    Positional[Path],
    arg(
        metavar="CHECKPOINT",
        help="RUN or RUN/checkpoint.pt, as written by landscape train, or a file of another tool, such as point_cloud.ply.",
    ),
]
MostMemory = Annotated[str | None, arg(help="The most memory to take, such as 8GB.  Default: what is free.")]
GROUP = arg(name="other-tools", help="--scene and the last two are of our own checkpoints too.")
OfTrainer = Annotated[Trainer, GROUP]
OtherTools = Annotated[Foreign, GROUP]
