"""The `landscape` command: its subcommands.

Every subcommand imports what it needs when it runs, so that `landscape --help` does not wait for torch.  For exit codes see
`analysis.console.failures`.
"""

import gc
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path
from typing import IO, NoReturn

import tyro
from rich.console import Console

from analysis.bench.options import BenchOptions
from analysis.commands.options import ConvertOptions, DemoOptions, MapOptions, SfmOptions, ViewOptions
from analysis.commands.uses.options import NextViewOptions, PruneOptions, UncertaintyOptions
from analysis.console.failures import report
from analysis.console.interruption import ignored, raising
from analysis.console.options import REGISTRY
from analysis.probe.options import ProbeOptions
from analysis.runs.options import ClaimsOptions, CompareOptions, SweepOptions, TrajectoryOptions
from analysis.slice.options import SliceOptions
from analysis.train.options import TrainOptions
from landscape.errors import InputError, did_you_mean

DEBUG, CHECKPOINT = "--debug", "checkpoint.pt"
COMMANDS = {
    "sfm": SfmOptions,
    "train": TrainOptions,
    "sweep": SweepOptions,
    "probe": ProbeOptions,
    "slice": SliceOptions,
    "map": MapOptions,
    "view": ViewOptions,
    "prune": PruneOptions,
    "next-view": NextViewOptions,
    "uncertainty": UncertaintyOptions,
    "compare": CompareOptions,
    "claims": ClaimsOptions,
    "convert": ConvertOptions,
    "demo": DemoOptions,
    "trajectory": TrajectoryOptions,
    "bench": BenchOptions,
}
Options = (
    SfmOptions
    | TrainOptions
    | SweepOptions
    | ProbeOptions
    | SliceOptions
    | MapOptions
    | ViewOptions
    | PruneOptions
    | NextViewOptions
    | UncertaintyOptions
    | CompareOptions
    | ClaimsOptions
    | ConvertOptions
    | DemoOptions
    | TrajectoryOptions
    | BenchOptions
)


def command() -> NoReturn:
    """Run `main` in a process of its own, and end it with the exit code.

    The libraries' objects live as long as the process, so Python is told not to look for garbage among them.
    """
    gc.set_threshold(100_000)
    _open_streams()
    Console.on_broken_pipe = _say_no_more  # pyright: ignore[reportAttributeAccessIssue]
    code = main()
    with ignored():  # the work is done
        try:
            sys.stdout.flush()
        except BrokenPipeError:
            _drop(sys.stdout)
        gc.freeze()
        sys.exit(code)


def _open_streams() -> None:
    """Open the standard streams that were closed: no file gets their number, and what is said is dropped."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)  # the least free number: this one
            setattr(sys, name, os.fdopen(opened, "w" if number else "r"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may be no text


def _say_no_more(console: Console) -> None:
    """In place of rich's, which ends the process, and the work with it."""
    console.quiet = True
    _drop(console.file)


def _drop(stream: IO[str]) -> None:
    """Send what is written to a stream nowhere."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; arguments: those of the command line where None.  Returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["--version"]:
        print(f"splat-landscape {version('splat-landscape')}")
        return 0
    debug, arguments = DEBUG in arguments, [word for word in arguments if word != DEBUG]
    try:
        with raising():
            return run(at_files(_parsed(arguments)), arguments)
    except (Exception, KeyboardInterrupt) as error:
        return report(error, ["landscape", *arguments], debug)


def _parsed(arguments: Sequence[str]) -> Options:
    """The options of a command, which are parsed alone: what an error advises is of that command.

    SystemExit for help, and where they cannot be parsed; InputError for a command that there is not.
    """
    name, config = (*arguments, "")[0], (tyro.conf.DisallowNone,)
    if name in COMMANDS:
        return tyro.cli(COMMANDS[name], prog=f"landscape {name}", args=arguments[1:], config=config, registry=REGISTRY)
    if name and not name.startswith("-"):
        raise InputError(f"expected a command among {', '.join(COMMANDS)}, got {name!r}{did_you_mean(name, COMMANDS)}")
    return tyro.extras.subcommand_cli_from_dict(
        COMMANDS,  # pyright: ignore[reportArgumentType]
        prog="landscape",
        description=f"See the loss landscape of a 3D Gaussian Splatting scene.\n{DEBUG}, before or after the subcommand, shows "
        "where in the program an error came up.  --version alone shows the version.",
        args=arguments,
        config=config,
    )


def at_files(options: Options) -> Options:
    """A run folder stands for its checkpoint where one is asked for, and a checkpoint for its run."""
    changes: dict[str, object] = {}
    for name in ("checkpoint", "subject", "from_", "source"):
        path = getattr(options, name, None)
        if isinstance(path, Path) and (path / CHECKPOINT).is_file():
            changes[name] = path / CHECKPOINT
    if others := getattr(options, "others", ()):
        changes["others"] = tuple(path / CHECKPOINT if (path / CHECKPOINT).is_file() else path for path in others)
    if runs := getattr(options, "runs", ()):
        changes["runs"] = tuple(run.parent if run.name == CHECKPOINT else run for run in runs)
    return replace(options, **changes) if changes else options


def run(options: Options, arguments: Sequence[str]) -> int:
    """Hand over to the subcommand."""
    of_curvature = ProbeOptions | SliceOptions | MapOptions | PruneOptions | NextViewOptions | UncertaintyOptions
    if isinstance(options, TrainOptions | DemoOptions | of_curvature):
        from analysis.commands.compiling import compiling_is_said

        with compiling_is_said(Console(stderr=True)):
            return _run(options, arguments)
    return _run(options, arguments)


def _run(options: Options, arguments: Sequence[str]) -> int:
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
        case MapOptions():
            from analysis.console.drawing import drawing

            with drawing("maps") as drawn:
                from analysis.commands.map.command import run_map

                return run_map(options, ["landscape", *arguments], drawn)
        case ViewOptions():
            from analysis.commands.view import run_view

            return run_view(options)
        case PruneOptions():
            from analysis.commands.uses.prune import run_prune

            return run_prune(options, ["landscape", *arguments])
        case NextViewOptions() if options.checkpoint.suffix == ".toml":
            from analysis.commands.uses.study import run_study

            return run_study(options.checkpoint)
        case NextViewOptions():
            from analysis.commands.uses.next_view import run_next_view

            return run_next_view(options, ["landscape", *arguments])
        case UncertaintyOptions():
            from analysis.commands.uses.uncertainty import run_uncertainty

            return run_uncertainty(options, ["landscape", *arguments])
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
