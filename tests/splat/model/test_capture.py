"""What a set of cameras says about the capture."""

from collections.abc import Sequence
from math import cos, radians, sin
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from splat.model.camera import Camera, capture_geometry, common_target, forward_facing, look_at
from splat.scenes.scene import load_scene
from splat.scenes.splits import split_scene

TARGET = torch.tensor([0.3, -0.2, 5.0], dtype=torch.float64)
DOWN = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def camera(rotation: Tensor, centre: Tensor) -> Camera:
    return Camera(rotation, centre, 40.0, 40.0, 16.0, 12.0, 32, 24)


def orbit(azimuths: Sequence[float], radius=4.0, elevation=0.0, outwards=False) -> list[Camera]:
    """Level cameras about TARGET, looking at it or away from it; degrees."""
    cameras = []
    for azimuth in azimuths:
        a, e = radians(azimuth), radians(elevation)
        offset = radius * torch.tensor([sin(a) * cos(e), -sin(e), -cos(a) * cos(e)], dtype=torch.float64)
        looked_at = TARGET + 2 * offset if outwards else TARGET
        cameras.append(camera(look_at(TARGET + offset, looked_at, DOWN), TARGET + offset))
    return cameras


def test_the_common_target_is_where_all_axes_meet() -> None:
    found = common_target(orbit((-20, 0, 70), elevation=30))
    assert found is not None
    assert found.tolist() == pytest.approx(TARGET.tolist(), abs=1e-12)


def test_axes_that_miss_each_other_meet_in_the_middle_of_their_gap() -> None:
    x, y, z = torch.eye(3, dtype=torch.float64)
    along_z, along_x = camera(look_at(-z, z, y), -z), camera(look_at(-x + y, x + y, y), -x + y)
    found = common_target([along_z, along_x])  # the axes x = y = 0 and y = 1, z = 0
    assert found is not None
    assert found.tolist() == pytest.approx([0, 0.5, 0], abs=1e-12)


def test_parallel_cameras_and_cameras_that_look_outwards_have_no_target() -> None:
    ahead = torch.eye(3, dtype=torch.float64)
    assert common_target([camera(ahead, i * DOWN) for i in range(3)]) is None
    assert common_target(orbit((0, 90, 180), outwards=True)) is None
    assert common_target(orbit((0,))) is None
    assert common_target(orbit((0, 90)) + orbit((180,), outwards=True)) is None  # behind one of them is enough


def test_cameras_that_look_inwards_from_all_sides_surround() -> None:
    for azimuths, surrounding in (((-44, 0, 44), False), ((-46, 0, 46), True), ((0, 120, 240), True), ((0,), False)):
        assert capture_geometry(orbit(azimuths)).surrounding is surrounding
    assert not capture_geometry(orbit((0, 120, 240), outwards=True)).surrounding


def test_the_way_between_forward_facing_cameras_stays_off_the_scene() -> None:
    for apart in (30, 60, 89.9, 90.1, 150):
        first, second = orbit((0, apart), radius=1.0)
        nearest = float(((first.centre + second.centre) / 2 - TARGET).norm())
        assert forward_facing([first, second]) is (nearest > cos(radians(45)))


def test_fern_faces_forward_and_lego_is_surrounded(fern: Path, lego: Path) -> None:
    for folder, count, expected in ((fern, 3, False), (lego, 8, True)):
        scene = load_scene(folder)
        chosen = scene.select(split_scene(scene, count).train)
        assert capture_geometry([frame.camera for frame in chosen]).surrounding is expected


def test_the_radius_is_about_the_centroid_and_the_orbit_about_the_target() -> None:
    # at azimuths 0 and 180: centroid the target; a third at 90 moves it by a third of 4
    pair, three = capture_geometry(orbit((0, 180, 90))[:2]), capture_geometry(orbit((0, 90, 180)))
    assert pair.radius == pytest.approx(4, rel=1e-12) and pair.orbit is None  # opposite axes are parallel
    assert capture_geometry(orbit((0, 90)) + orbit((200,), radius=1.0)).orbit == pytest.approx(3, rel=1e-12)
    assert three.radius == pytest.approx((4 * 2 / 3 + 2 * (16 + (4 / 3) ** 2) ** 0.5) / 3, rel=1e-12)


@pytest.mark.parametrize("azimuths", [(0,), (0, 10, 20), (0, 120, 240), (0, 5, 170)])
@pytest.mark.parametrize("elevation", [-10, 0, 50])
def test_level_cameras_tell_what_is_down_however_they_stand(azimuths: tuple[float, ...], elevation: float) -> None:
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix())
    cameras = [camera(c.rotation @ turn.T, turn @ c.centre) for c in orbit(azimuths, elevation=elevation)]
    down = capture_geometry(cameras).down
    assert down.norm().item() == pytest.approx(1, rel=1e-12)
    if len(azimuths) == 1:  # a single camera knows no other down than its own
        # solved at condition 1e6
        assert down.tolist() == pytest.approx(cameras[0].rotation[1].tolist(), abs=1e6 * 2e-16 * 4)
    else:
        # what is left of the horizontal: at most tan 50, times the ridge over the right axes' least second moment
        assert float((down - turn @ DOWN).norm()) < 1.2 * 1e-6 / 0.01


def test_no_cameras_have_no_geometry() -> None:
    with pytest.raises(ValueError, match="at least one camera"):
        capture_geometry([])
