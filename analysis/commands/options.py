"""Options of `landscape sfm` and `landscape demo`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from analysis.console.options import ForeignOptions, Unset


@dataclass(frozen=True)
class SfmOptions:
    """Make a scene from a folder of photographs: find where each was taken, with pycolmap."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of the photographs: at least 3 of one scene that does not move, from different places."""
    out: Unset[Path] = None
    """Folder of the scene, which must not exist yet.  Default: PHOTOS-scene, beside the photographs."""


@dataclass(frozen=True)
class ConvertOptions:
    """Convert Gaussians between tools: read whatever probe reads; write a PLY as 3DGS does, a gsplat checkpoint, or our own.

    Numbers of 32 bits stay the same bits.  Our own needs the scene, and is what compare, train and bench take.
    """

    source: Annotated[Positional[Path], arg(metavar="IN")]
    """The file to read."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """The file to write, which must not exist yet."""
    to: Unset[Literal["graphdeco", "gsplat", "own"]] = None
    """What to write.  Default: graphdeco's PLY where OUT ends in .ply, else our own checkpoint."""
    scene: Unset[Path] = None
    """Folder of the scene, for our own checkpoint."""
    foreign: Annotated[ForeignOptions, arg(name="")] = field(default_factory=ForeignOptions)


@dataclass(frozen=True)
class DemoOptions:
    """Train and probe an embedded synthetic scene, and say which pictures to open."""

    out: Path = Path("runs/demo")
    """Folder of the demo's scene and run.  Where it exists, the next free of OUT-2, OUT-3, ... is used."""
