"""Options of `landscape train`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from analysis.console.options import DeviceName, TrainerOptions, Unset


@dataclass(frozen=True)
class TrainOptions:
    """Train 3D Gaussian Splatting on a few views of a scene and score it on the views held out."""

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder of the scene: COLMAP, LLFF, Blender, instant-ngp, nerfstudio or DTU."""
    out: Unset[Path] = None
    """Folder of the run, which must not exist yet.  Default: runs/NAME, NAME that of the scene's folder."""
    views: Unset[int | Literal["all"]] = None
    """Number of training views, by the protocol of the data set.
    Every eighth image is held out, and the training views are spread evenly over the others (LLFF, Mip-NeRF 360).
    Blender: the usual eight; DTU: views 25, 22, 28, ... of pixelNeRF (with --downscale 4).
    all: every view that is not held out; of DTU the protocol's 9.
    Default: 8 for Blender, else 3."""
    train_list: Unset[Path] = None
    """A text file with the name of a training view in each line, instead of --views; all others are held out."""
    iterations: Unset[int] = None
    """Steps of the training, each on one view.  Default: 2000, or those of the --protocol.
    newton-blocks and gn-cg: each on all views, 50."""
    seed: int = 0
    """Seed of everything random: the same seed gives the same checkpoint, bit for bit."""
    images: Unset[str] = None
    """Folder of images within the scene.  Default: images, else the largest images_K."""
    downscale: float = 1.0
    """Divide width and height of the images by this factor, 1 or more, by averaging."""
    strict_frames: FlagCreatePairsOff[bool] = False
    """Refuse a transforms.json that lists frames without an image, instead of skipping these."""
    start: Unset[Literal["scene", "points", "triangulated", "dense", "random", "box"]] = None
    """What the Gaussians start from.  Default: scene, or that of the --protocol.
    scene: points where there are any, else random.
    points: the points of the scene's files that at least two training views see.
    triangulated: points found in the training views alone, given their poses.
    dense: a point for most of what two training views show, by a plane sweep.
    random: random points in the volume that the training views have in common.
    box: random points in the box of the scene's points."""
    from_: Annotated[Unset[Path], arg(name="from")] = None
    """A checkpoint, our own or another tool's, whose Gaussians to start from, with its renderer and in its world.
    They are first cloned and split after 500 steps, however short the training is."""
    foreign: Annotated[TrainerOptions, arg(name="")] = field(default_factory=TrainerOptions)
    masks: Unset[Path] = None
    """Folder of object masks, named after the images; the scores are taken inside them.
    Default: mask or masks in the scene, or what its files name (nerfstudio's mask_path, DTU's idrmasks)."""
    depths: Unset[Path] = None
    """Folder of relative depth maps for the training views, NAME.npy or 16-bit NAME.png, for methods that use depth."""
    method: str = "3dgs"
    """What is trained: 3dgs, stablegs, sam, dropgaussian, dropoutgs, cor-gs, fsgs or dngaussian; in place of Adam:
    newton-blocks or gn-cg, without density control."""
    protocol: Literal["common", "llff"] = "common"
    """Whose training the method is added to.
    common: the same for all methods, that of 3DGS.
    llff: the method's own, as in its released code for LLFF; the table is splat/training/methods/protocols.csv.
    Options and --set go before it."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """KEY=VALUE changes a setting of the method or of the training, as in vsp_weight=0; may be repeated.
    An unknown KEY is answered with the one that was meant, or with the names of all."""
    device: DeviceName = "auto"
    """Where to train.  auto: on the GPU where there is one that can be used, else on the CPU."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue the run in OUT; the other options must be those that it was started with."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics, 0 to 3; the training starts with degree 0, and one joins every 1000 steps."""
    background: Unset[Literal["scene", "black", "white", "random"]] = None
    """Colour behind the Gaussians.  Default: scene, or that of the --protocol.
    scene: white where the images are transparent, else black.
    random: another one at every step."""
    densify: bool = True
    """Whether to clone, split and prune Gaussians and reset opacities, as 3DGS does."""
    pixel_loss: Literal["l1", "charbonnier", "l2"] = "l1"
    """Loss of a pixel, to which 1 - SSIM is added; charbonnier is a smooth l1."""
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM, 0 to 1; the pixel loss has the rest."""
    checkpoint_every: int = 500
    """Steps between checkpoints: what a killed run loses at most."""
    keep_checkpoints: int | Literal["all"] = 0
    """How many of these stay, beside the latest in OUT: the newest N, each as OUT/step-K/checkpoint.pt, or all."""
    log_every: int = 100
    """Steps between rows of OUT/train.csv: loss and PSNR of the first training view, Gaussians, seconds.
    Off a terminal, each is a line on stderr too."""
    tensorboard: FlagCreatePairsOff[bool] = False
    """Write the rows of train.csv also to OUT/tensorboard, for TensorBoard: pip install -e '.[tensorboard]'."""
    probe_every: Unset[int] = None
    """Steps between records of traces, both ends of the spectrum and anisotropy in OUT/trajectory.csv.  Default: none.
    The first, at the start, and the last are always made."""
    probe_share: float = 0.1
    """Time that these records may take together, as a share of the time of the steps.
    One between the first and the last that would not fit is coarser or skipped.  inf: no limit."""
