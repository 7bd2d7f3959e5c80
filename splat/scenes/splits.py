"""Training and test views of a scene, by the sparse-view protocols of the field.

LLFF       3, 6 or 9 views.  Names sorted; every 8th, from the first, is a test view; n training views at the rounded,
           evenly spaced places of the rest, np.linspace(0, m - 1, n): RegNeRF, FreeNeRF, FSGS and their followers.
           Images of images_8, 504 x 378
Mip-NeRF   360: 12 or 24 views by the same rule, images of images_8 (FSGS, CoR-GS, DropGaussian).  The same rule holds for
           every scene that no other protocol is for
DTU        3, 6 or 9 views, the first of 25, 22, 28, 40, 44, 48, 0, 8, 13 (views counted from 0); the 25 test views are the
           other ones of the first 49 but 3-7, 16-21 and 36-39, which are badly exposed: pixelNeRF, RegNeRF (`dtu_split_type`
           pixelnerf), DNGaussian, CoR-GS.  Images reduced by 4; metrics inside the objects' masks.  A scene is DTU's by the
           names of its images, whether COLMAP or DTU itself gave the cameras
Blender    training views r_26, r_86, r_2, r_55, r_75, r_93, r_16, r_73, the first n of them; every 8th test view,
           25 of 200: DietNeRF, FreeNeRF.  A folder already reduced to these images gives the same split
named      a transforms.json that lists its training views (train_filenames): all of them, or n at equal steps
explicit   training (and test) views by name
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from landscape.errors import InputError
from splat.scenes.layers import dtu_number
from splat.scenes.scene import Scene
from splat.scenes.view import Frame

HOLD_OUT = 8
BLENDER_TRAINING = (26, 86, 2, 55, 75, 93, 16, 73)
DTU_TRAINING = (25, 22, 28, 40, 44, 48, 0, 8, 13)
DTU_LEFT_OUT = (3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 36, 37, 38, 39)
DTU_VIEWS = 49  # some scans have 64
LOOKS = 20
FEWEST = 3  # training views of the protocols for LLFF and DTU


@dataclass(frozen=True)
class Split:
    """Names of the training and the test views, and the protocol that chose them."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    protocol: str


def usual_views(scene: Scene) -> int:
    """The default number of training views: all 8 of Blender's protocol, those that a file lists, else the fewest."""
    if scene.kind == "blender":
        return len(BLENDER_TRAINING)
    return sum(frame.subset == "train" for frame in scene.frames) or FEWEST


def split_scene(scene: Scene, views: int | None = None) -> Split:
    """The protocol of the scene's kind with that many training views (all by default).  InputError where it lacks views.

    >>> from splat import SyntheticSettings, synthetic_scene
    >>> scene = synthetic_scene(SyntheticSettings(gaussians=50, views=10, width=16, height=12)).scene
    >>> split_scene(scene, 2).train
    ('images/view_001.png', 'images/view_009.png')
    """
    if scene.kind == "blender":
        return blender_split(scene.frames, views)
    if any(frame.subset for frame in scene.frames):
        train_names, test_names = ([f.name for f in scene.frames if f.subset == part] for part in ("train", "test"))
        return Split(evenly_spaced(train_names, views), tuple(test_names), "named")
    if all(dtu_number(name) is not None for name in scene.names):
        return dtu_split(scene.names, views)
    return llff_split(scene.names, views)


def evenly_spaced(names: Sequence[str], n: int | None) -> tuple[str, ...]:
    """n of the names at equal steps, ends included; all where n is None."""
    if n is None:
        return tuple(names)
    if n < 1:
        raise InputError(f"expected at least 1 training view, got {n}")
    if n > len(names):
        raise InputError(f"expected at most {len(names)} training views, which the scene has, got {n}; ask for fewer")
    return tuple(names[int(place)] for place in np.rint(np.linspace(0, len(names) - 1, n)))


def llff_split(names: Sequence[str], n: int | None = None) -> Split:
    """Every 8th of the sorted names tests, n evenly spaced of the others train."""
    names = sorted(names)
    others = [name for i, name in enumerate(names) if i % HOLD_OUT]
    if not others:
        raise InputError(f"expected at least 2 images, one to train and one to test, got {len(names)}")
    return Split(evenly_spaced(others, n), tuple(names[::HOLD_OUT]), "llff")


def blender_split(frames: Sequence[Frame], n: int | None = None) -> Split:
    """The 8-view protocol for n <= 8 where the scene has its views, else n evenly spaced training views."""
    train = [frame.name for frame in frames if frame.subset == "train"]
    test = [frame.name for frame in frames if frame.subset == "test"]
    by_number = {_number(name): name for name in train}
    chosen = [by_number.get(number) for number in BLENDER_TRAINING[:n]]
    if n is None or n > len(BLENDER_TRAINING) or n < 1 or None in chosen:
        return Split(evenly_spaced(train, n), _every_eighth(test), "blender, evenly spaced")
    return Split(tuple(name for name in chosen if name is not None), _every_eighth(test), "blender, 8 views")


