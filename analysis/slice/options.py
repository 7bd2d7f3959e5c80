"""Options of `landscape slice`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from analysis.console.options import CheckpointPath, Device, MostMemory, OtherTools
from splat.training.origin.options import Foreign

Along = Literal["eigenvectors", "random", "gradient", "line"]


@dataclass(frozen=True)
class SliceOptions:
    """Slice the training loss through a checkpoint: along a line or over a plane, with the quadratic model beside it.

    Of a plane both axes are rendered, and points between them until these predict the others well.  A slice that was killed
    continues when it is run again.
    """

    checkpoint: CheckpointPath
    others: Annotated[Positional[tuple[Path, ...]], arg(metavar="[OTHER [THIRD]]", help_behavior_hint="")] = ()
    """Where a line leads to: a checkpoint with as many Gaussians and the same SH degree.  Two: the plane through all three."""
    along: Annotated[Along | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Directions.  Default: eigenvectors, or line where OTHER is given.
    eigenvectors: of the two largest eigenvalues, from RUN/probe or else computed.
    random: filter-normalised, in each attribute of each Gaussian as long as that attribute is.
    gradient: the steepest ascent.  line: to OTHER."""
    dimension: Literal[1, 2] | None = None
    """1: a line; 2: a plane.  Default: 2 for eigenvectors, random and two OTHER checkpoints, 1 for gradient and line."""
    radius: Annotated[UseAppendAction[tuple[float, ...]], arg(help_behavior_hint="")] = ()
    """How far to look each way; given twice, one for each direction.
    eigenvectors: in curvature units, within which the curvature alone changes the loss by 0.1%.  Default: 3.
    random: as a share of each parameter's size.  Default: 0.001.
    gradient: in units of the parameters.  Default: 3 curvature units.
    line: beyond both ends, as a share of their distance.  Default: 0.5."""
    points: int = 41
    """Points along each direction, odd; a line to OTHER may get a few more or less."""
    tolerance: float = 0.01
    """Error of the points of a plane that are not rendered, as a share of the range of the loss."""
    all_points: bool = False
    """Render every point, whatever the tolerance."""
    device: Device = "auto"
    seed: int = 0
    """Seed of random directions, Lanczos's start, and the points that judge the interpolation."""
    out: Path | None = None
    """Folder of the results.  Default: such as slice-line-1d, beside the checkpoint."""
    memory: MostMemory = None
    foreign: OtherTools = field(default_factory=Foreign)
