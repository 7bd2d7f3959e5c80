"""Settings by name: `--set KEY=VALUE` on the command line, and tables of a sweep's file.

KEY     dotted names through nested settings, `method.probe.gamma`; the settings of the method need no `method.`
VALUE   a plain value, or text that is read by the setting's type: a number, true or false, one of its choices, none where
        that is allowed, a list with commas (empty: no entry)
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from landscape.errors import InputError, did_you_mean
from splat.model.typed import leaves
from splat.training.methods.methods import METHODS
from splat.training.state import MethodSettings, TrainConfig

T = TypeVar("T")
LABELS = ("name", "protocol")  # say which settings the others are


def assignments(texts: Sequence[str]) -> dict[str, str]:
    """KEY=VALUE of each text."""
    pairs = [text.partition("=") for text in texts]
    found: dict[str, str] = {}
    for (key, equals, value), text in zip(pairs, texts, strict=True):
        if not (key.strip() and equals):
            raise InputError(f"expected KEY=VALUE, as in gamma=0.5, got {text!r}")
        if key.strip() in found:
            raise InputError(f"expected each KEY once, got --set {key.strip()} twice; leave one out")
        found[key.strip()] = value.strip()
    return found


def overridden(config: TrainConfig, changes: Mapping[str, Any]) -> TrainConfig:
    """The settings with some of them changed.

    >>> overridden(TrainConfig(), {"densify.every": "50"}).densify.every
    50
    """
    own = _settable(TrainConfig)
    for key, value in changes.items():
        path = key.split(".")
        if path[0] not in own + _settable(type(config.method)):
            raise InputError(_unknown(key, config))
        config = _changed(config, path if path[0] in own else ["method", *path], value, key)
    return config


def _unknown(key: str, config: TrainConfig) -> str:
    """Sentence for a key that is no setting: with the one that was meant, of whatever method, else with all that there are."""
    common, own, method = _names(config), _names(config.method), config.method.name
    words = f"expected a setting of the training or of the method {method}, got {key!r}"
    if key in LABELS:
        return f"{words}, which is an option of its own"
    others = {name: _names(kind()) for name, kind in METHODS.items()}
    if of := [name for name, settings in others.items() if key in settings]:
        return f"{words}, which is one of --method {' and '.join(of)}"
    if meant := did_you_mean(key, [*common, *own]):
        return words + meant
    for name, settings in others.items():
        if meant := did_you_mean(key, settings):
            return f"{words}{meant.removesuffix('?')} of the method {name}?"
    return f"{words} (of the training: {', '.join(common)}; of {method}: {', '.join(own) or 'none'})"


def _names(settings: TrainConfig | MethodSettings) -> list[str]:
    """Dotted names of all single settings; of the training without those of its method."""
    return [name for name in leaves(asdict(settings)) if name not in LABELS and not name.startswith("method.")]


def _settable(kind: type) -> list[str]:
    return [name for name in get_type_hints(kind) if name not in LABELS]


def _changed(settings: T, path: list[str], value: Any, key: str) -> T:
    hints, settable = get_type_hints(type(settings)), _settable(type(settings))
    if path[0] not in settable:
        meant = did_you_mean(path[0], settable)
        raise InputError(f"expected a setting among {', '.join(settable)}, got {path[0]!r} in {key!r}{meant}")
    now = getattr(settings, path[0])
    if is_dataclass(now):
        if not path[1:]:
            inner = f"{key}.{fields(now)[0].name}"
            raise InputError(f"expected the name of a single setting, as in {inner}, got {key!r}")
        return replace(settings, **{path[0]: _changed(now, path[1:], value, key)})  # pyright: ignore[reportCallIssue, reportArgumentType]
    if path[1:]:
        raise InputError(f"expected {path[0]!r} to be the last name in {key!r}: it is a single setting")
    return replace(settings, **{path[0]: read_value(value, hints[path[0]], key)})  # pyright: ignore[reportCallIssue, reportArgumentType]


def read_value(value: Any, hint: Any, key: str) -> Any:
    """A value of a setting's type."""
    kind, options = get_origin(hint), get_args(hint)
    if kind in (Union, UnionType):
        if value is None or value == "none":
            return _require(NoneType in options, None, hint, value, key)
        for option in (option for option in options if option is not NoneType):
            with suppress(InputError):
                return read_value(value, option, key)
        return _require(False, None, hint, value, key)
    if kind is Literal:
        found = [option for option in options if str(option) == str(value)]
        return _require(bool(found), next(iter(found), None), hint, value, key)
    if kind is tuple:
        items = [item.strip() for item in value.split(",") if item.strip()] if isinstance(value, str) else value
        _require(isinstance(items, list | tuple), None, hint, value, key)
        repeated = options[1:] == (Ellipsis,)
        _require(repeated or len(items) == len(options), None, hint, value, key)
        return tuple(read_value(item, options[0] if repeated else options[i], key) for i, item in enumerate(items))
    if hint is bool:
        known = {"true": True, "false": False}
        word = str(value).lower()
        return _require(word in known, known.get(word), hint, value, key)
    _require(not isinstance(value, bool), None, hint, value, key)
    try:
        read = hint(value)
    except (TypeError, ValueError, OverflowError):
        read = None
    # int(0.5) is 0, which nobody asked for
    return _require(read is not None and (isinstance(value, str) or read == value), read, hint, value, key)


def _require(good: bool, read: Any, hint: Any, value: Any, key: str) -> Any:
    if not good:
        raise InputError(f"expected {_words(hint)} for {key}, got {value!r}")
    return read


def _words(hint: Any) -> str:
    kind, options = get_origin(hint), get_args(hint)
    if kind is Literal:
        return " or ".join(map(str, options))
    if kind is tuple:
        return f"a list of {_words(options[0])}"
    if kind in (Union, UnionType):
        return " or ".join(_words(option) for option in options)
    return {
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        str: "text",
        Path: "a path",
        NoneType: "none",
    }.get(hint, str(hint))
