"""Options of `landscape bench`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from analysis.console.options import Device


@dataclass(frozen=True)
class BenchOptions:
    """Measure the toolkit itself: time and memory of a scene's derivatives, work against true error, numerical stability."""

    subject: Annotated[
        Positional[Literal["accuracy", "stress"] | Path | None], arg(metavar="[RUN|SCENE]", help_behavior_hint="")
    ] = None
    """A run, or a scene's folder: time and memory of its gradient and Hessian-vector products.  Default: those of --sizes.
    accuracy RUN: work against true error of every estimator on that run's scene; the truth is a long run, kept in OUT.
    stress: round-off of single precision at the limits of the renderer, and what it refuses; takes minutes."""
    checkpoint: Annotated[Positional[Path | None], arg(metavar="[RUN]", help_behavior_hint="")] = None
    """Of accuracy: RUN or RUN/checkpoint.pt."""
    out: Path = Path("runs/bench")
    """Folder of the tables (CSV) and figures; files of an earlier bench are replaced."""
    repetitions: int = 15
    """How often each thing is timed, in turns with what it is compared with; of accuracy: number of seeds."""
    sizes: Annotated[tuple[str, ...], arg(metavar="SIZE...", help_behavior_hint="")] = ()
    """Synthetic scenes to measure, GAUSSIANS@WIDTHxHEIGHT in pixels.
    Default: 10k@504x378 100k@504x378; none beside a run or a scene."""
    device: Device = "auto"
