"""What a file of another tool does not say, and which part of a checkpoint is wanted.  Imports nothing heavy: help is quick."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from landscape.errors import did_you_mean

FILE = "checkpoint.pt"  # of a run
KIND = "expected a checkpoint written by landscape train"


@dataclass(frozen=True)
class Trainer:
    """What a file that another tool trained does not say of its trainer."""

    trained_by: str | None = None
    """Whose conventions to follow: graphdeco, gsplat (up to 1.5), gsplat-raw (its world not normalised), gsplat-1.6,
    nerfstudio, brush, lichtfeld, mip-splatting.  Default: what the file says."""
    antialiased: bool = False
    """Its renderer was antialiased, though its file does not say so."""
    opacity_reg: float | Literal["trained"] | None = None
    """Weight of the mean opacity in the loss, as MCMC trainers have it; trained: as the settings beside the file say.
    Default: 0."""
    scale_reg: float | Literal["trained"] | None = None
    """The same of the mean scale."""


@dataclass(frozen=True)
class Foreign(Trainer):
    """What a file that another tool trained does not say; the last two, and scene, are of our own checkpoints too.

    >>> Foreign(scene=Path("data/fern"), views=3).trained_by is None  # what the file says
    True
    """

    scene: Path | None = None
    """Folder of the scene: of another tool's file, or where ours has moved to since the training."""
    views: int | Literal["all"] | None = None
    """Number of training views, by the scene's protocol.  Default: what the tool's files say."""
    train_list: Path | None = None
    """A text file with the name of a training view in each line."""
    guess_views: bool = False
    """Where nothing names its training views: those that its tool holds by default."""
    images: str | None = None
    """Folder of images within the scene.  Default: as `landscape train` has it."""
    downscale: float | None = None
    """Factor by which its images were reduced.  Default: what its tool does."""
    max_views: int | None = None
    """Measure on at most so many training views, spread evenly over the cameras.  Default: all."""
    accept_changed: bool = False
    """Go on where cameras, photographs or masks are not as they were in the training."""


OF_ALL = {"scene", "max_views", "accept_changed"}  # fields of `Foreign` that are of our own checkpoints too


def require_checkpoint(path: Path) -> None:
    """FileNotFoundError, which says what to name instead, where no file is at the path of a checkpoint."""
    if not path.is_file():
        raise FileNotFoundError(f"{KIND} at {path}, found {_instead(path)}")


def _instead(path: Path) -> str:
    """Description of the thing at path that is no checkpoint, and which path to name instead."""
    if not path.exists():
        near = path.parent if path.name == FILE else path
        beside = [each.name for each in near.parent.iterdir()] if near.parent.is_dir() else []
        return f"no such file{did_you_mean(near.name, beside) or '; name a run, or a file of Gaussians'}"
    if (inside := path / FILE).is_file():
        return f"a folder; name the {inside} in it"
    if runs := sorted(path.glob("*/checkpoint.pt")):
        return f"a folder of runs; name one of them, such as {runs[0].parent}"
    if (path.parent / FILE).is_file():
        return f"a folder within the run {path.parent}; name that"
    return "a folder without one; name the run that landscape train wrote, its --out"
