"""Settings by name: `--set KEY=VALUE` on the command line, and tables of a sweep's file.

KEY     dotted names through nested settings, `method.probe.gamma`; the settings of the method need no `method.`
VALUE   a plain value, or text that is read by the setting's type: a number, true or false, one of its choices, none where
        that is allowed, a list with commas (empty: no entry)
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from landscape.errors import InputError, did_you_mean
from splat.model.typed import leaves, typed
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
    """Sentence for a key that is no setting: with the method that has it, or the setting that was meant."""
    names, others = [*_names(config), *_names(config.method)], {name: _names(kind()) for name, kind in METHODS.items()}
    words = f"expected a setting of the training or of the method {config.method.name}, got {key!r}"
    if of := [name for name, settings in others.items() if key in settings]:
        return f"{words}, which is one of --method {' and '.join(of)}"
    return words + (did_you_mean(key, names) or f"; there are {', '.join(names)}")


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
    """A value of a setting's type, from a plain one or from text."""
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    text = isinstance(value, str)
    if text and value == "none" and NoneType in kinds:
        return None
    if text and Path in kinds:
        return Path(value)
    listed = text and any(get_origin(kind) is tuple for kind in kinds)
    content = [item.strip() for item in value.split(",") if item.strip()] if listed else value
    try:
        return typed(hint, content, key, strict=not text)
    except InputError as error:
        raise InputError(re.sub(r", got (str|int|float|bool)$", f", got {value!r}", str(error))) from None
