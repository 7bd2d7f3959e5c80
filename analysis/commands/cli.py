"""The `landscape` command: its subcommands.

Every subcommand imports what it needs when it runs, so that `landscape --help` does not wait for torch.  For exit codes see
`analysis.console.failures`.
"""

import gc
import sys
from collections.abc import Sequence
from typing import Annotated, NoReturn

import tyro

from analysis.bench.options import BenchOptions
from analysis.commands.options import ConvertOptions, DemoOptions, SfmOptions
from analysis.console.failures import report
from analysis.probe.options import ProbeOptions
from analysis.runs.options import ClaimsOptions, CompareOptions, SweepOptions, TrajectoryOptions
from analysis.slice.options import SliceOptions
from analysis.train.options import TrainOptions

DEBUG = "--debug"
Options = (
    Annotated[SfmOptions, tyro.conf.subcommand("sfm")]
    | Annotated[TrainOptions, tyro.conf.subcommand("train")]
    | Annotated[SweepOptions, tyro.conf.subcommand("sweep")]
    | Annotated[ProbeOptions, tyro.conf.subcommand("probe")]
    | Annotated[SliceOptions, tyro.conf.subcommand("slice")]
    | Annotated[CompareOptions, tyro.conf.subcommand("compare")]
    | Annotated[ClaimsOptions, tyro.conf.subcommand("claims")]
    | Annotated[ConvertOptions, tyro.conf.subcommand("convert")]
    | Annotated[DemoOptions, tyro.conf.subcommand("demo")]
    | Annotated[TrajectoryOptions, tyro.conf.subcommand("trajectory")]
    | Annotated[BenchOptions, tyro.conf.subcommand("bench")]
)


def command() -> NoReturn:
    """Run `main` in a process of its own, and end it with the exit code.

    The libraries' objects live as long as the process, so Python is told not to look for garbage among them.
    """
    gc.set_threshold(100_000)
    code = main()
    gc.freeze()
    sys.exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; arguments: those of the command line where None.  Returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug, arguments = DEBUG in arguments, [word for word in arguments if word != DEBUG]
    options = tyro.cli(
        Options,  # pyright: ignore[reportArgumentType]
        prog="landscape",
        description=f"See the loss landscape of a 3D Gaussian Splatting scene.\n{DEBUG}, before or after the subcommand, shows "
        "where in the program an error came up.",
        args=arguments,
        config=(tyro.conf.DisallowNone,),
    )
    try:
        return run(options, arguments)
    except (Exception, KeyboardInterrupt) as error:
        return report(error, ["landscape", *arguments], debug)


def run(options: Options, arguments: Sequence[str]) -> int:
    """Hand over to the subcommand."""
    match options:
        case SfmOptions():
            from analysis.commands.sfm import run_sfm

            return run_sfm(options)
        case TrainOptions():
            from analysis.train.command import run_training

            return run_training(options, ["landscape", *arguments])
        case SweepOptions():
            from analysis.runs.sweep.sweep import run_sweep

            return run_sweep(options)
        case ProbeOptions():
            from analysis.console.drawing import drawing

            with drawing("make_all") as drawn:
                from analysis.probe.command import run_probe

                return run_probe(options, ["landscape", *arguments], drawn)
        case SliceOptions():
            from analysis.slice.command import run_slice

            return run_slice(options, ["landscape", *arguments])
        case TrajectoryOptions():
            from analysis.runs.trajectories import run_trajectory

            return run_trajectory(options)
        case CompareOptions():
            from analysis.runs.compare import run_compare

            return run_compare(options)
        case ClaimsOptions():
            from analysis.runs.claims.command import run_claims

            return run_claims(options)
        case ConvertOptions():
            from analysis.commands.convert import run_convert

            return run_convert(options)
        case DemoOptions():
            from analysis.commands.demo import run_demo

            return run_demo(options)
        case BenchOptions():
            from analysis.bench.command import run_bench

            return run_bench(options)


if __name__ == "__main__":
    command()
