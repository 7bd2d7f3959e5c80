"""The files of a run: their names, and its scores and seconds, small JSON files.

What is damaged is refused by the name of the file, with what to do.  Needs no torch.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import Any

from analysis.records.records import decoded

RECORDS = "trajectory.csv"  # in a run


NO_TIME = "no time"  # how the note of a record begins that was skipped for that


CHECKPOINT, METRICS, SECONDS = "checkpoint.pt", "metrics.json", "seconds.json"
NUMBER, MAYBE = int | float, int | float | None
_OF_VIEWS = {"psnr": MAYBE, "ssim": MAYBE, "lpips": MAYBE}
_METRICS = {
    "gaussians": int,
    "train": _OF_VIEWS,
    "test": _OF_VIEWS,
    "seconds": {"wall": MAYBE, "cpu": MAYBE, "threads": MAYBE},
}
_SECONDS = {"step": int, "wall": NUMBER, "cpu": NUMBER, "threads": int | None}
_SCORE_AGAIN = "remove it and repeat the training's command with --resume, which scores again"
_FORGET = "remove it: nothing but the time until its last checkpoint is lost"


def read_scores(run: Path) -> dict[str, Any]:
    """`metrics.json` of a run, see `analysis/train/command.py`; "Infinity" is read as the number."""
    return _read(run / METRICS, _METRICS, "the scores of landscape train", _SCORE_AGAIN)


def read_seconds(run: Path) -> dict[str, Any]:
    """`seconds.json` of a run, see `analysis/train/training_time.py`."""
    found = _read(run / SECONDS, _SECONDS, "the seconds of a training", _FORGET)
    return {key: found.get(key) for key in _SECONDS}


def _read(path: Path, layout: Mapping[str, Any], what: str, remedy: str) -> dict[str, Any]:
    """The object in a file.  ValueError where it is none, or where what it holds is not what the layout says."""
    try:
        data = decoded(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise ValueError(f"expected {what} in {path}, got a damaged file ({error}); {remedy}") from None
    if not isinstance(data, dict):
        raise ValueError(f"expected {what} in {path}, got {data!r} instead of an object; {remedy}")
    if wrong := _wrong(data, layout, ""):
        raise ValueError(f"expected {what} in {path}, got {wrong}; {remedy}")
    return data


def _wrong(value: Any, layout: type | UnionType | Mapping[str, Any], where: str) -> str:
    """What is not as the layout says, and where; empty where all is.

    layout: a type, or a key's own layout in an object, which may be null or missing; keys that it does not name pass.

    >>> _wrong({"step": 3, "test": {"psnr": "high"}}, {"step": int, "test": {"psnr": float | None}}, "")
    "'high' as test.psnr"
    """
    if not isinstance(layout, Mapping):
        return "" if isinstance(value, layout) else f"{value!r} as {where}"
    if value is None:
        return ""
    if not isinstance(value, dict):
        return f"{value!r} as {where}"
    found = (_wrong(value.get(key), part, f"{where}.{key}".lstrip(".")) for key, part in layout.items())
    return next(filter(None, found), "")
