"""The `landscape` command: its subcommands.

Every subcommand imports what it needs when it runs, so that `landscape --help` does not wait for torch.  For exit codes see
`analysis.console.failures`.
"""

import gc
import inspect
import os
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stderr
from dataclasses import dataclass, fields, replace
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from io import StringIO, TextIOWrapper
from pathlib import Path
from typing import IO, Any, NoReturn

import tyro
from rich.console import Console

from analysis.bench.options import BenchOptions
from analysis.commands import options as own
from analysis.console.failures import report
from analysis.console.interruption import interruption, loading
from analysis.console.options import registry
from analysis.probe.options import ProbeOptions
from analysis.runs.options import CompareOptions, SweepOptions, TrajectoryOptions
from analysis.slice.options import SliceOptions
from analysis.train.options import TrainOptions
from landscape.errors import InputError, did_you_mean
from splat.training.origin.options import require_checkpoint

DEBUG, CHECKPOINT = "--debug", "checkpoint.pt"
LPIPS = "LPIPS is a score too after: pip install 'splat-landscape[lpips]'"  # the end of train's help
USUAL = {  # options of other tools' files that every command's help explains
    "--scene": "FOLDER: the scene on which a file of another tool was trained, or to which ours has moved.",
    "--views": "N or all: its training views, and",
    "--trained-by": "graphdeco, gsplat, ...: its tool, where its files do not say them.",
}
DRAWN = re.compile(r"\x1b\[[\d;]*m|[\u2500-\u257f]|-{5,}|^[+|]|[+|]$", re.M)  # colours and lines of a box
SENTENCES = {  # what the parser says in a box, in which words
    r"Error parsing [^:]+: [^']*('.*?').*helptext:\s+([^\n]*\S)": r"expected \2, got \1",
    r"invalid choice (.+?) for argument '(.+?)'\.\s+Expected one of\s+\((.+?)\)": r"expected \2 with one of \3, got \1",
    r"Missing value for argument '(.+?)'": r"expected a value after \1, got none",
    r"Missing from [^:]+:\s+([^\n]*\S)": r"expected \1, got none",
    r"Unrecognized options: (.+?)\s+(?:Perhaps|Arguments)[^:]*:\s+(\S+)": r"expected its options, got \1; did you mean \2?",
    r"Unrecognized options: (.+?)\s+For full": r"expected no more words, got \1",
    r"(.+)": r"expected options that can be read, got: \1",
}


@dataclass(frozen=True)
class Command:
    """A subcommand.  options: what is parsed; runs: MODULE:FUNCTION, of `analysis`, imported when it runs, called with the
    options; example: words after its name that are shown in its help.

    recorded: the function is also given the command as typed; draws: and a `Draw` of this module of figures, whose process
    starts at once; compiles, or recorded: it says so when kernels are compiled.
    """

    options: type
    runs: str
    example: str
    recorded: bool = False
    draws: str | None = None
    compiles: bool = False


GROUPS = {  # as a person works
    "make": {
        "sfm": Command(own.SfmOptions, "commands.sfm:run_sfm", "PHOTOS"),
        "train": Command(TrainOptions, "train.command:run_training", "SCENE --views 3 --out runs/fern", recorded=True),
        "sweep": Command(SweepOptions, "runs.sweep.sweep:run_sweep", "notebooks/study_small.toml"),
        "demo": Command(own.DemoOptions, "commands.demo:run_demo", "", compiles=True),
    },
    "measure": {
        "probe": Command(
            ProbeOptions, "commands.uses.renderer:run_any_probe", "runs/fern", recorded=True, draws="make_all"
        ),
        "slice": Command(SliceOptions, "slice.command:run_slice", "runs/fern --along gradient", recorded=True),
        "compare": Command(CompareOptions, "runs.compare:run_compare", "runs/fern runs/fern-stable"),
        "trajectory": Command(TrajectoryOptions, "runs.trajectories:run_trajectory", "runs/fern runs/fern-stable"),
        "bench": Command(BenchOptions, "bench.command:run_bench", "runs/fern"),
    },
    "see": {
        "map": Command(own.MapOptions, "commands.map.command:run_map", "runs/fern", recorded=True, draws="maps"),
        "view": Command(own.ViewOptions, "commands.view.command:run_view", "runs/fern", compiles=True),
    },
    "use": {
        "prune": Command(own.PruneOptions, "commands.uses.prune:run_prune", "runs/fern --keep 0.5", recorded=True),
        "next-view": Command(own.NextViewOptions, "commands.uses.next_view:run_next_view", "runs/fern", recorded=True),
        "uncertainty": Command(
            own.UncertaintyOptions, "commands.uses.uncertainty:run_uncertainty", "runs/fern", recorded=True
        ),
    },
    "exchange": {
        "convert": Command(
            own.ConvertOptions,
            "commands.convert:run_convert",
            "point_cloud.ply runs/theirs/checkpoint.pt --scene SCENE",
        )
    },
}
COMMANDS = {name: each for group in GROUPS.values() for name, each in group.items()}


def overview() -> str:
    """The commands in the groups of `GROUPS`, a line each."""
    lines = ["usage: landscape COMMAND ...", "", "See the loss landscape of a 3D Gaussian Splatting scene."]
    for title, group in GROUPS.items():
        lines += ["", title]
        lines += [f"  {name:12} {inspect.getdoc(each.options).splitlines()[0]}" for name, each in group.items()]  # pyright: ignore[reportOptionalMemberAccess]
    lines += ["", "landscape COMMAND --help has its options and an example, landscape --version the version;"]
    return "\n".join([*lines, f"{DEBUG} shows where in the program an error came up."])


