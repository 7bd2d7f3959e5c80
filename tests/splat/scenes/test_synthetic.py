"""The synthetic scene: reproducible, consistent with itself, and the same after a round trip through a folder."""

from pathlib import Path

import pytest
import torch

from splat.model.camera import Camera, forward_facing
from splat.model.gaussians import Gaussians
from splat.projection.reference import rotation_matrices
from splat.render.render import render
from splat.scenes.scene import Scene, load_scene
from splat.scenes.synthetic import SyntheticScene, SyntheticSettings, synthetic_scene
from splat.scenes.view import Frame, View, inside_image
from splat.scenes.write import write_transforms_scene
from tests.refusals import refused

SMALL = SyntheticSettings(gaussians=120, views=4, width=40, height=30)


@pytest.fixture(scope="module")
def small() -> SyntheticScene:
    return synthetic_scene(SMALL)


def test_the_same_settings_give_the_same_scene_and_another_seed_another(small: SyntheticScene) -> None:
    again, other = synthetic_scene(SMALL), synthetic_scene(SyntheticSettings(120, 4, 40, 30, seed=1))
    assert torch.equal(small.truth.flat, again.truth.flat) and not torch.equal(small.truth.flat, other.truth.flat)
    for mine, theirs in zip(small.scene.load(), again.scene.load()):
        assert torch.equal(mine.image, theirs.image)
    assert small.scene.points is not None and again.scene.points is not None
    assert torch.equal(small.scene.points.xyz, again.scene.points.xyz)


def test_the_pictures_are_renders_of_the_truth(small: SyntheticScene) -> None:
    view = small.scene.load()[1]
    rendering = render(small.truth, view.camera, small.scene.background)
    torch.testing.assert_close(view.image, rendering.image.detach().clamp(0, 1), atol=0, rtol=0)


def test_there_is_something_to_see_everywhere_and_it_differs_between_views(small: SyntheticScene) -> None:
    images = torch.stack([view.image for view in small.scene.load()])
    assert bool((images.flatten(2).std(dim=2) > 0.05).all())
    assert (images[0] - images[-1]).abs().mean() > 0.02
    for frame in small.scene.frames:
        assert render(small.truth, frame.camera).alpha.mean() > 0.9
    assert forward_facing([frame.camera for frame in small.scene.frames])


def test_gaussians_lie_flat_on_their_surfaces(small: SyntheticScene) -> None:
    scales = small.truth.log_scales.exp()
    assert bool((scales[:, 2] < 0.3 * scales[:, :2].amin(dim=1)).all())
    floor = (small.truth.means[:, 1] - 1.0).abs() < 1e-6
    wall = (small.truth.means[:, 2] - 3.0).abs() < 1e-6
    normals = rotation_matrices(small.truth.quats)[:, :, 2].abs()
    assert int(floor.sum()) > 20 and int(wall.sum()) > 20
    torch.testing.assert_close(normals[floor & ~wall][:, 1], torch.ones(int((floor & ~wall).sum())))
    torch.testing.assert_close(normals[wall & ~floor][:, 2], torch.ones(int((wall & ~floor).sum())))


def test_the_gaussians_of_the_ball_face_outward(small: SyntheticScene) -> None:
    outward = (small.truth.means - torch.tensor([-0.75, 0.35, 0.2])) / 0.65
    ball = (outward.norm(dim=1) - 1).abs() < 1e-5
    assert int(ball.sum()) > 10
    normals = rotation_matrices(small.truth.quats)[ball, :, 2]
    torch.testing.assert_close(normals, outward[ball], atol=1e-5, rtol=0)


def test_every_point_is_tracked_by_two_views_that_have_it_in_the_image(small: SyntheticScene) -> None:
    points, frames = small.scene.points, small.scene.frames
    assert points is not None and points.observations is not None and len(points) > 20
    assert int(points.sightings(frames).min()) >= 2
    within = torch.stack([inside_image(frame.camera, points.xyz) for frame in frames], dim=1)
    seen = within[points.observations[:, 0], points.observations[:, 1]]
    assert seen.float().mean() > 0.9  # noise may push a point at the rim over the edge


