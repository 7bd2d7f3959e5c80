"""Options of `landscape sfm`, `convert`, `map`, `view` and `demo`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from analysis.console.options import CheckpointPath, OtherTools
from splat.training.origin.options import Foreign


@dataclass(frozen=True)
class SfmOptions:
    """Make a scene from a folder of photographs: find where each was taken, with pycolmap."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of the photographs: at least 3 of one scene that does not move, from different places."""
    out: Path | None = None
    """Folder of the scene, which must not exist yet.  Default: PHOTOS-scene, beside the photographs."""


@dataclass(frozen=True)
class ConvertOptions:
    """Convert Gaussians between tools: read whatever probe reads; write a PLY as 3DGS does, a gsplat checkpoint, or our own.

    Numbers of 32 bits stay the same bits.  Our own needs the scene, and is what compare, train and bench take.
    depths writes what the Gaussians show of the scene's views as depth maps, which train takes with --depths.
    """

    source: Annotated[Positional[Path], arg(metavar="IN")]
    """The file to read."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """The file to write, of depths the folder, which must not exist yet."""
    to: Literal["graphdeco", "gsplat", "own", "depths"] | None = None
    """What to write.  Default: graphdeco's PLY where OUT ends in .ply, else our own checkpoint."""
    foreign: OtherTools = field(default_factory=Foreign)


@dataclass(frozen=True)
class MapOptions:
    """Show where a scene is curved: numbers of every Gaussian as PLY and CSV, and as pictures over every training view."""

    checkpoint: CheckpointPath
    shown: Annotated[str, arg(name="field")] = "largest"
    """The number that pictures, colours and the top of the table show; any in fields.ply.
    Where RUN/probe holds eigenvectors, also e1 and e_min: the Gaussians' shares of them."""
    draw: UseAppendAction[tuple[str, ...]] = ()
    """A training view to draw, by name or by place (0 is the first); may be given again.  Default: all of them."""
    seed: int = 0
    """Seed of the pairs of neighbours whose swap is rendered."""
    out: Path | None = None
    """Folder of the results.  Default: map, beside the checkpoint."""
    foreign: OtherTools = field(default_factory=Foreign)


@dataclass(frozen=True)
class ViewOptions:
    """Show a scene in the browser in the colours of any field of its Gaussians, and follow the steepest directions."""

    checkpoint: CheckpointPath
    shown: Annotated[str, arg(name="field")] = "largest"
    """What colours the splats at first: a field as of landscape map, or appearance."""
    port: int = 8080
    """Where the page is served; the next free one where it is taken."""
    host: str = "127.0.0.1"
    """Who may open the page; 0.0.0.0: everybody who reaches this machine."""
    html: Path | None = None
    """Write a page that needs no server to this file instead: cameras, and splats whose colours are switched between
    some fields.
    RUN/view.html is linked to by the probe's report."""
    foreign: OtherTools = field(default_factory=Foreign)


@dataclass(frozen=True)
class DemoOptions:
    """Train and probe an embedded synthetic scene, and say which page to open."""

    out: Path = Path("runs/demo")
    """Folder of the demo's scene and run.  An interrupted demo is continued; a whole one stays, and OUT-2, ... is used."""
