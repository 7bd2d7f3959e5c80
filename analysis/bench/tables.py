"""Tables of a bench: in the terminal, and as CSV."""

from pathlib import Path

import pandas as pd
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from analysis.console.plain import say
from splat.training.checkpoint import write_atomically


def rich_table(table: pd.DataFrame, title: str) -> Table:
    """A data frame for a terminal 80 characters wide: the first column keeps its line, the others' headings wrap."""
    result = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for place, column in enumerate(table):
        numeric = pd.api.types.is_numeric_dtype(table[column]) and not pd.api.types.is_bool_dtype(table[column])
        heading = str(column).replace("_", " ")
        result.add_column(heading, justify="right" if numeric else "left", no_wrap=place == 0, overflow="fold")
    for row in table.itertuples(index=False):
        result.add_row(*map(_cell, row))
    return result


def _cell(value: object) -> str | Text:
    if isinstance(value, bool):
        return "yes" if value else Text("no", "bold")
    if isinstance(value, float):
        small = 0 < abs(value) < 1e-3
        return "" if pd.isna(value) else f"{value:.1e}" if small else f"{value:.{3 if abs(value) < 1000 else 6}g}"
    return escape(str(value))


def write_table(table: pd.DataFrame, path: Path, console: Console | None = None) -> None:
    """Write a CSV file, and say where on the console."""
    write_atomically(path, table.to_csv(index=False).encode())
    if console is not None:
        say(str(path), console=console)
