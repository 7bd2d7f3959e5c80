"""Options of `landscape slice`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from analysis.console.options import DeviceName, Foreign, ForeignOptions, MostMemory, SceneFolder, Unset

Along = Literal["eigenvectors", "random", "gradient", "line"]


@dataclass(frozen=True)
class SliceOptions:
    """Slice the training loss through a checkpoint: along a line or over a plane, with the quadratic model beside it.

    Of a plane both axes are rendered, and points between them until these predict the others well.  A slice that was killed
    continues when it is run again.
    """

    checkpoint: Annotated[Positional[Path], arg(metavar="CHECKPOINT")]
    """RUN/checkpoint.pt, as written by landscape train, or a file of another tool, such as point_cloud.ply."""
    others: Annotated[Positional[tuple[Path, ...]], arg(metavar="[OTHER [THIRD]]", help_behavior_hint="")] = ()
    """Where a line leads to: a checkpoint with as many Gaussians and the same SH degree.  Two: the plane through all three."""
    along: UseAppendAction[tuple[Along, ...]] = ()
    """Directions; given twice, the plane of the first direction of each.  Default: eigenvectors, or line where OTHER is given.
    eigenvectors: of the two largest eigenvalues, from RUN/probe or else computed.
    random: filter-normalised, in each attribute of each Gaussian as long as that attribute is.
    gradient: the steepest ascent.
    line: to OTHER."""
    dimension: Unset[Literal[1, 2]] = None
    """1: a line; 2: a plane.  Default: 2 for eigenvectors, random and two OTHER checkpoints, 1 for gradient and line."""
    radius: UseAppendAction[tuple[float, ...]] = ()
    """How far to look each way; given twice, one for each direction.
    eigenvectors: in curvature units: the step within which the curvature alone changes the loss by 0.1%.  Default: 3.
    random: as a share of each parameter's size.  Default: 0.001.
    gradient: in stored units.  Default: 3 curvature units.
    line: how far beyond both ends, as a share of their distance.  Default: 0.5."""
    points: int = 41
    """Points along each direction, odd; a line to OTHER may get a few more or less."""
    tolerance: float = 0.01
    """Error of the points of a plane that are interpolated instead of rendered, as a share of the range of the loss.
    Both axes are rendered in full; where too few renders are made to reach it, no surface is drawn."""
    all_points: FlagCreatePairsOff[bool] = False
    """Render every point, whatever the tolerance."""
    max_renders: Unset[int] = None
    """Points that are rendered at most (each in all training views), with those before an interruption.  Default: no limit."""
    workers: Unset[int] = None
    """Points rendered at a time, each on one thread.  Default: one for each processor; one on a GPU."""
    device: DeviceName = "auto"
    """Where to work.  auto: on the GPU where there is one that can be used, else on the CPU."""
    seed: int = 0
    """Seed of random directions, of the start of Lanczos, and of the points that judge the interpolation."""
    scene: SceneFolder = None
    out: Unset[Path] = None
    """Folder of the results.  Default: beside the checkpoint, such as slice-eigenvectors-2d or slice-line-1d."""
    memory: MostMemory = None
    foreign: Foreign = field(default_factory=ForeignOptions)