def command() -> NoReturn:
    """Run `main` in a process of its own, and end it with the exit code.

    The libraries' objects live as long as the process, so Python is told not to look for garbage among them.  torch's threads,
    which by default spin for milliseconds after each operation, sleep instead: they took the cores of the kernels' threads.
    """
    gc.set_threshold(100_000)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read when torch is imported
    _open_streams()
    Console.on_broken_pipe = _say_no_more  # pyright: ignore[reportAttributeAccessIssue]
    try:
        code = main()
    except SystemExit as ended:  # by the parser, which has printed its help
        code = ended.code
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
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; arguments: those of the command line where None.  Returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["--version"]:
        print(f"splat-landscape {version('splat-landscape')}")
        return 0
    debug, arguments = DEBUG in arguments, [word for word in arguments if word != DEBUG]
    try:
        command, options = _parsed(arguments)
        return run(command, at_files(options), arguments)
    except (Exception, KeyboardInterrupt) as error:
        return report(error, ["landscape", *arguments], debug)


def _parsed(arguments: Sequence[str]) -> tuple[Command, Any]:
    """A command and its options, which are parsed alone: an error advises about this command.

    SystemExit for help; InputError where they cannot be parsed, and for a command that there is not.
    """
    name = (*arguments, "")[0]
    if found := COMMANDS.get(name):
        elsewhere = name != "convert" and bool({"-h", "--help"} & {*arguments})
        try:
            with redirect_stderr(StringIO()) as said:
                return found, tyro.cli(
                    found.options,
                    prog=f"landscape {name}",
                    description=_about(name, found),
                    args=arguments[1:],
                    config=(tyro.conf.DisallowNone,),
                    registry=registry(foreign=not elsewhere),
                )
        except SystemExit as ended:
            if not ended.code:
                if name == "train":
                    print(LPIPS)
                raise
        # without 'None', what leaving an option out means
        box = DRAWN.sub("", said.getvalue()).strip().replace("'None', ", "").replace(", 'None'", "")
        told = (match.expand(words) for pattern, words in SENTENCES.items() if (match := re.search(pattern, box, re.S)))
        raise InputError(f"{next(told)}; landscape {name} --help has all options, and an example")
    if name in ("-h", "--help"):
        print(overview())
        raise SystemExit(0)
    wrong = f", got {name!r}{did_you_mean(name, COMMANDS)}" if name else ", got none; landscape --help lists them"
    raise InputError(f"expected a command among {', '.join(COMMANDS)}{wrong}")


def _about(name: str, command: Command) -> str:
    """What stands above the options in a command's help; of those on other tools' files it has USUAL, and convert's has all."""
    lines = [str(inspect.getdoc(command.options)), f"Example: landscape {name} {command.example}".rstrip()]
    if name != "convert" and (foreign := command.options.__dataclass_fields__.get("foreign")):
        names = [f"--{each.name.replace('_', '-')}" for each in fields(foreign.default_factory)]
        usual = " ".join(f"{each} {words}" for each, words in USUAL.items())
        rest = ", ".join(each for each in names if each not in USUAL)
        lines.insert(1, f"{usual} As landscape convert --help explains: {rest}.")
    return "\n\n".join(lines)


def at_files(options: Any) -> Any:
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


def run(command: Command, options: Any, arguments: Sequence[str]) -> int:
    """Hand over to the subcommand; returns the exit code."""
    from analysis.records.provenance import require_seed  # not for --help

    require_seed(getattr(options, "seed", 0))
    _require_compiler()
    _require_there(options)
    if isinstance(options, own.ViewOptions) and find_spec("viser") is None:
        words = "expected the package viser, which shows a scene in the browser, got none; pip install -e '.[view]'"
        raise InputError(words)
    name, function = command.runs.split(":")
    with ExitStack() as around:
        given = [options, ["landscape", *arguments]] if command.recorded else [options]
        if command.compiles or command.recorded:
            with loading():
                from analysis.commands.compiling import compile_ahead, compiling_is_said

                compile_ahead()
            around.enter_context(compiling_is_said(Console(stderr=True)))
        if command.draws:
            from analysis.console.drawing import drawing

            given.append(around.enter_context(drawing(command.draws)))
        with loading():
            module = import_module(f"analysis.{name}")
        if command.recorded:
            around.enter_context(interruption())
        return getattr(module, function)(*given)


def _require_there(options: Any) -> None:
    """FileNotFoundError where a scene or a checkpoint is not: at once, as libraries take seconds to load."""
    from splat.model.untrusted import require_scene  # not for --help

    for folder in (getattr(options, "scene", None), getattr(getattr(options, "foreign", None), "scene", None)):
        if isinstance(folder, Path):
            require_scene(folder)
    for name in ("checkpoint", "source"):
        if isinstance(path := getattr(options, name, None), Path) and ":" not in path.name:  # FILE.py:FACTORY
            require_checkpoint(path)


def _require_compiler() -> None:
    """InputError for settings of Numba that keep it from compiling, that its kept kernels would have from then on, or that a
    stranger's folder brings."""
    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    if re.fullmatch(r"-\d+|0+", threads):
        raise InputError(f"expected NUMBA_NUM_THREADS of at least 1, got {threads}; unset it")
    for name, usual in (("NUMBA_DISABLE_JIT", "0"), ("NUMBA_OPT", "3")):
        if (given := os.environ.get(name, "")) not in ("", usual):
            raise InputError(f"expected kernels as Numba compiles them, got {name}={given}; unset it")
    if (file := Path(".numba_config.yaml")).is_file():
        raise InputError(
            f"expected no settings of Numba in the current folder, got {file}; begin in another, or move it"
        )


if __name__ == "__main__":
    command()
