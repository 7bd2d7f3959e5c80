"""Values held to their types' hints by `msgspec`: of settings when they are made, of files, which anyone may have written.

    Positive, NonNegative    finite real numbers above 0, of at least 0      Share    in [0, 1]
    Count, Length            whole numbers of 64 bits of at least 0, of at least 1

A whole number stands for a real one.  Real numbers of settings are also such that float32, in which they work, holds them, and
the squares of large ones: `MOST`, `LEAST`; or infinite, where their type does not say finite.
"""

import re
import reprlib
import sys
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache
from math import inf
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin, get_type_hints

import msgspec
from torch import Tensor

from landscape.errors import InputError

LARGEST = sys.float_info.max
MOST, LEAST = 1e18, 2.0**-126  # of a setting's size, unless it is 0
Positive = Annotated[float, msgspec.Meta(gt=0, le=LARGEST)]
NonNegative = Annotated[float, msgspec.Meta(ge=0, le=LARGEST)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Length = Annotated[int, msgspec.Meta(ge=1, le=2**63 - 1)]

_hints = cache(lambda kind: get_type_hints(kind, include_extras=True))


class Typed:
    """Base of frozen dataclasses.  InputError that names the field where a value is not what its hint says."""

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            value = getattr(self, name)
            if get_origin(hint) is not ClassVar and not is_dataclass(value):
                self.require(name, typed(hint, value, name))

    def require(self, name: str, value: Any) -> None:
        """Raise InputError where a value of the right type is none for the field."""


class Settings(Typed):
    """Base of frozen dataclasses of settings."""

    def require(self, name: str, value: Any) -> None:
        if isinstance(value, float) and value not in (0, inf) and not LEAST <= abs(value) <= MOST:  # nan fails
            raise InputError(f"{name!r}: expected 0 or a number of a size from {LEAST:.3g} to {MOST:g}, got {value}")


def typed(kind: Any, content: Any, where: str = "", strict: bool = True) -> Any:
    """content as a value of this type; dataclasses make their own checks too.  where: its name in messages.  strict: text is no
    number and no truth value.

    InputError, of one line, that says at which key what was expected and what was found.

    >>> typed(Share, 2, "p_max")
    Traceback (most recent call last):
    landscape.errors.InputError: 'p_max': expected float <= 1.0, got 2
    """
    _require_no_tensor(kind, content, where)
    try:
        return msgspec.convert(content, kind, strict=strict)
    except UnicodeEncodeError as error:
        raise InputError(f"{where and repr(where) + ': '}expected text, got {reprlib.repr(error.object)}") from error
    except msgspec.ValidationError as error:
        said, _, path = str(error).replace("`", "").partition(" - at ")
        path = path.rpartition("$")[2]
        found = None
        if "..." not in path:
            kind, found = _at(re.findall(r"\w+", path), kind, content)
        if said.startswith("Invalid enum"):
            said = f"expected {' or '.join(_choices(kind))}"
        if ", got" not in said and isinstance(found, int | float | str):
            large = type(found) is int and abs(found) >= 2**63
            said += ", got a whole number of more than 64 bits" if large else f", got {reprlib.repr(found)}"
        said = said.replace("Number out of range", "expected float").replace(f"<= {LARGEST}", "that is finite")
        key = f"{where}{path}".lstrip(".")
        raise InputError(f"{key and repr(key) + ': '}{said[0].lower()}{said[1:]}") from error


def _require_no_tensor(kind: Any, content: Any, where: str) -> None:
    """InputError where a tensor stands for an object, for which msgspec takes it."""
    if isinstance(content, Tensor) and (is_dataclass(kind) or get_origin(kind) is dict):
        raise InputError(f"'{where.lstrip('.')}': expected object, got Tensor")
    if is_dataclass(kind) and isinstance(content, dict):
        for name, hint in _hints(kind).items():
            _require_no_tensor(hint, content.get(name), f"{where}.{name}")
    elif get_origin(kind) in (list, dict) and isinstance(content, list | dict):
        for value in content.values() if isinstance(content, dict) else content:
            _require_no_tensor(get_args(kind)[-1], value, f"{where}[...]")


def _at(names: list[str], kind: Any, content: Any) -> tuple[Any, Any]:
    """The type and the value at a path of fields and indices."""
    for name in names:
        kind = _hints(kind)[name] if is_dataclass(kind) else get_args(kind)[0]
        content = content[int(name)] if isinstance(content, list | tuple) else content[name]
    return kind, content


def _choices(kind: Any) -> list[str]:
    """What a value may be, of a type with choices: their words, and the numbers that it may be besides."""
    if kind in (int, float):
        return [kind.__name__]
    if get_origin(kind) is Literal:
        return [repr(choice) for choice in get_args(kind)]
    return [word for part in get_args(kind) for word in _choices(part)]


def leaves(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings as one level, by their dotted names.

    >>> leaves({"probe": {"gamma": 0.5}, "viewpoint.parallax": False})
    {'probe.gamma': 0.5, 'viewpoint.parallax': False}
    """
    result = {}
    for key, value in settings.items():
        result |= {f"{key}.{name}": v for name, v in leaves(value).items()} if isinstance(value, dict) else {key: value}
    return result
