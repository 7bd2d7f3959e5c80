"""Types that the options of several commands share.

Each command's options are a plain dataclass beside the command, in an `options.py` that imports nothing heavy: help is quick.
The help keeps the line breaks of their docstrings: a line is a sentence.
"""

from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from tyro.conf import FlagCreatePairsOff, Positional, arg
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

DeviceName = Literal["auto", "cpu", "cuda"]
T = TypeVar("T")
Unset = Annotated[T | None, arg(help_behavior_hint="")]  # its docstring says what stands for None
REGISTRY = ConstructorRegistry()


@REGISTRY.primitive_rule
def _unset_choices(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Of Unset[Literal[...]]: tyro's own rule names None among the choices where it refuses another."""
    kinds = get_args(info.type)
    choices = [kind for kind in kinds if get_origin(kind) is Literal]
    if NoneType not in kinds or len(choices) != len(kinds) - 1:
        return None
    known = {str(value): value for kind in choices for value in get_args(kind)}
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(known)}}}",
        instance_from_str=lambda words: known[words[0]],
        is_instance=lambda value: value is None or value in known.values(),
        str_from_instance=lambda value: [str(value)],
        choices=tuple(known),
    )


@dataclass(frozen=True)
class TrainerOptions:
    """What a file that another tool trained does not say of its trainer."""

    trained_by: Unset[str] = None
    """Of another tool's file: whose conventions to follow.
    graphdeco, gsplat (up to 1.5; gsplat-raw without normalisation of the world), gsplat-1.6, nerfstudio, brush, lichtfeld,
    mip-splatting.
    Default: what the file says."""
    antialiased: FlagCreatePairsOff[bool] = False
    """Of another tool's file that does not say so: its renderer was antialiased."""
    opacity_reg: Unset[float | Literal["trained"]] = None
    """Of another tool's file: a weight of the mean opacity in the loss, as MCMC trainers have it.
    trained: that of its training, which the settings beside it say (cfg.yml, config.yml).  Default: 0."""
    scale_reg: Unset[float | Literal["trained"]] = None
    """Of another tool's file: the same of the mean scale."""


@dataclass(frozen=True)
class ForeignOptions(TrainerOptions):
    """What a file that another tool trained does not say; a checkpoint of landscape train holds all but the last two."""

    views: Unset[int | Literal["all"]] = None
    """Of another tool's file: number of its training views, by the scene's protocol.
    Default: what the tool's files say, else all that are not held out."""
    train_list: Unset[Path] = None
    """Of another tool's file: a text file with the name of a training view in each line."""
    images: Unset[str] = None
    """Of another tool's file: folder of images within the scene."""
    downscale: Unset[float] = None
    """Of another tool's file: factor by which its images were reduced.  Default: what its tool does."""
    max_views: Unset[int] = None
    """Measure on at most so many training views, spread evenly over the cameras.  Default: all."""
    accept_changed: FlagCreatePairsOff[bool] = False
    """Go on where cameras, photographs or masks are not as they were in the training, which is said and refused else."""


CheckpointPath = Annotated[
    Positional[Path],
    arg(
        metavar="CHECKPOINT",
        help="RUN or RUN/checkpoint.pt, as written by landscape train, or a file of another tool, such as point_cloud.ply.",
    ),
]
SceneFolder = Annotated[
    Unset[Path], arg(help="Folder of the scene: where it has moved since the training, or of another tool's file.")
]
MostMemory = Annotated[
    Unset[str],
    arg(
        help="The most memory that the command takes, such as 8GB; one that cannot be done in it says what would fit.\n"
        "Default: what is free.  On the CPU."
    ),
]
Foreign = Annotated[ForeignOptions, arg(name="")]  # its options as the command's own
