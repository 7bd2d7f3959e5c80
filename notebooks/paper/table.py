"""The table of a study, as `python -m notebooks.paper` writes it: its columns are those of `study.py`."""

import reprlib
from pathlib import Path

import pandas as pd

from landscape.errors import InputError

FILE = "study.csv"
KEYS = ("scene", "method", "seed", "steps", "views")
REASONS = ("lambda_max_reason", "lambda_min_reason")
TEXTS = ("scene", "method", "size", "date", "machine", "commit", *REASONS)  # columns of text; the others are numbers


def read_table(path: Path) -> pd.DataFrame:
    """The rows of a table FILE.  Raises InputError where a column is missing or has other than numbers."""
    try:
        table = pd.read_csv(path, dtype=dict.fromkeys(TEXTS, str), keep_default_na=False, na_values=[""])
    except (ValueError, OverflowError) as error:  # pandas names no file
        raise InputError(f"expected the table of a study in {path}, got {error}") from None
    if missing := [key for key in KEYS if key not in table]:
        raise InputError(f"expected the table of a study in {path}, got one without the column {missing[0]}")
    for name in table.columns.difference(TEXTS):
        numbers = pd.Series(pd.to_numeric(table[name], errors="coerce"))
        if wrong := list(table[name][numbers.isna() & (table[name].notna() | (name in KEYS))]):
            raise InputError(f"expected numbers as {name} in {path}, got {reprlib.repr(wrong[0])}")
        table[name] = numbers
    return table
