"""Options of `landscape probe`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from analysis.console.options import CheckpointPath, Device, MostMemory, OtherTools
from splat.training.origin.options import Foreign


@dataclass(frozen=True)
class ProbeOptions:
    """Measure the loss landscape at a checkpoint: traces, extreme eigenvalues, anisotropy, a slice."""

    checkpoint: CheckpointPath
    out: Path | None = None
    """Folder of the results.  Default: probe, beside the checkpoint."""
    seed: int = 0
    """Seed of the random vectors."""
    device: Device = "auto"
    loss: Annotated[Literal["training", "3dgs"], arg(metavar="NAME")] = "training"
    """training: that of the checkpoint's training.
    3dgs: that of 3DGS, to compare trainings with other losses."""
    strict: bool = False
    """Exit with 1 if a self-check fails."""
    quick: bool = False
    """Numbers to 10%, in a quarter to half of the time, into probe-quick; without density, indices that need it, power
    iteration, depth, and the slice's plane."""
    density_products: int | None = None
    """Of the spectral density; more narrow the brackets of sums.  Default: 108."""
    end_products: int | None = None
    """At most, of the search for the extreme eigenvalues.  Default: 3000."""
    slice_points: int | None = None
    """Along each side of the slice, odd, 5 or more.
    Default: 41; 21 with --quick, or of 10 views or more."""
    per_attribute: bool = False
    """Also anisotropy of all attributes and of each, by four times as many products as the rest.
    Not under torchrun."""
    split_control: bool = False
    """The same, and of the scene with every Gaussian split in two: what their number alone does.  2.5 times as long."""
    metric: Annotated[Literal["parameters", "optimiser"], arg(metavar="NAME")] = "parameters"
    """Units of --per-attribute, which it implies.
    parameters: as stored.  optimiser: of the first step's learning rates."""
    measures: bool = False
    """Also order fragility, field sharpness, critical sharpness, that of Adam's own scaling, and open
    curvature, at the training views and at the cameras of those held out, in an eighth of a probe's time."""
    memory: MostMemory = None
    foreign: OtherTools = field(default_factory=Foreign)
