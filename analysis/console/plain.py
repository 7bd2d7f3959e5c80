"""Lines of a command in the terminal, as they are: paths and names may hold what rich reads as markup, or a terminal obeys."""

from rich import control
from rich.console import Console

# by a terminal, of a text
OBEYED = dict.fromkeys([*range(9), *range(11, 32), *range(127, 160)], "\N{REPLACEMENT CHARACTER}")
control._CONTROL_STRIP_TRANSLATE |= OBEYED  # of all that rich prints, which takes a few of them away by itself


def say(*lines: str, console: Console | None = None, style: str | None = None) -> None:
    """Print lines unchanged and unwrapped, nothing where there are none.  console: of the standard output by default.

    >>> say("runs/[old]/a", "1 of 2")
    runs/[old]/a
    1 of 2
    """
    if lines:
        (console or Console()).print(*lines, sep="\n", style=style, soft_wrap=True, highlight=False, markup=False)
