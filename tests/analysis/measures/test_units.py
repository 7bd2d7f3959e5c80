"""The units in which curvature is compared."""

from dataclasses import replace
from math import log

import pytest
import torch

from analysis.measures.units import optimiser_units, scene_size, step_rises
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.training.state import LearningRates
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians
from tests.splat.tiny import SMOOTH, tiny_gaussians, tiny_views


def objective_in_a_world(unit: float = 1.0, apart: float = 0.0) -> SceneObjective:
    """The same scene in a world of other units; apart: an angle by which the first camera is turned away, radians."""
    gaussians = random_gaussians(30, 1, logit=1.0)
    gaussians.means.mul_(unit)
    gaussians.log_scales.add_(log(unit))
    views = [replace(view, camera=replace(view.camera, centre=unit * view.camera.centre)) for view in two_views()]
    c, s = torch.cos(torch.tensor(apart)), torch.sin(torch.tensor(apart))
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    views[0] = replace(views[0], camera=replace(views[0].camera, rotation=turn @ views[0].camera.rotation))
    return SceneObjective(gaussians, views, LossSettings("charbonnier"), BACKGROUND)


def test_a_scenes_size_is_its_depth_or_the_distance_of_its_cameras():
    facing = objective_in_a_world()
    camera = facing.views[0].camera
    depth = ((facing.active.means - camera.centre) @ camera.forward).sort().values
    assert depth[0] > 0 and scene_size(facing) == float(depth[(len(depth) - 1) // 2])
    around = objective_in_a_world(apart=2.5)
    first, second = (view.camera.centre for view in around.views)
    assert scene_size(around) == pytest.approx(float((first - second).norm()) / 2, rel=1e-12)
    for apart, here in ((0.0, facing), (2.5, around)):  # in a world of other units as many of them
        assert scene_size(objective_in_a_world(1.7, apart)) == pytest.approx(1.7 * scene_size(here), rel=1e-10)


def test_behind_the_first_camera_there_is_no_depth():
    facing = objective_in_a_world()
    near, far = facing.views
    behind = facing.active.select(torch.arange(4))  # as far behind the first camera as they were before it
    depth = (behind.means - near.camera.centre) @ near.camera.forward
    behind.means.sub_(2 * depth[:, None] * near.camera.forward)
    back = far.camera.centre - 3 * float(depth.max()) * near.camera.forward
    views = [near, replace(far, camera=replace(far.camera, centre=back, rotation=near.camera.rotation))]
    both = {name: torch.cat([value, behind.attributes[name]]) for name, value in facing.active.attributes.items()}
    objective = SceneObjective(Gaussians.pack(both), views, LossSettings("charbonnier"), BACKGROUND)
    depths = (objective.active.means - near.camera.centre) @ near.camera.forward
    before = depths[depths > 0].sort().values
    assert len(before) < len(depths) and scene_size(objective) == float(before[(len(before) - 1) // 2])


def test_one_of_three_cameras_that_looks_back_makes_a_scene_all_round():
    facing = objective_in_a_world()
    first, second = facing.views
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)) @ first.camera.rotation
    far = first.camera.centre + 5 * first.camera.rotation[0]
    turned = replace(first, camera=replace(first.camera, rotation=back, centre=far))
    objective = SceneObjective(facing.active, [first, second, turned], LossSettings("charbonnier"), BACKGROUND)
    centres = torch.stack([view.camera.centre for view in objective.views])
    middle = (centres[0] + centres[1] + centres[2]) / 3
    distances = [float((centre - middle).norm()) for centre in centres]
    assert scene_size(objective) == pytest.approx(sum(distances) / 3, rel=1e-12)


def test_the_optimisers_units_are_its_rates_at_the_first_step():
    objective = objective_in_a_world()
    D = objective.active.with_flat(optimiser_units(objective, LearningRates(), extent=2.0))
    assert (D.means == 2 * 1.6e-4).all() and (D.log_scales == 5e-3).all() and (D.quats == 1e-3).all()
    assert (D.opacity_logits == 0.05).all() and (D.sh[:, 0] == 2.5e-3).all() and (D.sh[:, 1:] == 2.5e-3 / 20).all()


def test_the_rise_by_random_steps_is_half_the_trace_in_the_optimisers_units_where_the_loss_is_quadratic():
    scene = SceneObjective(
        tiny_gaussians(dtype=torch.float64),
        tiny_views(torch.float64),
        LossSettings("l2", ssim_weight=0.0),
        None,
        SMOOTH,
    )
    D = 0.01 * optimiser_units(scene, LearningRates(), 1.0)  # so short that nothing but curvature is left
    found = step_rises(scene, D, torch.Generator().manual_seed(0), draws=40)
    H = SceneHessian(scene)
    for name, rows in scene.blocks.items():
        diagonal = H.apply(torch.eye(H.dim, dtype=torch.float64)[:, rows])[rows].diagonal()
        terms, (rise, error) = diagonal * D[rows].square() / 2, found[name]
        assert 0 < error < 0.5 * float(terms.abs().sum()) and abs(rise - float(terms.sum())) < 3 * error, name
