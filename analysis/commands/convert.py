"""`landscape convert`: Gaussians from one tool's file to another's, or depth maps of their scene's views."""

import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import PurePosixPath

import numpy as np
import torch
from rich.console import Console

from analysis.commands.options import ConvertOptions
from analysis.console.plain import say
from analysis.runs.sweep.sweep_file import arguments
from analysis.train.options import TrainOptions
from landscape.errors import InputError
from splat.model.files.read import is_foreign, read_splats
from splat.model.files.splat_file import SplatFile
from splat.model.files.splat_ply import splat_ply
from splat.model.files.tensor_files import gsplat_bytes
from splat.model.settings import RenderSettings
from splat.projection.antialias import baked
from splat.render.render import render_depth
from splat.training.checkpoint import load_checkpoint, open_subject, save_checkpoint, write_atomically
from splat.training.origin.frames import shift_in_words, shift_of
from splat.training.origin.presets import PRESETS, render_of
from splat.training.origin.subject import Checkpoint

OURS = ("splat-landscape", "splat-landscape-mip")
FAINT = 0.01  # of alpha: what is less covered is as far as the farthest that is not


@dataclass(frozen=True)
class Seen:
    """Rendering of Gaussians.  centred: with the principal points in the images' middles; moved: in another world."""

    render: RenderSettings
    centred: bool
    moved: bool

    def is_that_of(self, tool: str, *, antialiased: bool) -> bool:
        preset = PRESETS[tool]
        other = Seen(render_of(preset, {}, antialiased=antialiased), preset.centred, preset.world != "scene")
        return self == other


def run_convert(options: ConvertOptions) -> int:
    """Read, write, and say what was written; returns the exit code."""
    if options.out.exists():
        raise FileExistsError(f"expected a new file to write, but {options.out} exists; choose another")
    to = options.to or ("graphdeco" if options.out.suffix.lower() == ".ply" else "own")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    notes = _to_own(options) if to == "own" else _to_depths(options) if to == "depths" else _to_tool(options, to)
    say(*notes, style="yellow", console=Console(stderr=True))
    return 0


def _to_own(options: ConvertOptions) -> list[str]:
    """A run that has just stopped at these Gaussians; of further numbers it has no place for."""
    if not is_foreign(options.source):
        raise InputError(
            f"expected another tool's file to make our own of, got {options.source}; name --to graphdeco or gsplat"
        )
    checkpoint = open_subject(options.source, options.foreign, options.out).checkpoint
    here = os.path.relpath(checkpoint.scene.absolute, options.out.parent.resolve())
    save_checkpoint(options.out, checkpoint.training, replace(checkpoint.scene, relative=here))
    extra = read_splats(options.source).extra
    lost = [f"not written, as our own checkpoint has no place for it: {', '.join(extra)}"] if extra else []
    return [f"{len(checkpoint.training.gaussians)} Gaussians", *checkpoint.assumptions, *lost]


def _to_tool(options: ConvertOptions, to: str) -> list[str]:
    found, seen = _foreign(options) if is_foreign(options.source) else own_file(load_checkpoint(options.source))
    extra: Mapping[str, np.ndarray] = found.extra
    said = {"antialiased": found.antialiased, "train": found.train, "width": found.width}
    if to == "graphdeco":
        gaussians = found.gaussians
        content = splat_ply(gaussians, extra, found.tool, **said)
    else:
        gaussians = baked(found.gaussians)
        content = gsplat_bytes(gaussians, found.step or 0, extra, found.tool, **said)
    write_atomically(options.out, content)
    kept = [f"with {', '.join(extra)}"] if extra else []
    if gaussians is not found.gaussians:
        kept.append("their 3-D filter, for which such a file has no place, is now in scales and opacities")
    back = read_splats(options.out)
    return [f"{len(found.gaussians)} Gaussians", *kept, *found.notes, *_unsaid(back, seen)]


def _unsaid(back: SplatFile, seen: Seen | None) -> list[str]:
    """A sentence on how the file has to be read, where it does not say so itself.  back: as it is read; seen: as it was."""
    tool = back.tool or ""
    if seen is None or (tool in PRESETS and seen.is_that_of(tool, antialiased=back.antialiased)):
        return []
    render = seen.render
    how = f"antialiasing {render.antialias}, blur {render.blur:g}, alpha cap {render.alpha_max:g}, near {render.near:g}"
    for name in PRESETS:
        for antialiased in (back.antialiased, True):
            if seen.is_that_of(name, antialiased=antialiased):
                option = "" if antialiased == back.antialiased else " --antialiased"
                return [f"the file cannot say how it was rendered ({how}): read it with --trained-by {name}{option}"]
    where = ", through the images' middles" if seen.centred else ""
    return [f"no --trained-by renders as it was ({how}{where}), and the file cannot say it: pictures will differ"]


def _to_depths(options: ConvertOptions) -> list[str]:
    """Expected depth of every view of the scene, held out or not, as NAME.npy; of alpha 1 by division."""
    subject = open_subject(options.source, options.foreign, options.out)
    checkpoint, scene = subject.checkpoint, subject.scene
    training = checkpoint.training
    views = scene.load([frame.name for frame in scene.frames])
    with torch.no_grad():
        for view in views:
            depth, alpha = render_depth(training.gaussians, view.camera, training.config.render)
            if not (seen := alpha > FAINT).any():
                raise InputError(
                    f"expected Gaussians in sight of every view, got none in {view.name}; name another file"
                )
            content, depth = BytesIO(), depth / alpha.clamp_min(FAINT)
            np.save(content, torch.where(seen, depth, depth[seen].max()).float().numpy())
            path = options.out / PurePosixPath(view.name).with_suffix(".npy")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content.getvalue())
    made = checkpoint.scene
    again = TrainOptions(scene.root, images=made.images, downscale=made.downscale, method="fsgs", depths=options.out)
    words = arguments("train", replace(again, set=("depths=depth",)))
    return [f"depth of {len(views)} views: {shlex.join(['landscape', *words])}", *checkpoint.assumptions]


def _foreign(options: ConvertOptions) -> tuple[SplatFile, Seen | None]:
    """A file, and how its trainer saw it; None where it is not known."""
    found = read_splats(options.source)
    tool = options.foreign.trained_by or found.tool
    found = replace(found, tool=tool, antialiased=found.antialiased or options.foreign.antialiased)
    if tool is None or tool not in PRESETS:
        return found, None
    preset = PRESETS[tool]
    render = render_of(preset, found.settings, antialiased=found.antialiased)
    return found, Seen(render, preset.centred, preset.world != "scene")


def own_file(checkpoint: Checkpoint) -> tuple[SplatFile, Seen]:
    """A checkpoint of ours as a file of splats, with the tool whose conventions are those it was trained with, if any."""
    training, scene = checkpoint.training, checkpoint.scene
    shift = shift_of(scene.similarity)
    seen = Seen(training.config.render, scene.centred, scene.similarity is not None and shift is None)
    antialiased = seen.render.antialias != "none"
    tool = next((name for name in OURS if seen.is_that_of(name, antialiased=antialiased)), None)
    notes = () if shift is None else (shift_in_words(shift),)
    width = max(width for width, _ in scene.sizes)
    said = {"antialiased": antialiased, "train": tuple(scene.train), "width": width, "notes": notes}
    return SplatFile(training.gaussians, OURS[0], tool, training.step, **said), seen
