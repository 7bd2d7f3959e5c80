"""Command lines of the figures: `python -m figures.NAME` of a record's folder, or of a table.

Each prints the files that it has written and returns the exit code: 2 where its input is not what it expects, which it says on
stderr.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from figures.style import PAPER, SUFFIXES, save
from landscape.errors import InputError, TooLittleMemory


def folder_script(
    draw: Callable[..., list[Path]], what: str, command: str, options: Sequence[ArgumentParser] = ()
) -> int:
    """Draw into a folder of `landscape COMMAND`.

    draw(folder, suffix, ...): with what the options parse, by name.
    """
    parser = ArgumentParser(description=f"Draw {what} into its folder.", parents=options)
    parser.add_argument("folder", help=f"a folder written by `landscape {command}`; -: the one named on standard input")
    _add_format(parser)
    arguments = vars(parser.parse_args())
    folder, suffix = arguments.pop("folder"), arguments.pop("format")
    folder = sys.stdin.read() if folder == "-" else folder  # a name may hold a line break
    if not folder:  # who was to name it has ended
        return 0
    return print_files(lambda: draw(Path(folder), suffix, **arguments))


def table_script(draw: Callable[[Path], Iterable[tuple[str, Figure]]], what: str, name: str, command: str) -> int:
    """Draw beside a table of `landscape COMMAND`, which is called `name` there.

    draw(table): names of files, without suffix, each with its figure.
    """
    parser = ArgumentParser(description=f"Draw {what}.")
    parser.add_argument("table", type=Path, help=f"{name}, as written by `landscape {command}`")
    _add_format(parser)
    options = parser.parse_args()

    def drawn() -> Iterator[Path]:
        try:
            for stem, figure in draw(options.table):
                yield save(figure, options.table.with_name(f"{stem}.{options.format}"))
        except InputError:
            raise
        except (FileNotFoundError, ValueError, KeyError, IndexError) as error:
            raise InputError(
                f"expected {name} as written by landscape {command}, got {options.table}: {error}"
            ) from None

    return print_files(drawn)


def drawn_by(processes: int, draw: Callable[[Any], Path], names: Sequence[Any]) -> list[Path]:
    """draw(name) of all names, the last ones first.  TooLittleMemory where the system ends one of the processes."""
    if min(processes, len(names)) <= 1:
        return [draw(name) for name in names]
    with ProcessPoolExecutor(min(processes, len(names))) as pool:
        try:
            return list(pool.map(draw, reversed(names)))[::-1]
        except BrokenProcessPool as error:
            raise TooLittleMemory("a process that draws was ended, as Linux does where memory runs out") from error


def print_files(draw: Callable[[], Iterable[Path]]) -> int:
    """Print each file as it is written, or what is wrong with the input; returns the exit code."""
    try:
        for path in draw():
            print(path)
    except (FileNotFoundError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _add_format(parser: ArgumentParser) -> None:
    parser.add_argument("--format", choices=SUFFIXES, default="png")
    add_paper(parser)


def add_paper(parser: ArgumentParser) -> ArgumentParser:
    words = f"as a paper has it: NAME{PAPER}, columns wide, serif, panels lettered, the caption beside it"
    parser.add_argument("--paper", dest="format", action="store_const", const=PAPER[1:], help=words)
    return parser
