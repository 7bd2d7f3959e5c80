"""Types that the options of several commands share.

Each command's options are a plain dataclass beside the command, in an `options.py` that imports nothing heavy: help is quick.
The help keeps the line breaks of their docstrings: a line is a sentence.
"""

from typing import Annotated, Literal, TypeVar

from tyro.conf import arg

DeviceName = Literal["auto", "cpu", "cuda"]
T = TypeVar("T")
Unset = Annotated[T | None, arg(help_behavior_hint="")]  # its docstring says what stands for None
