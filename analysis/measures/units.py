"""Metrics of the parameter space: in which units curvature is compared, as D of D H D (`landscape.ScaledOperator`).

parameters   D = 1: curvature per squared unit of the parameters
optimiser    D the learning rate of every parameter at the first step: curvature per step of the training

A curvature unit is a step along one direction: that within which the curvature alone changes the loss by RISE of it.
"""

from dataclasses import asdict
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.probes import draw_probes
from landscape.results import mean_of_parts
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import ATTRIBUTES
from splat.training.state import LearningRates, learning_rates, position_rate

RISE = 0.001  # of the loss, within a curvature unit
UNITS = 3.0  # curvature units each way that a slice reaches by default
Metric = Literal["parameters", "optimiser"]
FACING = 0.7  # views are forward-facing where every axis keeps this share of its length along their mean


def scene_size(objective: SceneObjective) -> float:
    """World units: the median depth of the active Gaussians in the first view where the views face one way; else the mean
    distance of the cameras from their centroid."""
    cameras = [view.camera for view in objective.views]
    axes = torch.stack([camera.forward for camera in cameras])
    mean = axes.mean(dim=0)
    if float((axes @ mean).min()) > FACING * float(mean.norm()):
        depth = (objective.active.means.cpu().double() - cameras[0].centre) @ cameras[0].forward
        return float(depth[depth > 0].median())
    centres = torch.stack([camera.centre for camera in cameras])
    return float((centres - centres.mean(dim=0)).norm(dim=1).mean())


def step_lengths(rates: LearningRates, extent: float) -> dict[str, float]:
    """Length of Adam's first step by attribute: its learning rate; of colour that of the constant band.

    >>> step_lengths(LearningRates(), 2.0)["means"]
    0.00032
    """
    lengths = asdict(rates) | {"means": rates.position * extent, "sh": rates.sh_constant}
    return {name: lengths[name] for name in ATTRIBUTES}


def step_rises(
    objective: SceneObjective, steps: Float[Tensor, " p"], generator: torch.Generator, draws: int = 2
) -> dict[str, tuple[float, float]]:
    """Rise of the loss, by attribute, when each of its parameters moves by +-steps at random: as rendered, no model of it.

    The mean over pairs of such a step and its opposite, in which the slope cancels, and its error (`mean_of_parts`).  Each view
    has draws of its own.
    """
    theta = objective.active.flat
    rises = torch.zeros(len(objective.blocks), len(objective.views), draws, dtype=torch.float64)
    for index in range(len(objective.views)):
        base, _ = objective.evaluate_view(index, objective.active)
        for each, rows in zip(rises, objective.blocks.values(), strict=True):
            for i in range(draws):
                step = torch.zeros_like(theta)
                signs = draw_probes(rows.stop - rows.start, 1, generator, theta.dtype, "rademacher")[:, 0]
                step[rows] = steps[rows] * signs
                moved = [objective.active.with_flat(theta + sign * step) for sign in (1, -1)]
                each[index, i] = sum(objective.evaluate_view(index, ends)[0] for ends in moved) / 2 - base
    values, errors = (each.tolist() for each in mean_of_parts(rises))
    return dict(zip(objective.blocks, zip(values, errors, strict=True), strict=True))


def optimiser_units(objective: SceneObjective, rates: LearningRates, extent: float) -> Float[Tensor, " p"]:
    """D with the learning rates of the first step; extent: what the training multiplies the position rate by."""
    return learning_rates(objective.active, rates, position_rate(rates, extent, 0, 1))
