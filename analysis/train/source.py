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
from splat.training.origin.foreign import REGULARIZERS
from splat.training.origin.frames import posed
from splat.training.origin.options import Foreign
from splat.training.origin.scene_reference import SceneReference
from splat.training.state import TrainConfig

Planned = tuple[Scene, Split, TrainConfig, SceneReference]


def from_checkpoint(options: TrainOptions, plan: Planned, out: Path) -> tuple[Planned, Gaussians | None]:
    """The plan in the checkpoint's world and with its renderer, and its Gaussians; the plan as it is without --from.

    Density control begins and recurs after as many steps as in a long training, unless --set says otherwise: each of the rounds
    that a short training from points has would double the Gaussians of a trained scene before the last ones have moved.
    InputError where the checkpoint is refused, and where --set changes its renderer or --trained-by has no file to speak of.
    """
    scene, split, config, reference = plan
    asked, train = Foreign(**vars(options.foreign)), None
    if options.from_ is None:
        if asked != Foreign():
            raise InputError(
                "expected --from beside --trained-by, --antialiased, --opacity-reg or --scale-reg, which speak of its file, "
                "got none"
            )
        return plan, None
    changes = assignments(options.set)
    if any(key.startswith("render.") for key in changes):
        raise InputError("expected --from, which brings its renderer, or --set render..., got both; leave one out")
    regularized = [name for name in REGULARIZERS if getattr(asked, name) is not None]
    if twice := [name for name in regularized if f"loss.{name}" in changes]:
        raise InputError(f"expected --{twice[0].replace('_', '-')} or --set loss.{twice[0]}, got both; leave one out")
    if is_foreign(options.from_):
        asked = replace(asked, scene=options.scene, images=options.images, downscale=options.downscale)
        train = split.train
    found = open_checkpoint(options.from_, asked, out, train)
    world = found.scene
    scene = posed(scene, world.similarity, centred=world.centred)
    reference = replace(reference, similarity=world.similarity, centred=world.centred)
    theirs = found.training.config
    weights = {name: getattr(theirs.loss, name) for name in regularized}
    loss = replace(config.loss, border=theirs.loss.border, **weights)
    whole = {name: 1.0 for name in ("start_share", "every_share") if f"densify.{name}" not in changes}
    config = replace(config, render=theirs.render, loss=loss, densify=replace(config.densify, **whole))
    return (scene, split, config, reference), found.training.gaussians
