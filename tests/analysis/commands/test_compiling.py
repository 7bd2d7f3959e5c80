"""That kernels are compiled is said, once."""

import io

from numba import njit
from rich.console import Console

from analysis.commands.compiling import SAID, compiling_is_said


def test_what_is_compiled_is_said_once_and_what_is_known_is_not():
    first, second = (njit(lambda x, step=step: x + step) for step in (1, 2))
    said = io.StringIO()
    with compiling_is_said(Console(file=said, width=200)):
        assert first(1) == 2
        assert said.getvalue() == f"{SAID}\n"
        assert second(1) == 3 and first(2) == 3
    assert said.getvalue() == f"{SAID}\n"
    again = io.StringIO()
    with compiling_is_said(Console(file=again)):
        assert first(3) == 4
    assert again.getvalue() == ""
