"""What is refused, and in which words."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from landscape.errors import InputError


def refused(words: str, call: Callable[..., object], *given: Any, error: Any = InputError, **more: Any) -> str:
    """The sentence with which a call is refused, in which a pattern is found.  given, more: the call's arguments."""
    with pytest.raises(error, match=words) as caught:
        call(*given, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# by a call that is a fault of the program: no sentence for whoever gave input
misused = partial(refused, error=ValueError)
