"""Start a training from a checkpoint, our own or another tool's: with its Gaussians, its renderer, in its world."""

from dataclasses import replace
from pathlib import Path

from analysis.console.overrides import assignments
from analysis.train.options import TrainOptions
from landscape.errors import InputError
from splat.model.files.read import is_foreign
from splat.model.gaussians import Gaussians
from splat.scenes.scene import Scene
from splat.scenes.splits import Split
from splat.training.checkpoint import open_checkpoint
from splat.training.origin.foreign import Foreign
from splat.training.origin.frames import posed
from splat.training.origin.scene_reference import SceneReference
from splat.training.state import TrainConfig

Planned = tuple[Scene, Split, TrainConfig, SceneReference]


def from_checkpoint(options: TrainOptions, plan: Planned, out: Path) -> tuple[Planned, Gaussians | None]:
    """The plan in the checkpoint's world and with its renderer, and its Gaussians; the plan as it is without --from.

    InputError where the checkpoint is refused, and where --set changes its renderer or --trained-by has no file to speak of.
    """
    scene, split, config, reference = plan
    if options.from_ is None:
        if options.trained_by is not None or options.antialiased:
            raise InputError("expected --from beside --trained-by or --antialiased, which speak of its file, got none")
        return plan, None
    if any(key.startswith("render.") for key in assignments(options.set)):
        raise InputError("expected --from, which brings its renderer, or --set render..., got both; leave one out")
    names, foreign = tuple(split.train), is_foreign(options.from_)
    said = {"trained_by": options.trained_by, "antialiased": options.antialiased or None}
    asked = Foreign(options.scene, None, names, images=options.images, downscale=options.downscale, **said)
    picture = out.with_name(f"{out.name}-mismatch.png")
    found = open_checkpoint(options.from_, asked if foreign else Foreign(**said), picture)
    world = found.scene
    scene = posed(scene, world.similarity, centred=world.centred)
    reference = replace(reference, similarity=world.similarity, centred=world.centred)
    theirs = found.training.config
    loss = replace(config.loss, border=theirs.loss.border)
    return (scene, split, replace(config, render=theirs.render, loss=loss), reference), found.training.gaussians
