"""Lines of a command in the terminal, as they are: paths and names may hold what rich reads as markup."""

from rich.console import Console


def say(*lines: str, console: Console | None = None, style: str | None = None) -> None:
    """Print lines unchanged and unwrapped, nothing where there are none.  console: of the standard output by default.

    >>> say("runs/[old]/a", "1 of 2")
    runs/[old]/a
    1 of 2
    """
    if lines:
        (console or Console()).print(*lines, sep="\n", style=style, soft_wrap=True, highlight=False, markup=False)
