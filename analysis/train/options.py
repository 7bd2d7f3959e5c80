"""Options of `landscape train`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from analysis.console.options import Device, OfTrainer
from splat.training.origin.options import Trainer


@dataclass(frozen=True)
class TrainOptions:
    """Train 3D Gaussian Splatting on a few views of a scene and score it on the views held out."""

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """COLMAP, LLFF, Blender, instant-ngp, nerfstudio, DTU."""
    out: Path | None = None
    """New folder of the run.  Default: runs/SCENE."""
    views: int | Literal["all"] | None = None
    """For training, by the protocol of the data set, which holds others out.  Default: 8 for Blender, else 3."""
    train_list: Path | None = None
    """File of the training views' names, a line each."""
    iterations: int | None = None
    """Steps.  Default: 2000, the --protocol's, or 50 of second order, which are on all views."""
    seed: int = 0
    """The same seed gives the same bits."""
    images: str | None = None
    """Folder within the scene.  Default: images or images_K."""
    downscale: float = 1.0
    """Factor that reduces the images."""
    start: Annotated[
        Literal["scene", "points", "triangulated", "dense", "random", "box"] | None, arg(metavar="NAME")
    ] = None
    """Of Gaussians: points of the scene's files, triangulated or dense ones of the training views, random, box;
    scene: points if there are any, else random."""
    from_: Annotated[Path | None, arg(name="from")] = None
    """Checkpoint, our own or another tool's, whose Gaussians, renderer and world to start from."""
    foreign: OfTrainer = field(default_factory=Trainer)
    masks: Path | None = None
    """Folder of masks, inside which scores are taken."""
    depths: Path | None = None
    """Folder of depth maps, .npy or .png of 16 bits."""
    method: str = "3dgs"
    """3dgs, stablegs, sam, dropgaussian, dropoutgs, cor-gs, fsgs, dngaussian, newton-blocks or gn-cg."""
    protocol: Annotated[Literal["common", "llff"], arg(metavar="NAME")] = "common"
    """common: 3DGS's training; llff: as released for LLFF."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE", help_behavior_hint="")] = ()
    """Change a setting; may be given again."""
    device: Device = "auto"
    resume: bool = False
    """Continue the run in OUT; its options must be the same."""
    sh_degree: int = 3
    """Highest, reached after 1000 steps each."""
    background: Annotated[Literal["scene", "black", "white", "random"] | None, arg(metavar="NAME")] = None
    """black, white, random; scene: white if it is transparent."""
    densify: bool = True
    """Neither clone, split nor prune Gaussians."""
    pixel_loss: Annotated[Literal["l1", "charbonnier", "l2"], arg(metavar="NAME")] = "l1"
    """l1, charbonnier or l2."""
    ssim_weight: float = 0.2
    """Share of 1 - SSIM in the loss."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    keep_checkpoints: Annotated[int | Literal["all"], arg(metavar="N")] = 0
    """How many stay as OUT/step-K, or all."""
    save_at_psnr: Annotated[tuple[float, ...] | None, arg(metavar="DB ...")] = None
    """Keep OUT/psnr-DB once the training views are as good."""
    log_every: int = 100
    """Steps between rows of OUT/train.csv."""
    track: Annotated[Literal["tensorboard", "wandb", "trackio"] | None, arg(metavar="NAME")] = None
    """Give them to tensorboard, wandb or trackio."""
    probe_every: int | None = None
    """Steps between records in OUT/trajectory.csv."""
    probe_quick: bool = False
    """With wider errors, in a third of the time."""