def dtu_split(names: Sequence[str], n: int | None = None) -> Split:
    """The first n of the 9 training views (all by default), and the 25 test views, or those that the scene has."""
    by_number = {dtu_number(name): name for name in names}
    if n is not None and not 1 <= n <= len(DTU_TRAINING):
        raise InputError(f"expected 1 to {len(DTU_TRAINING)} training views, as DTU's protocol has, got {n}")
    wanted = DTU_TRAINING[:n]
    missing = [number for number in wanted if number not in by_number]
    if missing:
        raise InputError(
            f"expected the training views {', '.join(map(str, wanted))} of DTU's protocol, got a scene without view "
            f"{missing[0]} (rect_{missing[0] + 1:03d}); restore its image"
        )
    not_tested = {*DTU_TRAINING, *DTU_LEFT_OUT}
    test = [i for i in range(DTU_VIEWS) if i not in not_tested and i in by_number]
    return Split(tuple(by_number[i] for i in wanted), tuple(by_number[i] for i in test), "dtu")


def _every_eighth(names: Sequence[str]) -> tuple[str, ...]:
    """Every eighth name, by the number in it, so that a folder of only these stays whole; by place where there is none."""
    numbers = [_number(name) for name in names]
    return tuple(name for i, (name, k) in enumerate(zip(names, numbers)) if (i if k is None else k) % HOLD_OUT == 0)


def _number(name: str) -> int | None:
    match = re.search(r"(\d+)(\.\w+)?$", name)
    return int(match[1]) if match else None


def spread_views(frames: Sequence[Frame], count: int) -> list[str]:
    """Names of frames that stand for all: each camera belongs to the nearest chosen one, which is in the middle of its own.

    Chosen at first are the one nearest to the middle of all, then always the farthest from those chosen, which prefers the
    edges; then, until nothing changes (at most LOOKS times), the one nearest to the middle of each one's cameras.  InputError
    where fewer than one is asked for.
    """
    if count < 1:
        raise InputError(f"expected at least 1 view, got {count}")
    centres = torch.stack([frame.camera.centre for frame in frames])
    chosen = [int((centres - centres.mean(dim=0)).norm(dim=1).argmin())]
    while len(chosen) < min(count, len(frames)):
        distances = torch.cdist(centres, centres[chosen]).amin(dim=1)
        distances[chosen] = -1.0
        chosen.append(int(distances.argmax()))
    for _ in range(LOOKS):
        nearest = torch.cdist(centres, centres[chosen]).argmin(dim=1)
        nearest[chosen] = torch.arange(len(chosen))  # of cameras at one place, too, each has one
        before, chosen = chosen, [_middle(centres, nearest == k) for k in range(len(chosen))]
        if chosen == before:
            break
    return [frames[i].name for i in chosen]


def _middle(centres: Float[Tensor, "n 3"], members: Bool[Tensor, " n"]) -> int:
    """The member nearest to the mean of all."""
    distances = (centres - centres[members].mean(dim=0)).norm(dim=1)
    return int(distances.masked_fill(~members, float("inf")).argmin())


def explicit_split(names: Sequence[str], train: Sequence[str], test: Sequence[str] | None = None) -> Split:
    """Split with these training views; `test`, else all others, are held out.  A view is a name or its last part."""
    chosen = tuple(_resolve(names, key) for key in train)
    if not chosen or len(set(chosen)) < len(chosen):
        raise InputError(f"expected training views, each once, got {list(train)}")
    others = [name for name in names if name not in chosen]
    held_out = tuple(others if test is None else (_resolve(names, key) for key in test))
    both = sorted(set(chosen) & set(held_out))
    if both:
        raise InputError(f"expected test views that do not train, got {both[0]!r} in both lists")
    return Split(chosen, held_out, "explicit")


def read_names(path: Path) -> tuple[str, ...]:
    """The names of views in a text file, one in each line.  InputError where it is no text or has none."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"expected names of views, one in each line, in {path}, got no text") from error
    names = tuple(line.strip() for line in lines if line.strip())
    if not names:
        raise InputError(f"expected names of views, one in each line, in {path}, got none")
    return names


def _resolve(names: Sequence[str], key: str) -> str:
    if key in names:
        return key
    last = {name: name.rsplit("/", 1)[-1] for name in names}
    matches = [name for name, part in last.items() if key in (part, re.sub(r"\.\w+$", "", part))]
    if len(matches) != 1:
        problem = f"{len(matches)} views have it: {', '.join(matches[:3])}" if matches else "no view has it"
        raise InputError(
            f"expected the name of one view, got {key!r}: {problem}; the names go from {names[0]!r} to {names[-1]!r}"
        )
    return matches[0]
