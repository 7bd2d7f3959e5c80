"""Options of `landscape sfm` and `landscape demo`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from analysis.console.options import Unset


@dataclass(frozen=True)
class SfmOptions:
    """Make a scene from a folder of photographs: find where each was taken, with pycolmap."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of the photographs: at least 3 of one scene that does not move, from different places."""
    out: Unset[Path] = None
    """Folder of the scene, which must not exist yet.  Default: PHOTOS-scene, beside the photographs."""


@dataclass(frozen=True)
class DemoOptions:
    """Train and probe an embedded synthetic scene, and say which pictures to open."""

    out: Path = Path("runs/demo")
    """Folder of the demo's scene and run.  Where it exists, the next free of OUT-2, OUT-3, ... is used."""
