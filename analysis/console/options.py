"""What the subcommands of `landscape` accept.  Plain dataclasses that import nothing heavy, so that help is quick.

The help keeps the line breaks of these docstrings: a line is a sentence.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

Along = Literal["eigenvectors", "random", "gradient", "line"]
DeviceName = Literal["auto", "cpu", "cuda"]
Quantity = Literal["traces", "ends", "sums", "diagonal"]
T = TypeVar("T")
Unset = Annotated[T | None, arg(help_behavior_hint="")]  # its docstring says what stands for None


@dataclass(frozen=True)
class TrainOptions:
    """Train 3D Gaussian Splatting on a few views of a scene and score it on the views held out."""

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder of the scene: COLMAP, LLFF, Blender, instant-ngp, nerfstudio or DTU."""
    out: Unset[Path] = None
    """Folder of the run, which must not exist yet.  Default: runs/NAME, NAME that of the scene's folder."""
    views: Unset[int | Literal["all"]] = None
    """Number of training views, chosen by the scene's protocol (see the README).
    all: every view that is not held out; of DTU the protocol's 9.
    Default: 8 for Blender, else 3."""
    iterations: int = 2000
    """Steps of the training, each on one view."""
    seed: int = 0
    """Seed of everything random: the same seed gives the same checkpoint, bit for bit."""
    images: Unset[str] = None
    """Folder of images within the scene.  Default: images, else the largest images_K."""
    downscale: float = 1.0
    """Divide width and height of the images by this factor, 1 or more, by averaging."""
    start: Literal["scene", "points", "triangulated", "random"] = "scene"
    """What the Gaussians start from.
    scene: points where there are any, else random.
    points: the points of the scene's files that at least two training views see.
    triangulated: points found in the training views alone, given their poses.
    random: random points in the volume that the training views have in common."""
    masks: Unset[Path] = None
    """Folder of object masks, named after the images; the scores are taken inside them.
    Default: mask or masks in the scene, or what its files name."""
    depths: Unset[Path] = None
    """Folder of relative depth maps for the training views, NAME.npy or 16-bit NAME.png, for methods that use depth."""
    method: str = "3dgs"
    """What is trained: 3dgs, stablegs, sam, dropgaussian, dropoutgs, cor-gs, fsgs or dngaussian."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """KEY=VALUE changes a setting of the method or of the training, as in vsp_weight=0; may be repeated.
    An unknown KEY is answered with the names of all."""
    device: DeviceName = "auto"
    """Where to train.  auto: on the GPU where there is one that can be used, else on the CPU."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue the run in OUT; the other options must be those that it was started with."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics, 0 to 3; the training starts with degree 0, and one joins every 1000 steps."""
    background: Literal["scene", "black", "white", "random"] = "scene"
    """Colour behind the Gaussians.  scene: white where the images are transparent, else black.
    random: another one at every step."""
    densify: bool = True
    """Whether to clone, split and prune Gaussians and reset opacities, as 3DGS does."""
    pixel_loss: Literal["l1", "charbonnier", "l2"] = "l1"
    """Loss of a pixel, to which 1 - SSIM is added; charbonnier is a smooth l1."""
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM, 0 to 1; the pixel loss has the rest."""
    checkpoint_every: int = 500
    """Steps between checkpoints: what a killed run loses at most."""
    probe_every: Unset[int] = None
    """Steps between records of traces, both ends of the spectrum and anisotropy in OUT/trajectory.csv.  Default: none."""
    probe_share: float = 0.1
    """Time that these records may take together, as a share of the time of the steps; one that would not fit is skipped.
    inf: no limit."""


@dataclass(frozen=True)
class SfmOptions:
    """Make a scene from a folder of photographs: find where each was taken, with pycolmap."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of the photographs: at least 3 of one scene that does not move, from different places."""
    out: Unset[Path] = None
    """Folder of the scene, which must not exist yet.  Default: PHOTOS-scene, beside the photographs."""


@dataclass(frozen=True)
class SweepOptions:
    """Train every method with every seed on every scene, and give mean and standard deviation over the seeds.

    What is done already is kept: a sweep that was stopped or killed continues when it is run again.
    """

    file: Annotated[Positional[Path], arg(metavar="SWEEP.toml")]
    """The methods, seeds, scenes and settings; an example is in the README."""
    out: Unset[Path] = None
    """Folder of the runs and tables.  Default: the file's."""
    jobs: int = 1
    """Runs at once, each on its share of the processors."""
    probe: FlagCreatePairsOff[bool] = False
    """Also probe every run after its training; split_control = true in the file adds the split control."""


