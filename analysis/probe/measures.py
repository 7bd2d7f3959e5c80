"""What a probe adds with --measures: the loss and the renders beyond derivatives at the training views.

new poses           the cameras of the views that were held out, POSES of them spread evenly; none where none were
order fragility     `splat.curvature.scores.new_poses`
field sharpness     `splat.curvature.scores.field_sharpness`, with a correlation over LENGTH of the scene's size
critical sharpness  `landscape.critical_sharpness` along Adam's next update
open curvature      `splat.curvature.scores.new_poses`

They are made on the CPU, each with the same draws for every checkpoint.
"""

from math import nan

import torch

from analysis.measures.units import scene_size
from analysis.records.schema import Number
from landscape import critical_sharpness
from landscape.results import Measured, Progress, finite_or_none
from splat.backend.cpu.adam import BETA1
from splat.curvature.objective import SceneObjective
from splat.curvature.scores.field_sharpness import field_sharpness
from splat.curvature.scores.new_poses import open_curvature, order_fragility
from splat.curvature.scores.poses import Poses
from splat.scenes.splits import spread_views
from splat.training.adam import Adam
from splat.training.origin.subject import Subject
from splat.training.state import Training

POSES = 4
LENGTH = 0.01  # of the scene's size


def measures(
    subject: Subject, objective: SceneObjective, seed: int = 0, progress: Progress = lambda *_: None
) -> dict[str, tuple[Number, Number]]:
    """Each by name with its error; at new poses with _new behind its name.  objective: of the subject; one on a GPU is made
    again on the CPU, where the training moves to."""
    training = subject.checkpoint.training
    if objective.active.flat.device.type != "cpu":
        training.move(torch.device("cpu"))
        objective = subject.objective(loss=objective.loss_settings)
    gaussians, found = training.gaussians, {}
    background = training.config.background_colour(gaussians.flat.dtype)
    seen = Poses([view.camera for view in objective.views], background, training.config.render)
    new = new_poses(subject)

    def begun(name: str) -> torch.Generator:
        progress(len(found), 7, name.replace("_", " "))
        return torch.Generator().manual_seed(seed)

    for name, poses in {"order_fragility": seen, "order_fragility_new": new}.items():
        if poses.cameras:
            found[name] = order_fragility(gaussians, poses, begun(name))
    length, name = LENGTH * scene_size(objective), "field_sharpness"
    field = field_sharpness(gaussians, objective, new if new.cameras else seen, length, begun(name))
    found |= {name: field.loss} | ({f"{name}_new": field.images} if new.cameras else {})
    begun("critical_sharpness")
    found["critical_sharpness"] = along_the_update(objective, training)
    if new.cameras:
        begun("open_curvature")
        opened, ratio = open_curvature(gaussians, seen, new)
        found |= {"open_curvature": opened, "open_ratio": Measured(ratio, nan)}
    return {name: (finite_or_none(value), finite_or_none(error)) for name, (value, error) in found.items()}


def new_poses(subject: Subject) -> Poses:
    """Cameras of POSES held-out views."""
    config, flat = subject.checkpoint.training.config, subject.checkpoint.training.gaussians.flat
    held_out = subject.scene.select(subject.checkpoint.scene.test)
    chosen = spread_views(held_out, POSES) if held_out else ()
    cameras = [frame.camera for frame in subject.scene.select(chosen)]
    return Poses(cameras, config.background_colour(flat.dtype), config.render)


def along_the_update(objective: SceneObjective, training: Training) -> Measured:
    """Critical sharpness along Adam's next update, with the gradient of all training views for its first moment too.

    Along a momentum of single views the loss need not fall, and the sharpness is then undefined; so it is without moments.
    """
    second, updates = training.adam.second.select(objective.mask), training.adam.updates
    if updates == 0:
        return Measured(nan, nan)
    active = training.gaussians.select(objective.mask)  # as stored, quaternions too: the moments are of these
    at, count, gradient = objective.linearizer(active), len(objective.views), torch.zeros_like(active.flat)
    for index in range(count):
        gradient += at(index).gradient / count
    rates = training.gaussians.with_flat(training.rates(training.step)).select(objective.mask).flat
    first = active.with_flat(gradient * (1 - BETA1**updates))  # of so many equal gradients
    after = active.flat.clone()
    Adam(first, second, updates).update(after, gradient, rates)
    step = active.flat - after
    return critical_sharpness(objective.loss, active.flat, step, float(gradient.double() @ step.double()))
