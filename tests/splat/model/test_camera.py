"""Pinhole cameras."""

from dataclasses import replace
from math import inf, nan

import pytest
import torch

from splat.model.camera import Camera, look_at
from splat.projection.reference import project
from tests.refusals import refused
from tests.splat.random_scenes import random_camera, random_gaussians
from tests.splat.tolerances import relative_error


def test_forward_is_the_direction_that_projects_onto_the_principal_point():
    camera, gaussians = random_camera(), random_gaussians(1)
    gaussians.means[0] = camera.centre + 2.5 * camera.forward
    splats = project(gaussians, camera)
    assert splats.means[0].tolist() == pytest.approx([camera.cx, camera.cy], rel=1e-13)
    assert splats.depths[0].item() == pytest.approx(2.5, rel=1e-13)


def test_x_is_to_the_right_and_y_is_down():
    camera, gaussians = random_camera(), random_gaussians(2)
    gaussians.means[0] = camera.centre + camera.forward + 0.1 * camera.rotation[0]
    gaussians.means[1] = camera.centre + camera.forward + 0.1 * camera.rotation[1]
    right, down = project(gaussians, camera).means.tolist()
    assert right == pytest.approx([camera.cx + 0.1 * camera.fx, camera.cy])
    assert down == pytest.approx([camera.cx, camera.cy + 0.1 * camera.fy])


def test_a_resized_camera_sees_the_same_at_another_resolution():
    camera, gaussians = random_camera(48, 40), random_gaussians(20)
    smaller = camera.resized(24, 10)
    assert (smaller.width, smaller.height) == (24, 10)
    scale = torch.tensor([24 / 48, 10 / 40], dtype=torch.float64)
    assert relative_error(project(gaussians, smaller).means, project(gaussians, camera).means * scale) < 1e-13
    corner = torch.tensor([48.0, 40.0]) * scale  # the image's far corner stays its corner
    assert corner.tolist() == [smaller.width, smaller.height]


def test_what_is_no_rotation_lens_or_size_is_refused():
    camera, eye = random_camera(), torch.eye(3, dtype=torch.float64)
    for matrix in (2 * eye, -eye, torch.diag(torch.tensor([1.0, 1.0, -1.0]).double()), nan * eye):
        refused("expected a rotation matrix", replace, camera, rotation=matrix)
    for wrong in ({"fx": 0.0}, {"fy": -1.0}, {"width": 0}, {"height": -3}, {"fx": nan}):
        refused("expected positive focal lengths and image size", replace, camera, **wrong)
    for wrong in ({"cx": nan}, {"cy": -inf}, {"fx": inf}, {"centre": nan * eye[0]}):
        refused("expected a finite centre, focal lengths and principal point", replace, camera, **wrong)


def test_a_camera_cannot_be_changed():
    camera: Camera = random_camera()
    with pytest.raises(AttributeError):
        camera.fx = 3.0  # pyright: ignore


def test_a_camera_looking_at_a_target_has_it_on_its_axis_and_is_level():
    centre, target, down = torch.randn(3, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    rotation = look_at(centre, target, down)
    assert (rotation @ (target - centre)).tolist() == pytest.approx([0, 0, (target - centre).norm().item()], abs=1e-14)
    assert float(rotation[0] @ down) == pytest.approx(0, abs=1e-14) and float(rotation[1] @ down) > 0
    assert torch.linalg.det(rotation).item() == pytest.approx(1, rel=1e-14)


@pytest.mark.parametrize("factor", [0.0, 2.0, -1.0])
def test_nothing_is_level_that_looks_straight_up_or_down(factor: float):
    centre, down = torch.tensor([[1.0, 2.0, 3.0], [0.2, 0.9, -0.1]], dtype=torch.float64)
    refused("expected a target away from the centre", look_at, centre, centre + factor * down, down)
