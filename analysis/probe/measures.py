"""What a probe adds with --measures: the loss and the renders beyond derivatives at the training views.

new poses           the cameras of the views that were held out, POSES of them spread evenly; none where none were
order fragility     `splat.curvature.scores.new_poses`
field sharpness     `splat.curvature.scores.field_sharpness`, with a correlation over LENGTH of the scene's size
critical sharpness  `landscape.critical_sharpness` along Adam's next update
Adam's sharpness    the largest eigenvalue of D H D, D^2 = rate / (sqrt(v_hat) + eps): H as Adam scales its next update.  Full
                    steps with momentum beta1 oscillate where it is beyond (2 + 2 beta1) / (1 - beta1) = 38 (arXiv 2207.14484)
open curvature      `splat.curvature.scores.new_poses`

They are made on the CPU, each with the same draws for every checkpoint.
"""

from math import nan

import torch

from analysis.measures.units import scene_size
from analysis.records.schema import Number
from landscape import EigenSettings, critical_sharpness, extreme_eigenpairs
from landscape.operators.operator import ScaledOperator
from landscape.results import Measured, Progress, finite_or_none
from splat.backend.cpu.adam import BETA1, EPS, bias_corrections
from splat.curvature.hessian import SceneHessian
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
        progress(len(found), 8, name.replace("_", " "))
        return torch.Generator().manual_seed(seed)

    for name, poses in {"order_fragility": seen, "order_fragility_new": new}.items():
        if poses.cameras:
            found[name] = order_fragility(gaussians, poses, begun(name))
    length, name = LENGTH * scene_size(objective), "field_sharpness"
    field = field_sharpness(gaussians, objective, new if new.cameras else seen, length, begun(name))
    found |= {name: field.loss} | ({f"{name}_new": field.images} if new.cameras else {})
    found |= sharpness_of_adam(objective, training, begun("critical_sharpness"))
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


def sharpness_of_adam(objective: SceneObjective, training: Training, generator: torch.Generator) -> dict[str, Measured]:
    """critical_sharpness and adam_sharpness of Adam's next update, with the gradient of all training views.

    It is the first moment too: along a momentum of single views the loss need not fall, and critical sharpness is then
    undefined.  Both are nan without moments.
    """
    active, moments = training.gaussians.select(objective.mask), training.adam  # as stored, quaternions too
    if moments.updates == 0:
        return dict.fromkeys(("critical_sharpness", "adam_sharpness"), Measured(nan, nan))
    # L does not see the length of a quaternion: of length q it has 1 / q of the gradient at length 1, 1 / q^2 of H
    lengths = active.with_flat(torch.ones_like(active.flat))
    lengths.quats.mul_(active.quats.norm(dim=1, keepdim=True))
    gradient = objective.gradient / lengths.flat
    rates = training.gaussians.with_flat(training.rates(training.step)).select(objective.mask).flat
    first = active.with_flat(gradient * (1 - BETA1**moments.updates))  # of so many equal gradients
    adam, after = Adam(first, moments.second.select(objective.mask), moments.updates), active.flat.clone()
    adam.update(after, gradient, rates)
    step = active.flat - after
    critical = critical_sharpness(objective.loss, active.flat, step, float(gradient.double() @ step.double()))
    # v of this update: with the old one, what was out of sight and now is in sight would move without bound
    v, (root, _) = adam.second.flat, bias_corrections(adam.updates)
    D = torch.where(v > 0, (rates / (v.sqrt() / root + EPS)).sqrt(), 0.0)  # without a moment nothing moves
    scaled = ScaledOperator(SceneHessian(objective, keep_null=True), D / lengths.flat)
    largest = extreme_eigenpairs(scaled, generator, EigenSettings(smallest=0, rtol=0.01)).largest
    sharpness = Measured(float(largest.values[0]), float(largest.residuals[0]))
    return {"critical_sharpness": critical, "adam_sharpness": sharpness}
