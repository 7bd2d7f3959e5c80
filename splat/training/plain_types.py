"""Whether plain values are of the types that they should be of, where a file holds them that anyone may have written."""

import textwrap
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from torch import Tensor


def short(value: Any) -> str:
    """What a value is, in a line."""
    return f"a {type(value).__name__}" if isinstance(value, Tensor) else textwrap.shorten(repr(value), 80)


def fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is of a type: int (of 64 bits), float (or an int), bool, str, list, tuple, dict, Literal, X | None.

    >>> fits({"step": 3}, dict[str, int | bool]), fits({"step": 10**30}, dict[str, int | bool])
    (True, False)
    """
    if get_origin(hint) in (Union, UnionType):
        return any(fits(value, option) for option in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if get_origin(hint) is list:
        return type(value) is list and all(fits(item, get_args(hint)[0]) for item in value)
    if get_origin(hint) is dict:
        of_keys, of_values = get_args(hint)
        return type(value) is dict and all(fits(k, of_keys) and fits(v, of_values) for k, v in value.items())
    if get_origin(hint) is tuple:
        options = get_args(hint)
        if options[1:] == (Ellipsis,):
            return type(value) is tuple and all(fits(item, options[0]) for item in value)
        return type(value) is tuple and len(value) == len(options) and all(map(fits, value, options))
    if type(value) is int:  # of any size, of which neither a tensor nor a float holds all
        return hint in (int, float) and abs(value) < 2**63
    return type(value) is hint
