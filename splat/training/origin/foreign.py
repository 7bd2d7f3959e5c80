"""A file of Gaussians that another tool trained, as a training on its scene that can be probed and continued.

The trainer's conventions are those of its preset; the views are those that were asked for, that the tool's files name, or that
its convention holds.  Before anything is measured the Gaussians are rendered on training views: where that is not their
picture, frame, images or conventions are wrong, and so would be all numbers.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from landscape.errors import InputError
from splat.losses.reference import LossSettings
from splat.model.files.read import model_folder, read_splats
from splat.model.files.splat_file import SplatFile
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.model.untrusted import loose_json
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import Split, explicit_split, read_names, split_scene
from splat.training.origin.frames import Similarity, gsplat_frames, nerfstudio_frame, posed, shift_of, shift_to_origin
from splat.training.origin.likeness import Reading, likeliest
from splat.training.origin.options import Foreign
from splat.training.origin.presets import PRESETS, Preset, World, preset_of, render_of
from splat.training.origin.subject import SceneReference
from splat.training.state import TrainConfig, Training

TURNED_BACK = "its y and z axes are those of a PLY, not of its format, as the photographs show"
GUARDED = 2  # views
# A preset of each kind of world
WORLDS: dict[World, str] = {"scene": "gsplat-raw", "gsplat": "gsplat", "nerfstudio": "nerfstudio"}
NERFSTUDIO_SHARE = 0.9
LOSSY = "curvature of the quantised scene: the file has rounded the trained numbers"
WHITE = (1.0, 1.0, 1.0)
REGULARIZERS = ("opacity_reg", "scale_reg")
MCMC_DEFAULT = 0.01  # of both in 3DGS-MCMC, whose cfg_args does not have them


def foreign_training(
    path: Path, ask: Foreign, picture: Path, train: Sequence[str] | None = None
) -> tuple[Training, SceneReference, dict[str, Any]]:
    """The training, its scene as seen from path, and what was assumed, for the record.

    train: names of the training views, where known.  picture: where render and photograph are written side by side when
    they do not agree.  InputError then, and for what is missing or cannot be.
    """
    found = read_splats(path)
    _require_said(found, ask, path, train)
    name, source = preset_of(found.tool, ask.trained_by)
    preset = PRESETS[name]
    antialiased = found.antialiased or ask.antialiased
    render = render_of(preset, found.settings, antialiased=antialiased)
    scene, images, downscale = _scene(found, ask, preset)
    split, how = _split(scene, found, ask, path, train)
    reference = SceneReference.to(scene, path, split, images, downscale)
    config = _config(scene, found, preset.loss, render, ask)
    names = [split.train[i * len(split.train) // GUARDED] for i in range(min(GUARDED, len(split.train)))]
    found_in = partial(_readings, found, scene, path)
    tried = found_in(preset.world), _elsewhere(preset.world, found_in)
    reading, level = likeliest(*tried, scene, names, config, picture, centred=preset.centred)
    similarity = reading.similarity
    reference = replace(reference, similarity=similarity, centred=preset.centred)
    moved = posed(scene, similarity, centred=preset.centred)
    training = Training.start(reading.gaussians, moved.extent(split.train), config)
    training.step = found.step or 0
    notes = [*found.notes, *reading.notes, *preset.different, *_left_out(found, config.loss)] + [LOSSY] * found.lossy
    said = {"format": found.format, "trained_by": name, "trained_by_source": source, "views": how, "notes": notes}
    said |= {"images": images, "downscale": downscale}
    conventions = asdict(replace(preset, render=render, loss=config.loss))
    return training, reference, {**said, "psnr": level, "similarity": similarity, "preset": conventions}


def _require_said(found: SplatFile, ask: Foreign, path: Path, train: Sequence[str] | None) -> None:
    """InputError that names all that is neither asked for nor said by the file, or by what lies beside it; its notes: the
    options that say it."""
    asked = (ask.train_list, ask.guess_views, train is not None, ask.views is not None)
    views = any((*asked, found.train, "eval" in found.settings))
    if not views and ask.scene is not None:
        _, known = _split(load_scene(ask.scene, ask.images), found, ask, path, train)
        views = not known.startswith("guessed")
    of = f"the original 3DGS; one of {', '.join(PRESETS)}{f', got {found.tool!r} in the file' if found.tool else ''}"
    needs = {
        "--scene SCENE": ("its folder", ask.scene),
        "--trained-by graphdeco": (of, ask.trained_by or found.tool in PRESETS),
        "--views 3": (
            "by the scene's protocol; or --train-list FILE, or --guess-views as its tool does by default",
            views,
        ),
    }
    if lacking := {words: about for words, (about, said) in needs.items() if not said}:
        what = " and ".join(f"{words} ({about})" for words, about in lacking.items())
        error = InputError(f"expected {what} for {path}, as neither it nor a file beside it says so, got none")
        error.add_note(" ".join(lacking))
        raise error


def _scene(found: SplatFile, ask: Foreign, preset: Preset) -> tuple[Scene, str | None, float]:
    """The scene with the images that the trainer saw: those asked for, else as its file or settings say, else as it does by
    default."""
    assert ask.scene is not None
    images, resolution = ask.images, found.settings.get("resolution", -1)
    named = found.settings.get("images")
    if images is None and isinstance(named, str) and (ask.scene / named).is_dir() and re.fullmatch(r"images\w*", named):
        images = named
    background = WHITE if found.settings.get("white_background") is True else None
    downscale = 1.0 if ask.downscale is None else ask.downscale
    scene = load_scene(ask.scene, images, downscale, background)
    if ask.downscale is None and (found.width or preset.widest):
        width = max(frame.camera.width for frame in scene.frames)
        if found.width:
            downscale = max(width / found.width, 1.0)
        elif isinstance(resolution, int) and resolution in (1, 2, 4, 8):
            downscale = float(resolution)
        elif isinstance(resolution, int | float) and 0 < resolution < width:
            downscale = width / resolution
        elif preset.widest and width > preset.widest:
            downscale = width / preset.widest
        if downscale > 1:
            scene = load_scene(ask.scene, images, downscale, background)
    return scene, images, downscale


def _split(scene: Scene, found: SplatFile, ask: Foreign, path: Path, train: Sequence[str] | None) -> tuple[Split, str]:
    """The training views, and where they are known from."""
    if ask.train_list is not None and ask.views is not None:
        raise InputError("expected --views or --train-list, got both; leave one out")
    if ask.train_list is not None:
        train = read_names(ask.train_list)
    if train is not None:
        return explicit_split(scene.names, train), "as listed"
    if ask.views is not None:
        return split_scene(scene, None if ask.views == "all" else ask.views), f"asked for: {ask.views}"
    held_out = split_scene(scene)
    if found.train:
        train = explicit_split(scene.names, found.train).train
        others = [name for name in held_out.test if name not in train]
        return explicit_split(scene.names, train, others), "as the file names them"
    if found.settings.get("eval") is False:
        held_out = explicit_split(scene.names, scene.names)
    used = _used(path, scene) if found.settings else set()
    if used:
        train = [name for name in held_out.train if name in used]
        if train:
            return explicit_split(scene.names, train, held_out.test), "from cameras.json and cfg_args"
    if "eval" in found.settings:
        return held_out, "from cfg_args"
    if held_out.protocol == "named":
        return held_out, "as the scene's file lists them"
    if found.tool == "nerfstudio" and scene.kind == "transforms":
        count = len(scene.names)
        places = np.linspace(0, count - 1, ceil(count * NERFSTUDIO_SHARE), dtype=int)
        return explicit_split(scene.names, [scene.names[i] for i in places]), "guessed: nine tenths, as nerfstudio does"
    return held_out, "guessed: all but those that its protocol holds out, every eighth of most scenes"


def _used(path: Path, scene: Scene) -> set[str]:
    """Names of the scene's images that graphdeco's `cameras.json` lists; empty where there is none, or one of another scene."""
    file = model_folder(path) / "cameras.json"
    if not file.is_file():
        return set()
    try:
        listed = {Path(str(camera["img_name"])).stem for camera in loose_json(file.read_text(encoding="utf-8"))}
    except (ValueError, OSError, KeyError, TypeError, RecursionError):
        return set()
    return {name for name in scene.names if Path(name).stem in listed}


def _config(scene: Scene, found: SplatFile, loss: LossSettings, render: RenderSettings, ask: Foreign) -> TrainConfig:
    """3DGS, with the trainer's renderer and loss, on the scene's background."""
    red, green, blue = scene.background.tolist()
    if isinstance(weight := found.settings.get("ssim_lambda"), float):
        loss = replace(loss, ssim_weight=weight)
    loss = replace(loss, **{name: _weight(name, getattr(ask, name), found) for name in REGULARIZERS})
    return TrainConfig(iterations=max(1, found.step or 1), background=(red, green, blue), render=render, loss=loss)


def _weight(name: str, asked: float | Literal["trained"] | None, found: SplatFile) -> float:
    """Weight of a regulariser.  InputError where that of the training is asked for, and is not known."""
    if asked != "trained":
        return asked or 0.0
    if isinstance(known := found.settings.get(name), float):
        return known
    option = f"--{name.replace('_', '-')}"
    usual = f", such as 3DGS-MCMC's default, {option} {MCMC_DEFAULT:g}" if "cap_max" in found.settings else ""
    raise InputError(
        f"expected {option} with a number, as the settings beside the file do not say with what it was trained{usual}, got "
        "trained"
    )


def _left_out(found: SplatFile, loss: LossSettings) -> list[str]:
    """Sentences on what belonged to the loss of the training, as its settings say, and does not belong to this one."""
    missing = [
        f"{name} {weight:g}"
        for name in REGULARIZERS
        if isinstance(weight := found.settings.get(name), float) and weight and not getattr(loss, name)
    ]
    lines = []
    if missing:
        options = " ".join(f"--{each.split()[0].replace('_', '-')} trained" for each in missing)
        lines.append(f"its training's {' and '.join(missing)} are not in this loss; {options} adds them")
    if "cap_max" in found.settings and not (loss.opacity_reg or loss.scale_reg):
        lines.append(
            "3DGS-MCMC has regularisers of opacities and scales, whose weights it does not write; they are not in this loss: "
            f"--opacity-reg {MCMC_DEFAULT:g} --scale-reg {MCMC_DEFAULT:g} adds those of its defaults"
        )
    if found.settings.get("train_test_exp") is True:
        lines.append("the exposures of its images, which it fitted too (train_test_exp), are not applied")
    if found.settings.get("use_scale_regularization") is True:
        lines.append("splatfacto's regulariser of elongated Gaussians is not in this loss")
    return lines


def _readings(found: SplatFile, scene: Scene, path: Path, kind: World) -> Iterator[Reading]:
    """All that the file may mean in a kind of world.  InputError where the scene has not that."""
    if kind == "gsplat":
        worlds: Sequence[Similarity | None] = gsplat_frames(scene)
    else:
        worlds = [nerfstudio_frame(path, scene) if kind == "nerfstudio" else shift_to_origin(scene)]
    for gaussians, notes in ((found.gaussians, ()), (found.other_axes, (TURNED_BACK,))):
        if gaussians is not None:
            near = [_near(gaussians, world) if kind == "scene" else gaussians for world in worlds]
            yield from (Reading(each, world, notes) for each, world in zip(near, worlds, strict=True))


def _elsewhere(kind: World, found_in: Callable[[World], Iterator[Reading]]) -> Iterator[Reading]:
    """What a preset with another world than that of this kind would have meant."""
    for other, name in WORLDS.items():
        with suppress(InputError):  # the scene has no such world
            for each in found_in(other) if other != kind else ():
                fault = f"the world of {WORLDS[kind]}, got that of {name}"
                yield replace(each, fault=fault, remedy=f"take --trained-by {name}")


def _near(gaussians: Gaussians, world: Similarity | None) -> Gaussians:
    """The Gaussians in a world that was moved to its cameras: moved too, unless they lie there already."""
    shift = None if world is None else shift_of(world.tolist())
    if shift is None:
        return gaussians
    away = torch.tensor(shift, dtype=torch.float64)
    means = gaussians.means.double()
    if means.median(dim=0).values.norm() > away.norm() / 2:
        means = means - away
    return replace(gaussians, flat=Gaussians.pack(gaussians.attributes | {"means": means.to(gaussians.flat)}).flat)
