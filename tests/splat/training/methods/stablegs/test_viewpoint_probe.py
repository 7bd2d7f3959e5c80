"""Viewpoint probes: each mode's pose by its frame, its handedness in the image, its distribution."""

from dataclasses import replace
from itertools import product
from math import cos, degrees, pi, radians, sin
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.linalg import fractional_matrix_power
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from splat.model.camera import Camera, CaptureGeometry, capture_geometry, slerp
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.render.render import render
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.training.methods.stablegs.viewpoint_probe import (
    ViewpointSettings,
    composite_pose,
    dominant_edge,
    edge_axis,
    nearest_camera,
)
from tests.refusals import refused

NONE = ViewpointSettings(edge_rotation=False, interpolation=False, parallax=False, capture="forward")
MODES = ("edge_rotation", "interpolation", "parallax")
EDGE, INTERPOLATION, PARALLAX = (replace(NONE, **{name: True}) for name in MODES)
SHELL = replace(PARALLAX, capture="360")
NORMAL = torch.tensor([cos(0.5), sin(0.5)], dtype=torch.float64)


def turned(*vector: float) -> Tensor:
    return torch.from_numpy(Rotation.from_rotvec(vector).as_matrix())


def camera(rotation: Tensor, centre: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    return Camera(rotation, torch.tensor(centre, dtype=torch.float64), 70.0, 70.0, 32.0, 24.0, 64, 48)


def rig() -> list[Camera]:
    """Three cameras at no special attitude, that have a target."""
    cameras = synthetic_scene(SyntheticSettings(gaussians=50, views=3, width=8, height=8)).scene.frames
    frame = turned(0.3, -0.8, 1.1)
    return [
        replace(
            f.camera,
            rotation=turned(0.02, -0.01, 0.2 * i) @ f.camera.rotation @ frame.T,
            centre=frame @ f.camera.centre,
        )
        for i, f in enumerate(cameras)
    ]


def probe(cameras: list[Camera], m: int, settings: ViewpointSettings, seed: int = 0, normal: Tensor = NORMAL) -> Camera:
    generator = torch.Generator().manual_seed(seed)
    return composite_pose(cameras, m, normal, capture_geometry(cameras), settings, generator=generator)


def probes(cameras: list[Camera], m: int, settings: ViewpointSettings, count: int) -> list[Camera]:
    """Many draws from one generator."""
    generator, geometry = torch.Generator().manual_seed(5), capture_geometry(cameras)
    return [composite_pose(cameras, m, NORMAL, geometry, settings, generator=generator) for _ in range(count)]


def rotation_vector(rotation: Tensor) -> Tensor:
    return torch.from_numpy(Rotation.from_matrix(rotation.numpy()).as_rotvec())


def same(a: Tensor, b: Tensor, tolerance: float = 1e-12) -> bool:
    return float((a - b).abs().max()) <= tolerance


# ---- the modes off, and what every pose keeps


def test_with_every_mode_off_the_pose_is_the_views_own() -> None:
    cameras = rig()
    for m, view in enumerate(cameras):
        pose = probe(cameras, m, NONE)
        assert torch.equal(pose.rotation, view.rotation) and torch.equal(pose.centre, view.centre)


@pytest.mark.parametrize("settings", [ViewpointSettings(), SHELL])
def test_a_probe_has_the_lens_and_the_size_of_its_view(settings: ViewpointSettings) -> None:
    cameras = rig()
    cameras[1] = replace(cameras[1], fx=11.0, fy=12.0, cx=3.0, cy=5.0, width=9, height=7)
    pose = probe(cameras, 1, settings)
    assert replace(pose, rotation=cameras[1].rotation, centre=cameras[1].centre) == cameras[1]


def test_the_generator_goes_on_alike_whatever_modes_are_on() -> None:
    cameras = rig()
    states = []
    for settings in (ViewpointSettings(), NONE, EDGE, INTERPOLATION, PARALLAX, SHELL):
        first, second = (torch.Generator().manual_seed(3) for _ in range(2))
        poses = [
            composite_pose(cameras, 0, NORMAL, capture_geometry(cameras), settings, generator=g)
            for g in (first, second)
        ]
        assert torch.equal(poses[0].rotation, poses[1].rotation) and torch.equal(poses[0].centre, poses[1].centre)
        states.append(first.get_state())
    assert all(torch.equal(state, states[0]) for state in states)


def test_a_modes_draw_does_not_depend_on_the_other_modes() -> None:
    cameras = rig()
    view, both = cameras[0], probe(cameras, 0, replace(INTERPOLATION, parallax=True))
    between, aside, turn = (probe(cameras, 0, s) for s in (INTERPOLATION, PARALLAX, EDGE))
    everything = probe(cameras, 0, replace(ViewpointSettings(), capture="forward"))
    assert torch.equal(both.rotation, between.rotation)
    assert same(both.centre - between.centre, aside.centre - view.centre)
    assert same(everything.centre, both.centre)
    # Eq. (19) as printed, with the axis in the world: R_target exp(theta R_m^T n)
    assert same(everything.rotation, both.rotation @ (view.rotation.T @ turn.rotation))


# ---- edge rotation


def depth_step(tilt: float) -> Gaussians:
    """A near half plane (z = 4) before a far plane (z = 7), the edge's normal `tilt` degrees from +x.

    The planes are a little rough, so that a turn does not change which of two neighbours is in front: shingles in the
    order of their height would show their colours beside where they are.
    """
    generator = torch.Generator().manual_seed(0)
    near, far = torch.rand(2, 4000, 2, generator=generator) - 0.5
    near, far = near * 6, far * 12
    near = near[near @ torch.tensor([cos(radians(tilt)), sin(radians(tilt))]) < 0]
    xy = torch.cat([near, far])
    z = torch.cat([torch.full((len(near), 1), 4.0), torch.full((len(far), 1), 7.0)])
    n = len(xy)
    z = z + 0.2 * (torch.rand(n, 1, generator=generator) - 0.5)
    waves, phases = 20 * torch.randn(2, 3, 4, generator=generator), 6 * torch.rand(3, 4, generator=generator)
    pattern = torch.sin(torch.einsum("ni,icw->ncw", xy / z, waves) + phases).mean(dim=2)
    attributes = {
        "means": torch.cat([xy, z], dim=1),
        "log_scales": (z * 0.02).log().expand(n, 3),
        "quats": torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
        "opacity_logits": torch.full((n,), 3.0),
        "sh": pattern[:, None] / 2 / Y00,
    }
    return Gaussians.pack(attributes)


def image_shift(before: Tensor, after: Tensor, reach: int = 12) -> tuple[int, int]:
    """Whole columns and rows by which the middle of the picture has moved: where it is found best afterwards."""
    height, width = before.shape[1:]
    middle = before[:, reach : height - reach, reach : width - reach]

    def misfit(shift: tuple[int, ...]) -> float:
        column, row = reach + shift[0], reach + shift[1]
        found = after[:, row : row + middle.shape[1], column : column + middle.shape[2]]
        return float((found - middle).square().mean())

    column, row = min(product(range(-reach, reach + 1), repeat=2), key=misfit)
    return column, row


@pytest.mark.parametrize("tilt", [0, 90, 35])
@pytest.mark.parametrize("axis", ["normal", "tangent"])
def test_turned_about_its_normal_the_image_moves_along_the_edge(axis, tilt):
    gaussians, view = depth_step(tilt), camera(torch.eye(3, dtype=torch.float64))
    before = render(gaussians, view, depth=True)
    assert before.depth is not None
    normal = dominant_edge(before.depth, before.alpha)
    assert abs(float(normal[0]) * sin(radians(tilt)) - float(normal[1]) * cos(radians(tilt))) < sin(radians(5))
    pose = probe([view], 0, replace(EDGE, axis=axis, theta_sigma=3.0), normal=normal)
    shift = np.array(image_shift(before.image, render(gaussians, pose).image))
    # x_cam -> x_cam + w x x_cam moves what is ahead, e_z, by w x e_z = (w_y, -w_x)
    w = rotation_vector(pose.rotation)
    assert float(w.norm()) > radians(3)
    expected = view.fx * np.array([w[1], -w[0]])
    assert np.abs(shift - expected).max() <= 0.5 + view.fx * float(w.norm()) ** 2  # rounding to pixels, second order
    along = np.array([-sin(radians(tilt)), cos(radians(tilt))])
    moved_along = abs(shift @ along) / np.linalg.norm(shift)
    assert moved_along > cos(radians(20)) if axis == "normal" else moved_along < sin(radians(20))


def test_the_axis_turns_with_the_view_when_the_target_pose_is_another() -> None:
    cameras = rig()
    at_neighbour = replace(INTERPOLATION, t_min=1, t_max=1, edge_rotation=True)
    pose, neighbour = probe(cameras, 0, at_neighbour), cameras[1]
    in_world = neighbour.rotation.T @ rotation_vector(pose.rotation @ neighbour.rotation.T)
    axis = cameras[0].rotation.T @ edge_axis(NORMAL, cameras[0])
    assert same(torch.linalg.cross(in_world, axis), torch.zeros(3), 1e-9) and in_world.norm() > 1e-3


@pytest.mark.parametrize("axis", ["normal", "tangent"])
def test_the_edge_angle_has_the_standard_deviation_that_was_asked_for(axis: Literal["normal", "tangent"]) -> None:
    cameras, n, sigma = rig(), 400, 2.0
    direction = edge_axis(NORMAL, cameras[2], axis)
    poses = probes(cameras, 2, replace(EDGE, theta_sigma=sigma, axis=axis), n)
    vectors = torch.stack([rotation_vector(pose.rotation @ cameras[2].rotation.T) for pose in poses])
    angles = torch.rad2deg(vectors @ direction)
    assert same(vectors, torch.deg2rad(angles)[:, None] * direction, 1e-7)
    assert abs(float(angles.mean())) < 4 * sigma / n**0.5
    assert float(angles.square().mean()) == pytest.approx(sigma**2, abs=4 * sigma**2 * (2 / n) ** 0.5)
    assert all(torch.equal(pose.centre, cameras[2].centre) for pose in poses)


def test_without_an_edge_nothing_turns() -> None:
    cameras = rig()
    assert same(probe(cameras, 0, EDGE, normal=torch.zeros(2)).rotation, cameras[0].rotation, 0)


def test_the_axis_is_right_for_pixels_that_are_not_square() -> None:
    view = replace(camera(torch.eye(3, dtype=torch.float64)), fx=100.0, fy=50.0)
    # the plane a x + b y = 0 appears as the line a u / fx + b v / fy = 0 about the principal point
    a, b = 0.6, 0.8
    pixels = torch.tensor([a / view.fx, b / view.fy], dtype=torch.float64)
    normal = pixels / pixels.norm()
    assert edge_axis(normal, view).tolist() == pytest.approx([a, b, 0], abs=1e-12)
    assert edge_axis(normal, view, "tangent").tolist() == pytest.approx([-b, a, 0], abs=1e-12)


# ---- interpolation


@pytest.mark.parametrize("t", [-0.2, 0, 0.5, 1, 1.2])
def test_interpolation_goes_the_shared_share_of_the_way_to_the_neighbour(t: float) -> None:
    cameras = rig()
    pose = probe(cameras, 0, replace(INTERPOLATION, t_min=t, t_max=t))
    view, neighbour = cameras[0], cameras[1]
    whole, part = (rotation_vector(view.rotation.T @ other.rotation) for other in (neighbour, pose))
    assert same(part, t * whole) and same(pose.centre, view.centre + t * (neighbour.centre - view.centre))
    if t in (0, 1):
        assert same(pose.rotation, cameras[int(t)].rotation) and torch.equal(pose.centre, cameras[int(t)].centre)


def test_t_is_uniform_over_its_range() -> None:
    cameras, n = rig(), 400
    way = cameras[1].centre - cameras[0].centre
    centres = torch.stack([pose.centre for pose in probes(cameras, 0, INTERPOLATION, n)])
    t = np.sort(((centres - cameras[0].centre) @ way / (way @ way)).numpy())
    assert t[0] >= -0.2 and t[-1] <= 1.2
    kolmogorov = np.abs((t + 0.2) / 1.4 - (np.arange(n) + 0.5) / n).max()
    assert kolmogorov < 2.3 / n**0.5  # exceeded with a chance of 5e-5, as 4 standard errors are


@pytest.mark.parametrize("t", [-0.2, 0.3, 0.7, 1.2])
def test_slerp_is_scipys_and_the_papers_power(t: float) -> None:
    first, second = turned(0.4, 1.0, -0.3), turned(-0.5, 0.2, 0.9)
    power = fractional_matrix_power((first.T @ second).numpy(), t)
    assert np.abs(np.imag(power)).max() < 1e-12
    assert same(slerp(first, second, t), first @ torch.from_numpy(np.real(power)))
    if 0 <= t <= 1:
        peer = Slerp([0, 1], Rotation.from_matrix(np.stack([first.numpy(), second.numpy()])))(t).as_matrix()
        assert same(slerp(first, second, t), torch.from_numpy(peer))


def test_slerp_between_attitudes_half_a_turn_apart_reaches_both() -> None:
    first = turned(0.4, 1.0, -0.3)
    for axis in ((pi, 0, 0), (0, pi, 0), (0, -pi, 0), (pi * 0.6, 0, pi * 0.8)):
        second = first @ turned(*axis)
        assert same(slerp(first, second, 0), first) and same(slerp(first, second, 1), second)
        middle = slerp(first, second, 0.5)
        assert same(middle @ middle.T, torch.eye(3)) and torch.linalg.det(middle) > 0
        assert torch.equal(middle, slerp(first, second, 0.5))
        assert degrees(float(rotation_vector(first.T @ middle).norm())) == pytest.approx(90, rel=1e-9)


def test_the_neighbour_is_the_nearest_in_viewing_direction_not_in_place() -> None:
    beside, far = camera(turned(0, 0.5, 0), (0.1, 0, 0)), camera(turned(0, -0.2, 0), (9, 0, 0))
    assert nearest_camera([camera(turned(0, 0, 0)), beside, far], 0) == 2


def test_a_roll_is_no_distance_and_of_parallel_axes_the_nearest_is_taken() -> None:
    ahead = camera(turned(0, 0, 0))
    rolled, near = camera(turned(0, 0, 3), (5, 0, 0)), camera(turned(0, 0, 0), (1, 0, 0))
    other = camera(turned(0, 0.1, 0))
    assert nearest_camera([ahead, other, rolled], 0) == 2
    assert nearest_camera([ahead, rolled, near], 0) == 2 and nearest_camera([ahead, near, rolled], 0) == 1


def test_a_single_camera_has_no_neighbour_and_only_turns() -> None:
    view = rig()[0]
    assert nearest_camera([view], 0) is None
    assert torch.equal(probe([view], 0, INTERPOLATION).rotation, view.rotation)
    pose = probe([view], 0, ViewpointSettings())
    assert torch.equal(pose.centre, view.centre) and not torch.equal(pose.rotation, view.rotation)


# ---- parallax, and the shell of a 360 capture


def test_parallax_moves_the_camera_sideways_and_does_not_turn_it() -> None:
    cameras, n = rig(), 400
    view, sigma = cameras[1], 0.1 * capture_geometry(cameras).radius
    poses = probes(cameras, 1, PARALLAX, n)
    assert all(torch.equal(pose.rotation, view.rotation) for pose in poses)
    x, y, z = (torch.stack([pose.centre - view.centre for pose in poses]) @ view.rotation.T).unbind(-1)
    assert float(z.abs().max()) < 1e-12
    # E delta^2 = s^2, variance 2 s^4; along x: s^2 / 2, variance (3 * 3/8 - 1/4) s^4 = 7/8 s^4; across: 0, 3/8 s^4
    assert float((x * x + y * y).mean()) == pytest.approx(sigma**2, abs=4 * sigma**2 * (2 / n) ** 0.5)
    assert float((x * x).mean()) == pytest.approx(sigma**2 / 2, abs=4 * sigma**2 * (7 / 8 / n) ** 0.5)
    assert float((x * y).mean()) == pytest.approx(0, abs=4 * sigma**2 * (3 / 8 / n) ** 0.5)


def test_shell_poses_are_level_and_uniform_on_the_orbit_of_the_target() -> None:
    cameras, n = rig(), 400
    geometry = capture_geometry(cameras)
    assert geometry.target is not None and geometry.orbit is not None
    poses = probes(cameras, 0, SHELL, n)
    u = torch.stack([(pose.centre - geometry.target) / geometry.orbit for pose in poses])
    rotations = torch.stack([pose.rotation for pose in poses])
    assert same(u.norm(dim=1), torch.ones(n)) and same(rotations[:, 2], -u)
    assert same(rotations[:, 0] @ geometry.down, torch.zeros(n)) and bool((rotations[:, 1] @ geometry.down > 0).all())
    assert same(torch.linalg.det(rotations), torch.ones(n))
    # of a coordinate of a uniform direction: mean 0, variance 1/3; of its square: mean 1/3, variance 1/5 - 1/9
    assert float(u.mean(dim=0).abs().max()) < 4 / (3 * n) ** 0.5
    assert float((u.square().mean(dim=0) - 1 / 3).abs().max()) < 4 * ((1 / 5 - 1 / 9) / n) ** 0.5


def test_the_shell_replaces_the_interpolated_pose_and_is_turned() -> None:
    cameras = rig()
    shell = probe(cameras, 0, SHELL)
    again = probe(cameras, 0, replace(SHELL, interpolation=True))
    assert torch.equal(shell.rotation, again.rotation) and torch.equal(shell.centre, again.centre)
    both, turn = probe(cameras, 0, replace(SHELL, edge_rotation=True)), probe(cameras, 0, EDGE)
    assert torch.equal(both.centre, shell.centre)
    assert same(both.rotation, shell.rotation @ (cameras[0].rotation.T @ turn.rotation))


def test_without_parallax_a_360_capture_is_interpolated_like_any_other() -> None:
    cameras = rig()
    expected, given = probe(cameras, 0, INTERPOLATION), probe(cameras, 0, replace(INTERPOLATION, capture="360"))
    assert torch.equal(given.rotation, expected.rotation) and torch.equal(given.centre, expected.centre)


def test_auto_takes_the_shell_where_the_cameras_surround_their_target() -> None:
    cameras = rig()
    geometry = capture_geometry(cameras)

    def pose(settings: ViewpointSettings, geometry: CaptureGeometry) -> Camera:
        generator = torch.Generator().manual_seed(0)
        return composite_pose(cameras, 0, NORMAL, geometry, settings, generator=generator)

    assert not geometry.surrounding
    for surrounding, named in ((False, PARALLAX), (True, SHELL)):
        own = replace(geometry, surrounding=surrounding)
        assert torch.equal(pose(replace(PARALLAX, capture="auto"), own).centre, pose(named, geometry).centre)


def test_a_360_capture_without_a_common_target_is_refused() -> None:
    ahead = turned(0, 0, 0)
    refused("look at a common place for a 360 capture", probe, [camera(ahead), camera(ahead, (1, 0, 0))], 0, SHELL)


def test_a_range_of_the_interpolation_that_is_empty_is_refused():
    refused("t_min <= t_max", ViewpointSettings, t_min=1.0, t_max=0.5)
