"""Options of `landscape bench`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from analysis.console.options import DeviceName, Unset

Quantity = Literal["traces", "ends", "sums", "diagonal"]


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
    images: Unset[str] = None
    """Of a scene's folder: the folder of images within it.  Default: images, else the largest images_K."""
    downscale: float = 1.0
    """Reduce the images of a scene's folder, or of accuracy's checkpoint, further by this factor."""
    device: DeviceName = "auto"
    """Where a scene, a checkpoint or a synthetic scene is measured; the other subjects are the CPU's.
    auto: on the GPU where there is one that can be used, else on the CPU."""
    reference: FlagCreatePairsOff[bool] = False
    """Compare with double backward through the plain torch renderer, which takes minutes and gigabytes at full size."""