def test_points_behind_another_surface_are_not_seen(small: SyntheticScene) -> None:
    """A Gaussian in front of all others hides what lies behind it from the points' tracks."""
    points = small.scene.points
    assert points is not None and points.observations is not None
    within = torch.stack([inside_image(f.camera, points.xyz) for f in small.scene.frames]).sum()
    assert len(points.observations) < int(within)


@pytest.mark.parametrize("settings", [{"gaussians": 10}, {"views": 1}, {"width": 4}, {"arc": 200}, {"point_share": 0}])
def test_settings_that_make_no_scene_are_refused(settings: dict) -> None:
    refused("expected", SyntheticSettings, **settings)


def test_a_written_scene_is_found_again(small: SyntheticScene, tmp_path: Path) -> None:
    write_transforms_scene(small.scene, tmp_path / "new" / "scene")
    scene = load_scene(tmp_path / "new" / "scene")
    assert scene.kind == "transforms" and scene.names == small.scene.names
    for mine, theirs in zip(scene.load(), small.scene.load()):
        a, b = mine.camera, theirs.camera
        assert torch.equal(a.rotation, b.rotation) and torch.equal(a.centre, b.centre)
        assert (a.fx, a.fy, a.cx, a.cy, a.width, a.height) == (b.fx, b.fy, b.cx, b.cy, b.width, b.height)
        assert (mine.image - theirs.image).abs().max() <= 0.5 / 255 + 1e-6
    assert scene.points is not None and small.scene.points is not None
    assert torch.equal(scene.points.xyz, small.scene.points.xyz)
    assert (scene.points.rgb - small.scene.points.rgb).abs().max() <= 0.5 / 255 + 1e-6
    assert scene.points.observations is not None and small.scene.points.observations is not None
    assert torch.equal(scene.points.observations, small.scene.points.observations)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["scene"]


def test_tracks_follow_their_frames_into_the_order_of_the_file(small: SyntheticScene, tmp_path: Path) -> None:
    points = small.scene.points
    backwards = Scene("s", tmp_path, "synthetic", small.scene.frames[::-1], points, torch.zeros(3))
    write_transforms_scene(backwards, tmp_path / "s")
    scene = load_scene(tmp_path / "s")
    assert scene.points is not None and points is not None
    for name in scene.names:
        assert torch.equal(scene.points.sightings(scene.select([name])), points.sightings(small.scene.select([name])))


def test_names_in_two_folders_and_a_background_survive_a_round_trip(small: SyntheticScene, tmp_path: Path) -> None:
    names = ("train/r_2", "test/r_2")
    frames = tuple(Frame(name, f.camera, f.picture) for name, f in zip(names, small.scene.frames))
    write_transforms_scene(Scene("s", tmp_path, "blender", frames, None, torch.ones(3)), tmp_path / "s")
    scene = load_scene(tmp_path / "s")
    assert scene.names == ("images/test/r_2.png", "images/train/r_2.png")
    assert scene.background.tolist() == [1, 1, 1] and scene.points is None
    assert (scene.load()[1].image - small.scene.frames[0].view().image).abs().max() <= 0.5 / 255 + 1e-6


def test_a_scene_is_written_whole_or_not_at_all(small: SyntheticScene, tmp_path: Path) -> None:
    def fail(camera: Camera) -> View:
        raise OSError("disk full")

    broken = (*small.scene.frames[:2], Frame("images/z.png", small.scene.frames[2].camera, fail))
    with pytest.raises(OSError, match="disk full"):
        write_transforms_scene(Scene("s", tmp_path, "synthetic", broken, None, torch.zeros(3)), tmp_path / "s")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_overwritten(small: SyntheticScene, tmp_path: Path) -> None:
    refused("does not exist yet", write_transforms_scene, small.scene, tmp_path, error=FileExistsError)


def test_the_truth_has_the_size_asked_for() -> None:
    truth = synthetic_scene(SyntheticSettings(gaussians=300, views=2, width=16, height=12, sh_degree=2)).truth
    assert isinstance(truth, Gaussians) and abs(len(truth) - 300) <= 6 and truth.sh_degree == 2
    assert truth.flat.dtype == torch.float32
    truth.require_finite()
