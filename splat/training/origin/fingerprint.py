"""Fingerprint of numbers: everything that they are about, in three named parts, and the version of the formulas.

    data        of each view that they were computed from: pose, lens, photograph, mask, depth map (`ViewData`)
    question    the loss, the renderer and the settings that change them, by their dotted names
    state       digest of the Gaussians and of the number of steps behind them
    formulas    FORMULAS, raised by hand where a formula changes a number (tests/analysis/probe/test_formulas.py)

Work that was interrupted continues from what has all four in common with it.  Records are shown together, and belong to a
checkpoint, by the three parts alone.  A training is continued, and counts as done, by data and question: new formulas are no
reason to train again.  Needs no torch.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from hashlib import blake2b, file_digest
from math import asin, degrees, dist, hypot, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

if TYPE_CHECKING:
    from splat.model.gaussians import Gaussians
    from splat.scenes.view import Frame

FORMULAS = 6
SAME = 1e-9  # of the cameras' distances: what round-off of double precision may move, on another machine
SHOWN = 3  # views that a sentence names
Vector = tuple[float, float, float]
Positive = Annotated[float, Meta(gt=0)]
Length = Annotated[int, Meta(ge=1)]
KINDS = {"photograph": "photograph", "mask": "mask", "depth": "depth map"}


@dataclass(frozen=True)
class ViewData:
    """What numbers take from one view.

    rotation, centre: as in `Camera`; lens: focal lengths and principal point, px; size: width and height, px, as it is used.
    distortion: model and parameters of the file's lens, where that is no pinhole.  photograph, mask, depth: digests of the
    files; None where there is none.
    """

    rotation: tuple[Vector, Vector, Vector]
    centre: Vector
    lens: tuple[Positive, Positive, float, float]
    size: tuple[Length, Length]
    distortion: str = ""
    photograph: str | None = None
    mask: str | None = None
    depth: str | None = None

    @classmethod
    def of(cls, frame: "Frame") -> "ViewData":
        camera, files = frame.camera, (frame.path, frame.mask, frame.depth)
        first, second, third = camera.rotation.tolist()
        x, y, z = camera.centre.tolist()
        lens, size = (camera.fx, camera.fy, camera.cx, camera.cy), (camera.width, camera.height)
        rows = tuple(first), tuple(second), tuple(third)
        return cls(rows, (x, y, z), lens, size, frame.distortion, *map(_digest_of_file, files))

    def changes(self, now: "ViewData", reach: float) -> list[str]:
        """What is not the same now, in words.  reach: distance from the origin of the farthest camera, world units."""
        found = []
        if not (moved := dist(self.centre, now.centre)) <= SAME * reach:
            found.append(f"centre moved by {moved:.3g} world units")
        apart = hypot(*(a - b for one, other in zip(self.rotation, now.rotation) for a, b in zip(one, other)))
        if not apart <= SAME:
            found.append(f"turned by {degrees(2 * asin(min(1.0, apart / sqrt(8)))):.3g}°")
        if self.size != now.size:
            found.append("{} x {} px".format(*now.size) + " instead of {} x {} px".format(*self.size))
        scale = [new / old for old, new in zip(self.size, now.size)]
        lengths = [b / a / s - 1 for a, b, s in zip(self.lens[:2], now.lens[:2], scale)]
        if not max(map(abs, lengths)) <= SAME:
            found.append(f"focal length by {100 * max(lengths, key=abs):+.3g}%")
        shift = [b / s - a for a, b, s in zip(self.lens[2:], now.lens[2:], scale)]
        if not hypot(*shift) <= SAME * max(self.size):
            found.append(f"principal point by {hypot(*shift):.3g} px")
        if self.distortion != now.distortion:
            found.append(f"lens {now.distortion or 'a pinhole'} instead of {self.distortion or 'a pinhole'}")
        return found + [words for name in KINDS if (words := self._file_changes(now, name))]

    def _file_changes(self, now: "ViewData", name: str) -> str:
        """Depth maps are compared where both have one: only a training reads them."""
        was, kept = getattr(self, name), getattr(now, name)
        if was == kept or (name == "depth" and None in (was, kept)):
            return ""
        if was is None:
            return f"a {KINDS[name]} where there was none"
        return f"no {KINDS[name]} where there was one" if kept is None else f"another {KINDS[name]}"


Data = Mapping[str, ViewData]


def changes(was: Data, now: Data) -> list[str]:
    """What is not the same now, in words, for each view by its name.

    >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    >>> one, other = (ViewData(eye, (x, 1.0, 0.0), (50.0, 50.0, 16.0, 12.0), (32, 24)) for x in (0.0, 0.1))
    >>> changes({"a": one, "b": one}, {"a": other, "b": one})
    ["'a': centre moved by 0.1 world units"]
    """
    reach = max((hypot(*view.centre) for view in was.values()), default=0.0)
    both = {name: view.changes(now[name], reach) for name, view in was.items() if name in now}
    alone = {name: ["not there any more"] for name in was.keys() - now.keys()}
    alone |= {name: ["not there before"] for name in now.keys() - was.keys()}
    found = both | dict(sorted(alone.items()))
    return [f"{name!r}: {', '.join(parts)}" for name, parts in found.items() if parts]


def in_short(changed: list[str]) -> str:
    """The first of the changes, and how many more views have some."""
    more = f"; and {len(changed) - SHOWN} more" if len(changed) > SHOWN else ""
    return "; ".join(changed[:SHOWN]) + more


@dataclass(frozen=True)
class Fingerprint:
    """See the module.  question: leaves; those about the loss itself begin with "objective."."""

    data: dict[str, ViewData]
    question: dict[str, Any]
    state: str
    formulas: int = field(default_factory=lambda: FORMULAS)

    def but(self, *names: str) -> "Fingerprint":
        """The same without these parts of its question."""
        left = {
            key: value
            for key, value in self.question.items()
            if not f"{key}.".startswith(tuple(f"{n}." for n in names))
        }
        return replace(self, question=left)

    @property
    def digests(self) -> dict[str, str | int]:
        """Each part as short as can be."""
        parts = {"data": asdict(self)["data"], "question": self.question}
        return {name: digest(part) for name, part in parts.items()} | {"state": self.state, "formulas": self.formulas}

    @property
    def digest(self) -> str:
        """Of all four."""
        return digest(self.digests)

    def apart_from(self, other: "Fingerprint") -> str:
        """Which of the three parts of two records of one function at one point are not the same, in words; else empty."""
        mine, theirs = (
            {name: value for name, value in each.question.items() if name.startswith("objective.")}
            for each in (self, other)
        )
        parts = {
            "checkpoint": self.state != other.state,
            "data": changes(self.data, other.data),
            "loss": mine != theirs,
        }
        return " and ".join(name for name, different in parts.items() if different)

    def answers(self, asked: "Fingerprint") -> bool:
        """Whether its numbers are those asked for; it may have more."""
        there = self.question.items()
        same = self.state == asked.state and not changes(self.data, asked.data)
        return same and all(item in there for item in asked.question.items())


def state_of(gaussians: "Gaussians", step: int) -> str:
    """Digest of Gaussians after so many steps."""
    found = blake2b(f"{gaussians.sh_degree} {step}".encode(), digest_size=16)
    for tensor in (gaussians.flat, gaussians.filter_widths):
        if tensor is not None:
            found.update(f" {tensor.dtype} {tensor.numel()} ".encode())
            found.update(tensor.detach().cpu().contiguous().numpy().data)
    return found.hexdigest()


def digest(content: Any) -> str:
    """Digest of plain types."""
    return blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=8).hexdigest()


def _digest_of_file(path: Path | None) -> str | None:
    if path is None:
        return None
    with path.open("rb") as stream:
        return file_digest(stream, lambda: blake2b(digest_size=8)).hexdigest()