@dataclass(frozen=True)
class ProbeOptions:
    """Measure the loss landscape at a checkpoint: traces, extreme eigenvalues, anisotropy, a slice."""

    checkpoint: Annotated[Positional[Path], arg(metavar="CHECKPOINT")]
    """RUN/checkpoint.pt, as written by landscape train."""
    scene: Unset[Path] = None
    """Folder of the scene, where it has moved since the training."""
    out: Unset[Path] = None
    """Folder of the results.  Default: probe, beside the checkpoint."""
    seed: int = 0
    """Seed of the random vectors."""
    device: DeviceName = "auto"
    """Where to work.  auto: on the GPU where there is one that can be used, else on the CPU."""
    strict: FlagCreatePairsOff[bool] = False
    """Exit with 1 if a self-check fails; the record is written all the same."""
    quick: FlagCreatePairsOff[bool] = False
    """Numbers to 10% instead of 1%, in a quarter of the time.
    Without power iteration, the spectral density and the indices that need it, the finite probe, the comparison of depth with
    lateral directions, and surface.png."""
    seconds: Unset[float] = None
    """Time for the estimators together, in seconds; what a stage did not reach in its share is said.  inf: no limit.
    Default: 45, with --quick 12; under torchrun inf, and nothing else."""
    slice_points: Unset[int] = None
    """Points along each side of the slice, odd, 5 or more.  Default: 41."""
    slice_rise: float = 0.001
    """What a curvature unit is: the step within which the curvature alone changes the loss by this share of it.
    The slice reaches 3 units each way."""
    families: FlagCreatePairsOff[bool] = False
    """Also the anisotropy indices of all attributes together and of each, for the Hessian and for Gauss-Newton.
    Takes about four times as many products as the rest.  Not under torchrun."""
    split_control: FlagCreatePairsOff[bool] = False
    """The families, and the same of the scene with every Gaussian split in two: what their number alone does to the indices.
    Takes about 2.5 times as long as the families alone."""
    metric: Literal["parameters", "scene", "optimiser"] = "parameters"
    """Units in which the families compare curvature.
    parameters: as stored.
    scene: positions in units of the scene's size (the median depth where all views face one way, else the cameras' mean
    distance from their centre), the rest as stored.
    optimiser: each parameter in units of its learning rate at the first step.
    Any but parameters measures the families, as --families does."""
    family_seconds: float = 1800.0
    """Time for the families together, in seconds, beside that of --seconds.  inf: no limit."""

    @property
    def pictures(self) -> tuple[str, ...]:
        """What `figures.make_all` is told, beside the folder."""
        return ("--without", "surface") if self.quick else ()


@dataclass(frozen=True)
class SliceOptions:
    """Slice the training loss through a checkpoint: along a line or over a plane, with the quadratic model beside it.

    Points are rendered where the others do not predict them well.  A slice that was killed continues when it is run again.
    """

    checkpoint: Annotated[Positional[Path], arg(metavar="CHECKPOINT")]
    """RUN/checkpoint.pt, as written by landscape train."""
    other: Annotated[Positional[Path | None], arg(metavar="[OTHER]", help_behavior_hint="")] = None
    """Where a line leads to: a checkpoint with as many Gaussians and the same SH degree."""
    along: UseAppendAction[tuple[Along, ...]] = ()
    """Directions; given twice, the plane of the first direction of each.  Default: eigenvectors, or line where OTHER is given.
    eigenvectors: of the two largest eigenvalues, from RUN/probe or else computed.
    random: filter-normalised, in each attribute of each Gaussian as long as that attribute is.
    gradient: the steepest ascent.
    line: to OTHER."""
    dimension: Unset[Literal[1, 2]] = None
    """1: a line; 2: a plane.  Default: 2 for eigenvectors and random, 1 for gradient and line."""
    radius: UseAppendAction[tuple[float, ...]] = ()
    """How far to look each way; given twice, one for each direction.
    eigenvectors: in curvature units: the step within which the curvature alone changes the loss by 0.1%.  Default: 3.
    random: as a share of each parameter's size.  Default: 0.001.
    gradient: in parameter units.  Default: 3 curvature units.
    line: how far beyond both ends, as a share of their distance.  Default: 0.5."""
    points: int = 41
    """Points along each direction, odd; a line to OTHER may get a few more or less."""
    tolerance: float = 0.01
    """Largest error of the points that are interpolated instead of rendered, as a share of the range of the loss."""
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
    scene: Unset[Path] = None
    """Folder of the scene, where it has moved since the training."""
    out: Unset[Path] = None
    """Folder of the results.  Default: beside the checkpoint, such as slice-eigenvectors-2d or slice-line-1d."""


