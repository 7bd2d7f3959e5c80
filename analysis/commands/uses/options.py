"""Options of the commands that put exact curvature to use: `landscape prune`, `next-view`, `uncertainty`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from analysis.console.options import CheckpointPath, OtherTools
from splat.training.origin.options import Foreign

GEOMETRY = ("coverage", "farthest", "uniform")  # rules of next-view that ask for no curvature
TWICE = 2.0  # errors, within which its candidates are equal


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
