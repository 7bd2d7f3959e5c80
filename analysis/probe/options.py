"""Options of `landscape probe`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

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
    loss: Literal["training", "3dgs"] = "training"
    """Whose curvature.  training: the loss that the checkpoint was trained with.
    3dgs: that of 3DGS, whatever it was trained with, so that trainings with other losses can be compared."""
    strict: bool = False
    """Exit with 1 if a self-check fails; the record is written all the same."""
    verbose: bool = False
    """Print every number, not only a summary."""
    quick: bool = False
    """Numbers to 10% instead of 1%, in a quarter of the time, into a folder of their own (probe-quick).
    Without the spectral density and the indices that need it, power iteration, the finite probe, the comparison of depth with
    lateral directions, and the slice's plane between its two axes."""
    seconds: float | None = None
    """Time for the whole command, pictures too; what was not reached is said, and the same command continues.
    Default: no limit: the probe ends at its accuracies.  Not under torchrun."""
    power: bool = False
    """Power iteration (the paper's way to the ends) with 40 products of its own for each end.
    Else it is read from the density's Lanczos runs, up to as many steps as they have, without a product."""
    density_products: int | None = None
    """Products of the spectral density: more make the brackets of sums narrower.  Default: 108."""
    end_products: int | None = None
    """Products of the search for both ends of the spectrum, at most.  Default: 3000."""
    slice_points: int | None = None
    """Points along each side of the slice, odd, 5 or more.  Default: 41, with --quick 21."""
    slice_rise: float = 0.001
    """What a curvature unit is: the step within which the curvature alone changes the loss by this share of it.
    The slice reaches 3 units each way."""
    per_attribute: bool = False
    """Also the anisotropy indices of all attributes together and of each, for the Hessian and for Gauss-Newton.
    Takes about four times as many products as the rest.  Not under torchrun."""
    split_control: bool = False
    """The same, and that of the scene with every Gaussian split in two: what their number alone does to the indices.
    Takes about 2.5 times as long as --per-attribute alone."""
    metric: Literal["parameters", "scene", "optimiser"] = "parameters"
    """Units in which --per-attribute compares curvature.
    parameters: as stored.
    scene: positions in units of the scene's size (the median depth where all views face one way, else the cameras' mean
    distance from their centre), the rest as stored.
    optimiser: each parameter in units of its learning rate at the first step.
    Any but parameters implies --per-attribute."""
    per_attribute_seconds: float = 1800.0
    """Time for --per-attribute, in seconds, beside that of --seconds.  inf: no limit."""
    memory: MostMemory = None
    foreign: OtherTools = field(default_factory=Foreign)
