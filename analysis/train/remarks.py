"""Remarks of `landscape train` before its first step: what was skipped or scaled or is not reached, and a poor start."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from splat.model.typed import leaves
from splat.scenes.scene import Scene
from splat.scenes.view import View, inside_image
from splat.training.methods.second_order.steps import SecondOrder
from splat.training.start import Source
from splat.training.state import TrainConfig, Training

FEW = 500  # Gaussians at the start; density control adds others near those that are there, so that places without stay empty
NAMED = 12  # views in the first line
NARROW = 0.02  # of an image's width: where Gaussians with a smaller sigma are removed for their size, it is said
HOW_IT_STARTS: dict[Source, str] = {
    "points": "the scene's points",
    "triangulated": "points triangulated in the training views",
    "dense": "a plane sweep over the training views",
    "random": "random points",
    "box": "random points in the box of the scene's points",
}
HOW_TO_START: dict[Source, str] = {
    "box": "the published training does so; --start scene begins at the scene's own points",
    "random": "`landscape sfm PHOTOS` makes a scene with points, and --start triangulated finds some in the training views",
    "triangulated": "--start dense finds more, and so do more --views",
    "dense": "take more --views or larger images, or --start random",
    "points": "--start dense finds more, and so do more --views",
}


def remarks(
    scene: Scene,
    asked: TrainConfig,
    config: TrainConfig,
    begun: tuple[Source, int] | None,
    training: Training,
    view: View,
) -> list[str]:
    """asked, config: the settings, not scaled and scaled, without what a checkpoint brings; begun: the start and its Gaussians,
    None where there is a checkpoint; view: one to train on."""
    found = [*scene.notes, begun and poor_start(scene, *begun), _scaled(asked, config), _not_reached(config)]
    found += [*_of_second_order(config), removes_for_size(training, view), cut_by_near(training, view)]
    return [words for words in found if words]


def removes_for_size(training: Training, view: View) -> str:
    """Warning that 3DGS's rule removes Gaussians that are small in the image; empty where it does not.

    The rule's unit is the radius of the training cameras, which is little where they are few or stand close together.
    """
    config, camera = training.config, view.camera
    schedule, steps = config.method.density_control(config), range(training.step + 1, config.iterations + 1)
    rounds = [n for n in steps if schedule.densifies(n, config.iterations) and schedule.prunes_large(n)]
    if schedule.prune_scale is None or not rounds or isinstance(config.method, SecondOrder):
        return ""
    largest = schedule.prune_scale * training.extent
    offsets = training.gaussians.means.detach().double().cpu() - camera.centre
    pixels = largest * camera.fx / max(float((offsets @ camera.forward).median()), largest)
    if pixels > NARROW * camera.width:
        return ""
    return (
        f"3DGS's rule for scenes seen from all around removes all Gaussians with a sigma above {largest:.3g}, here some "
        f"{pixels:.2g} px, in each round from step {rounds[0]:,} to {rounds[-1]:,}: the loss is high until then; "
        "--set densify.prune_scale=none keeps them"
    )


def cut_by_near(training: Training, view: View) -> str:
    """Warning of Gaussians in a view's picture that are not drawn, for they are nearer than the near plane; else empty."""
    near, means = training.config.render.near, training.gaussians.means.detach().double().cpu()
    count = int(inside_image(view.camera, means, (0.0, near)).sum())
    if not count:
        return ""
    return (
        f"{count:,} of {len(means):,} Gaussians are nearer to {view.name} than the near plane at {near:g} world units, and not "
        "drawn there: scale the scene, or lower it with --set render.near=X"
    )


def begins(scene: Scene, views: Sequence[View], held_out: int, training: Training, source: Source | Path) -> str:
    """Two lines on what a training is about to do.  source: a checkpoint where it starts from that."""
    config, camera, step = training.config, views[0].camera, training.step
    names = [view.name for view in views]
    if len(names) > NAMED:
        names = [*names[: NAMED - 1], "...", names[-1]]
    gaussians = f"{len(training.gaussians):,} Gaussians"
    what = source if isinstance(source, Path) else HOW_IT_STARTS[_kind(scene, source)]
    start = f"after step {step:,}: {gaussians}" if step else f"start: {gaussians} from {what}"
    return (
        f"{scene.name}: {len(views)} views to train on ({', '.join(names)}), {held_out} held out, "
        f"{camera.width} x {camera.height} px\n"
        f"{start}; {config.method.name}, {config.iterations:,} steps, seed {config.seed}"
    )


def poor_start(scene: Scene, source: Source, gaussians: int) -> str:
    """Warning of a start at random or from few points, and what to do; else empty.

    >>> from splat import SyntheticSettings, synthetic_scene
    >>> scene = synthetic_scene(SyntheticSettings(gaussians=50, views=3, width=16, height=12)).scene
    >>> poor_start(scene, "triangulated", 41)
    'it starts from 41 points only, and may leave places empty; --start dense finds more, and so do more --views'
    """
    kind = _kind(scene, source)
    if kind in ("random", "box"):
        return f"it starts from {gaussians:,} random points, and most lie on no surface; {HOW_TO_START[kind]}"
    few = f"it starts from {gaussians:,} points only, and may leave places empty; {HOW_TO_START[kind]}"
    return few if gaussians < FEW else ""


def _kind(scene: Scene, source: Source) -> Source:
    """Source that "scene" stands for."""
    return source if source != "scene" else "random" if scene.points is None else "points"


def _scaled(asked: TrainConfig, config: TrainConfig) -> str:
    """Note on settings of a published schedule that were scaled to the length of the training; empty if there is none."""
    before, after = (leaves(asdict(settings)) for settings in (asked, config))
    changes = [
        f"{key.removeprefix('method.')} {before[key]} to {after[key]}" for key in after if before[key] != after[key]
    ]
    if not changes:
        return ""
    return (
        f"{config.method.name}: its published schedule is scaled to {config.iterations} steps: {', '.join(changes)}; "
        "--set KEY=VALUE gives one of them another value"
    )


def _of_second_order(config: TrainConfig) -> list[str]:
    """Notes on what a method in place of Adam leaves out."""
    method, found = config.method, []
    if isinstance(method, SecondOrder) and config.densify.enabled:
        found.append(f"{method.name}: no Gaussian is cloned, split or removed, and no opacity is reset")
    if isinstance(method, SecondOrder) and config.loss.pixel == "l1":
        found.append(f"{method.name}: l1 has no second derivative; it descends charbonnier, a smooth l1, instead")
    return found


def _not_reached(config: TrainConfig) -> str:
    """Note on parts of a method that a run does not reach; empty if there is none."""
    parts = config.method.parts(config)
    late = [f"{name} = {begins}" for name, begins in parts.items() if begins >= config.iterations]
    if not late:
        return ""
    return (
        f"{config.method.name}: what begins after step {' and '.join(late)} is not reached in {config.iterations} steps; take "
        f"more --iterations, or --set {late[0].split()[0]}={config.iterations // 2}"
    )
