"""JSON files whose content is a `msgspec.Struct`, written and checked by `msgspec`.

A number that is not finite, for which strict JSON has no place, is the text "NaN", "Infinity" or "-Infinity" (the convention of
protobuf's JSON), and comes back as a float.  A field that is UNSET is left out.
"""

import json
import math
import re
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
STEP = re.compile(r"\.(\w+)|\[(\d+)\]|(\[\.\.\.\])")  # of a path of msgspec, which leaves out the keys of mappings
MISSING = "Object missing required field `"


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
    """Plain types as a structure.  InputError, which begins with `where`, says what was expected under which key."""
    try:
        return msgspec.convert(data, kind, strict=True)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {_said(data, kind, str(error))}; {remedy}") from None


def _said(data: Any, kind: type, message: str) -> str:
    """msgspec's message with the whole key and the value there.

    >>> _said({"a": {"x": 1.0, "y": "?"}}, dict[str, dict[str, float]], "Expected `float`, got `str` - at `$[...][...]`")
    'expected `float`, got \\'?\\' as "a.y"'
    """
    what, _, path = message.partition(" - at `")
    keys: list[str] = []
    value = data
    for key, index, unknown in STEP.findall(path.removeprefix("key in ")):
        step = _failing(data, value, kind, message) if unknown else int(index) if index else key
        keys.append(f"[{step}]" if index else f".{step}")
        value = value[step]
    if what.startswith(MISSING):
        return f'expected the key "{"".join([*keys, "."])[1:]}{what.removeprefix(MISSING)[:-1]}", got none'
    what = what[:1].lower() + what[1:]
    if keys and ", got `" in what:
        shown = msgspec.json.encode(value).decode() if isinstance(value, list | dict) else repr(value)
        what = f"{what.partition(', got `')[0]}, got {shown if len(shown) < 60 else f'{shown[:57]}...'}"
    return what + (f' as "{"".join(keys)[1:]}"' if keys else "")


def _failing(data: Any, mapping: dict[str, Any], kind: type, message: str) -> str:
    """The key of a mapping in data whose value msgspec refuses with this message; the others are taken away."""
    entries = dict(mapping)
    for key, value in entries.items():
        mapping.clear()
        mapping[key] = value
        try:
            msgspec.convert(data, kind, strict=True)
        except msgspec.ValidationError as error:
            if str(error) == message:
                return key
    raise AssertionError(f"no key of {list(entries)} is refused with {message}")


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
