"""Options of `landscape sfm`, `convert`, `map`, `view`, `demo`, `prune`, `next-view` and `uncertainty`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from analysis.console.options import CheckpointPath, OtherTools
from splat.training.origin.options import Foreign

GEOMETRY = ("coverage", "farthest", "uniform")  # rules of next-view that ask for no curvature
TWICE = 2.0  # errors, within which its candidates are equal


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


@dataclass(frozen=True)
class PruneOptions:
    """Remove the Gaussians that matter least, by scores of exact curvature, and show what each score is worth."""

    checkpoint: CheckpointPath
    keep: float = 0.5
    """Share of the Gaussians to keep, above 0."""
    score: str = "removal_error_l2"
    """By which they are chosen.
    removal_error, removal_error_l2: the rise of the loss, or of the squared error, without the Gaussian, to second order.
    log_det_6, log_det_11, gn_diagonal: log-determinants of its Gauss-Newton block, PUP 3D-GS's and whole, and its diagonal.
    opacity, size_opacity: as they are."""
    curve: bool = False
    """Also score every --score at 0 to 95% removed, on training and held-out views, and after 300 steps at 50% and 90%,
    without density control, of three seeds."""
    sample: int = 200
    """Gaussians that are really removed, one at a time, as the truth that scores are compared with."""
    seed: int = 0
    """Seed of the sample and of the refinement."""
    out: Path | None = None
    """Folder of the results.  Default: prune, beside the checkpoint."""
    foreign: OtherTools = field(default_factory=Foreign)


@dataclass(frozen=True)
class NextViewOptions:
    """Say which further photograph would tell most about a scene, before it is taken."""

    checkpoint: Annotated[Positional[Path], arg(metavar="CHECKPOINT")]
    """RUN or RUN/checkpoint.pt, as written by landscape train, or a file of another tool, such as point_cloud.ply."""
    candidates: UseAppendAction[tuple[str, ...]] = ()
    """A view of the scene whose camera to judge, by name; may be given again.
    Default: all that are neither trained on nor held out."""
    take: int = 1
    """How many to choose, one after the other, each knowing those before it."""
    by: str = "d"
    """By which gain: d (log-determinant of each Gaussian's block), t (trace), e (least eigenvalue), d_diagonal, or published
    (FisherRF's)."""
    out: Path | None = None
    """Folder of the results.  Default: next-view, beside the checkpoint."""
    foreign: OtherTools = field(default_factory=Foreign)


@dataclass(frozen=True)
class UncertaintyOptions:
    """Show what a scene does not know of its held-out views beside its true errors there, and how well the two agree."""

    checkpoint: CheckpointPath
    samples: int = 64
    """Random vectors for the variance of a pixel, which is known to a share of sqrt(2 / samples)."""
    seed: int = 0
    """Seed of these."""
    out: Path | None = None
    """Folder of the results.  Default: uncertainty, beside the checkpoint."""
    foreign: OtherTools = field(default_factory=Foreign)
