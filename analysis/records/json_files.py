"""JSON files whose content is a `msgspec.Struct`, written and checked by `msgspec`.

A number that is not finite, for which strict JSON has no place, is the text "NaN", "Infinity" or "-Infinity" (the convention of
protobuf's JSON), and comes back as a float.  A field that is UNSET is left out.
"""

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from landscape.errors import InputError
from splat.model import untrusted

T = TypeVar("T")
NOT_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def read_json(path: Path, kind: type[T], what: str, remedy: str) -> T:
    """Content of a file.  InputError names the file and, where its content is not of this kind, the key.

    what: what the file should be; remedy: what to do about one that is not.
    """
    return fitted(plain_json(path, what, remedy), kind, f"expected {what} in {path}, got another", remedy)


def plain_json(path: Path, what: str, remedy: str) -> Any:
    """A file's content as plain types.  InputError where it is no JSON."""
    return decoded(with_remedy(remedy, partial(untrusted.read_json, what=what), path))


def with_remedy(remedy: str, read: Callable[[Path], T], path: Path) -> T:
    """What a reader makes of a file; its InputError says what to do too."""
    try:
        return read(path)
    except InputError as error:
        raise InputError(f"{error}; {remedy}") from None


def fitted(data: Any, kind: type[T], where: str, remedy: str) -> T:
    """Plain types as a structure.  InputError, which begins with `where`, says what was expected under which key.

    >>> fitted({"a": {"x": "?"}}, dict[str, dict[str, float]], "numbers", "measure again")
    Traceback (most recent call last):
    landscape.errors.InputError: numbers: expected `float`, got `str` - at `$[...][...]`; measure again
    """
    try:
        return msgspec.convert(data, kind, strict=True)
    except msgspec.ValidationError as error:
        said = str(error)
        raise InputError(f"{where}: {said[:1].lower()}{said[1:]}; {remedy}") from None


def plain(value: Any) -> Any:
    """A structure as plain types, without what is UNSET.  TypeError where a value has no place in JSON."""
    return msgspec.to_builtins(value, enc_hook=_plain_number)


def _plain_number(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"expected a number, text, list or mapping, got {type(value).__name__}; arrays belong in an .npz")


def json_text(data: Any) -> str:
    """Plain types as strict JSON."""
    return json.dumps(encoded(data), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def encoded(value: Any) -> Any:
    """Plain types with floats that are not finite as text, and of names of files what is no text spelt out."""
    match value:
        case str():
            return value.encode("utf-8", "backslashreplace").decode()
        case float() if not math.isfinite(value):
            return "NaN" if math.isnan(value) else f"{'-' * (value < 0)}Infinity"
        case dict():
            return {key: encoded(item) for key, item in value.items()}
        case list() | tuple():
            return [encoded(item) for item in value]
    return value


def decoded(value: Any) -> Any:
    """The inverse of `encoded`."""
    match value:
        case str():
            return NOT_FINITE.get(value, value)
        case dict():
            return {key: decoded(item) for key, item in value.items()}
        case list():
            return [decoded(item) for item in value]
    return value
