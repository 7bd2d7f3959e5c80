"""The table of a study, as `python -m notebooks.paper` writes it: its columns are those of `study.py`."""

import reprlib
from pathlib import Path

import pandas as pd

from landscape.errors import InputError
from splat.model import untrusted

FILE = "study.csv"
KEYS = ("scene", "method", "seed", "steps", "views")
REASONS = ("lambda_max_reason", "lambda_min_reason")
TEXTS = ("scene", "method", "size", "date", "machine", "commit", *REASONS)  # columns of text; the others are numbers


def read_table(path: Path) -> pd.DataFrame:
    """The rows of a table FILE.  Raises InputError where a column is missing or has other than numbers."""
    texts = dict.fromkeys(TEXTS, str)
    table = untrusted.read_table(path, "the table of a study", dtype=texts, keep_default_na=False, na_values=[""])
    if missing := [key for key in KEYS if key not in table]:
        raise InputError(f"expected the table of a study in {path}, got one without the column {missing[0]}")
    for name in table.columns.difference(TEXTS):
        numbers = pd.Series(pd.to_numeric(table[name], errors="coerce"))
        if wrong := list(table[name][numbers.isna() & (table[name].notna() | (name in KEYS))]):
            raise InputError(f"expected numbers as {name} in {path}, got {reprlib.repr(wrong[0])}")
        table[name] = numbers
    return table