@dataclass(frozen=True)
class TrajectoryOptions:
    """Plot the landscape along trainings that were made with --probe-every, several in one picture."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN...", help_behavior_hint="")]
    """Folders that landscape train --probe-every wrote."""
    out: Unset[Path] = None
    """Folder of the table and the picture.  Default: trajectory, in the folder that holds all runs."""


@dataclass(frozen=True)
class CompareOptions:
    """Compare probed runs in one table and on one page: scores, traces, spectra, anisotropy, slices."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN...", help_behavior_hint="")]
    """Two or more folders that landscape train wrote, of the same views and loss, each probed."""
    out: Unset[Path] = None
    """Folder of the page, the table and the pictures.  Default: compare, in the folder that holds all runs."""
    probe: FlagCreatePairsOff[bool] = False
    """Probe the runs that have no record of their checkpoint yet."""
    device: DeviceName = "auto"
    """Where to probe.  auto: on the GPU where there is one that can be used, else on the CPU."""


@dataclass(frozen=True)
class DemoOptions:
    """Train and probe an embedded synthetic scene, and say which pictures to open."""

    out: Path = Path("runs/demo")
    """Folder of the demo's scene and run.  Where it exists, the next free of OUT-2, OUT-3, ... is used."""


@dataclass(frozen=True)
class BenchOptions:
    """Measure the toolkit itself: time and memory, the accuracy of the estimators, errors at the limits of the renderer."""

    subject: Annotated[
        Positional[Literal["kernels", "stress", "accuracy"] | Path | None],
        arg(metavar="[SUBJECT]", help_behavior_hint=""),
    ] = None
    """kernels: time of the compositing kernels by themselves.
    stress: errors at the limits of the renderer, against bounds; exit code 1 where one is exceeded.  Takes minutes.
    accuracy: work against true error of every estimator, beside other packages' where they are installed.
    A scene's folder or a checkpoint: time and memory of gradients and Hessian-vector products there.
    Default: the same on the synthetic scenes of --sizes."""
    checkpoint: Annotated[Positional[Path | None], arg(metavar="[CHECKPOINT]", help_behavior_hint="")] = None
    """accuracy only: a checkpoint to study instead of small scenes and matrices.
    What counts as the truth there is a long run, kept in OUT."""
    quantity: UseAppendAction[tuple[Quantity, ...]] = ()
    """accuracy only: study this quantity alone; may be given several times.  Default: all."""
    case: UseAppendAction[tuple[str, ...]] = ()
    """accuracy only: study this scene or matrix alone, by its name in the tables; may be given several times.
    Default: all."""
    scenes: int = 1
    """accuracy only: how many small scenes of each kind to make, each from a seed of its own."""
    out: Path = Path("runs/bench")
    """Folder of the tables (CSV) and figures; files of an earlier run are replaced."""
    repetitions: int = 15
    """How often each thing is timed, in turns with what it is compared with.
    accuracy: what the numbers of seeds are in proportion to: three times as many for a trace on a matrix, fewer elsewhere."""
    sizes: Annotated[tuple[str, ...], arg(metavar="SIZE...", help_behavior_hint="")] = ()
    """Synthetic scenes to measure, GAUSSIANS@WIDTHxHEIGHT in pixels.
    Default: 10k@504x378 100k@504x378, for kernels also 500k@1600x1060; none beside a scene or a checkpoint."""
    prototype: Unset[Path] = None
    """kernels only: folder of a prototype of the kernels to measure beside them.  Its code is run."""
    images: Unset[str] = None
    """Of a scene's folder: the folder of images within it.  Default: images, else the largest images_K."""
    downscale: float = 1.0
    """Reduce the images of a scene's folder, or of accuracy's checkpoint, further by this factor."""
    device: DeviceName = "auto"
    """Where a scene, a checkpoint or a synthetic scene is measured; the other subjects are the CPU's.
    auto: on the GPU where there is one that can be used, else on the CPU."""
    reference: FlagCreatePairsOff[bool] = False
    """Compare with double backward through the plain torch renderer, which takes minutes and gigabytes at full size."""
