"""The `landscape` command: subcommands, and how errors become exit codes.

    0    done
    1    a self-check failed under --strict, or a cell of a sweep failed
    2    bad input: one sentence on stderr that says what was expected, what came and what to do
    130  interrupted with Ctrl-C or SIGTERM

Every subcommand imports what it needs when it runs, so that `landscape --help` does not wait for torch.
"""

import gc
import os
import sys
from collections.abc import Sequence
from typing import Annotated, NoReturn

import tyro

from analysis.console.options import (
    BenchOptions,
    CompareOptions,
    DemoOptions,
    ProbeOptions,
    SfmOptions,
    SliceOptions,
    SweepOptions,
    TrainOptions,
    TrajectoryOptions,
)

Options = (
    Annotated[SfmOptions, tyro.conf.subcommand("sfm")]
    | Annotated[TrainOptions, tyro.conf.subcommand("train")]
    | Annotated[SweepOptions, tyro.conf.subcommand("sweep")]
    | Annotated[ProbeOptions, tyro.conf.subcommand("probe")]
    | Annotated[SliceOptions, tyro.conf.subcommand("slice")]
    | Annotated[CompareOptions, tyro.conf.subcommand("compare")]
    | Annotated[DemoOptions, tyro.conf.subcommand("demo")]
    | Annotated[TrajectoryOptions, tyro.conf.subcommand("trajectory")]
    | Annotated[BenchOptions, tyro.conf.subcommand("bench")]
)


def command() -> NoReturn:
    """`main` in a process of its own, which ends with its exit code.

    The libraries' objects live as long as the process: to look for garbage among them while they are loaded, and to take them
    apart at the end, would take three quarters of a second.
    """
    gc.set_threshold(100_000)
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; arguments: those of the command line where None.  Returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    options = tyro.cli(
        Options,  # pyright: ignore[reportArgumentType]
        prog="landscape",
        description="See the loss landscape of a 3D Gaussian Splatting scene.",
        args=arguments,
        config=(tyro.conf.DisallowNone,),
    )
    try:
        return run(options, arguments)
    except (ValueError, OSError) as error:
        text = str(error)
        if isinstance(error, OSError) and error.strerror and error.filename:  # the system's own words
            text = f"cannot use {error.filename}: {error.strerror}"
        print(f"landscape: {' '.join(text.split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("landscape: interrupted", file=sys.stderr)
        return 130


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

            with drawing("make_all", *options.pictures) as drawn:
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
        case DemoOptions():
            from analysis.commands.demo import run_demo

            return run_demo(options)
        case BenchOptions():
            from analysis.bench.command import run_bench

            return run_bench(options)


if __name__ == "__main__":
    command()
