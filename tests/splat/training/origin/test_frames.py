"""Moved cameras see moved Gaussians as before; gsplat's normalisation has the properties that its definition demands."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splat.model.files.splat_ply import splat_ply
from splat.model.gaussians import Gaussians
from splat.render.render import render
from splat.scenes.scene import Scene, load_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import open_checkpoint
from splat.training.origin.frames import gsplat_frames, nerfstudio_frame, posed, shift_of, shift_to_origin
from splat.training.origin.options import Foreign
from tests.refusals import refused
from tests.splat.model.files import written

MADE = synthetic_scene(SyntheticSettings(gaussians=60, views=8, width=24, height=16))
TURN = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
MOVE = np.column_stack([2.5 * TURN, [0.3, -4.0, 1.0]])


def carried(gaussians: Gaussians, similarity: np.ndarray) -> Gaussians:
    """The Gaussians in the other world; their harmonics are of degree 0, which turns do not change."""
    scale = float(np.cbrt(np.linalg.det(similarity[:, :3])))
    turn = Rotation.from_matrix(similarity[:, :3] / scale)
    quats = gaussians.quats.numpy()
    turned = (turn * Rotation.from_quat(quats[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    means = gaussians.means.numpy() @ similarity[:, :3].T + similarity[:, 3]
    values = {**gaussians.attributes, "means": torch.from_numpy(means), "quats": torch.from_numpy(turned)}
    values["log_scales"] = gaussians.log_scales + np.log(scale)
    return Gaussians.pack({name: value.to(gaussians.flat.dtype) for name, value in values.items()})


def flat(dtype: torch.dtype = torch.float64) -> Gaussians:
    return MADE.truth.select(torch.arange(len(MADE.truth)), 0).to(dtype)


def test_moved_cameras_see_moved_gaussians_as_before():
    scene = posed(MADE.scene, MOVE.tolist(), centred=False)
    for before, after in zip(MADE.scene.frames, scene.frames, strict=True):
        images = [
            render(g, frame.camera, backend="reference").image
            for g, frame in ((flat(), before), (carried(flat(), MOVE), after))
        ]
        torch.testing.assert_close(*images, rtol=0, atol=1e-9)
        assert torch.equal(after.view().image, before.view().image) and after.view().camera is after.camera


@pytest.fixture
def scene(tmp_path) -> Scene:
    write_transforms_scene(MADE.scene, tmp_path / "scene")
    return load_scene(tmp_path / "scene")


def test_gsplats_worlds_have_the_axes_and_the_size_that_define_them(scene):
    assert scene.points is not None
    frames = gsplat_frames(scene)
    for similarity in frames:
        points = scene.points.xyz.numpy() @ similarity[:, :3].T + similarity[:, 3]
        covariance = np.cov(points, rowvar=False)
        np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-12 * covariance.max())
        assert (np.diff(np.diag(covariance)) <= 0).all()
        assert np.linalg.det(similarity[:, :3]) > 0
    turns = [frame[:, :3] @ np.linalg.inv(frames[0][:, :3]) for frame in frames]
    np.testing.assert_allclose(
        [np.diag(turn) for turn in turns], [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], atol=1e-9
    )
    centres = np.stack([camera.camera.centre.numpy() for camera in scene.frames])
    axes = np.stack([camera.camera.forward.numpy() for camera in scene.frames])
    up = -np.stack([camera.camera.rotation[1].numpy() for camera in scene.frames]).mean(axis=0)
    turn = Rotation.align_vectors([[0, -1, 0]], [up])[0].as_matrix()  # the shortest
    centres, axes = centres @ turn.T, axes @ turn.T
    focus = np.median(centres - (centres * axes).sum(axis=1, keepdims=True) * axes, axis=0)
    size = np.median(np.linalg.norm(centres - focus, axis=1))
    assert np.cbrt(np.linalg.det(frames[0][:, :3])) * size == pytest.approx(1, rel=1e-9)
    middle = np.median(scene.points.xyz.numpy() @ turn.T, axis=0) @ turn
    np.testing.assert_allclose([frame @ [*middle, 1] for frame in frames], 0, atol=1e-9)


@pytest.mark.parametrize("variant", range(4))
def test_whichever_signs_gsplat_had_the_cameras_find_them(tmp_path, scene, variant):
    similarity = gsplat_frames(scene)[variant]
    path = tmp_path / "ckpt_1_rank0.pt"
    path.write_bytes(written.gsplat_pt(carried(flat(torch.float32), similarity)))
    found = open_checkpoint(path, Foreign(scene=tmp_path / "scene", guess_views=True), path)
    assert found.scene.similarity is not None and found.origin
    np.testing.assert_allclose(found.scene.similarity, similarity, rtol=1e-9, atol=1e-12)
    camera = found.with_scene(path).scene.frames[0].camera
    expected = similarity[:, :3] @ scene.frames[0].camera.centre.numpy() + similarity[:, 3]
    np.testing.assert_allclose(camera.centre.numpy(), expected, atol=1e-12)


def test_gsplats_world_needs_points(scene):
    from dataclasses import replace

    refused("gsplat-raw", gsplat_frames, replace(scene, points=None))


def test_nerfstudios_world_is_in_its_file_and_before_the_applied_transform(tmp_path, scene):
    rigid, applied = MOVE / 1.0, np.array([[1.0, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 2]])
    rigid[:, :3] /= 2.5
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": rigid.tolist(), "scale": 0.25}))
    point = np.array([0.3, -0.2, 1.7])
    found = nerfstudio_frame(tmp_path / "a.ckpt", scene)
    np.testing.assert_allclose(found @ [*point, 1], 0.25 * (rigid @ [*point, 1]), atol=1e-12)
    file = tmp_path / "scene" / "transforms.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "applied_transform": applied.tolist()}))
    found = nerfstudio_frame(tmp_path / "nerfstudio_models" / "a.ckpt", scene)  # the folder above
    np.testing.assert_allclose(found @ [*(applied @ [*point, 1]), 1], 0.25 * (rigid @ [*point, 1]), atol=1e-12)


@pytest.mark.parametrize("content", ["[]", "{", '{"transform": [[1, 0, 0, 0]], "scale": 1}', '{"transform": 5}'])
def test_a_file_that_is_no_similarity_is_refused(tmp_path, scene, content):
    (tmp_path / "dataparser_transforms.json").write_text(content)
    refused("expected", nerfstudio_frame, tmp_path / "a.ckpt", scene)


def test_an_applied_scale_is_taken_back(tmp_path, scene):
    rigid, applied = np.column_stack([TURN, [0.1, 0.2, 0.3]]), np.array([[1.0, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 2]])
    # nerfstudio saves scale x applied_scale, and transform x applied_transform
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": rigid.tolist(), "scale": 0.25 * 3}))
    file, point = tmp_path / "scene/transforms.json", np.array([0.3, -0.2, 1.7])
    content = json.loads(file.read_text()) | {"applied_transform": applied.tolist()}
    file.write_text(json.dumps({**content, "applied_scale": 3.0}))
    found = nerfstudio_frame(tmp_path / "a.ckpt", scene)
    np.testing.assert_allclose(found @ [*(applied @ [*point, 1]), 1], 0.25 * (rigid @ [*point, 1]), atol=1e-12)
    for wrong in (0, "3", -1.0):
        file.write_text(json.dumps({**content, "applied_scale": wrong}))
        refused("expected an applied_scale above 0", nerfstudio_frame, tmp_path / "a.ckpt", scene)


def far(scene: Scene, away: tuple[float, float, float]) -> Scene:
    return posed(scene, np.column_stack([np.eye(3), away]).tolist(), centred=False)


@pytest.mark.parametrize("away", [(431000.0, 5412000.0, 300.0), (0.0, -1e4, 0.0), (1e9, 0.0, 0.0)])
def test_a_world_far_from_its_origin_is_moved_back_without_rounding(away):
    shift = shift_to_origin(far(MADE.scene, away))
    assert shift is not None and shift_to_origin(MADE.scene) is None
    assert np.array_equal(shift[:, 3].astype(np.float32), shift[:, 3])
    assert shift_of(shift.tolist()) == (-shift[:, 3]).tolist()
    back = posed(far(MADE.scene, away), shift.tolist(), centred=False)
    assert shift_to_origin(back) is None and back.points is not None and MADE.scene.points is not None
    rounding = np.spacing(max(map(abs, away)))  # of the world in float64
    moved = torch.from_numpy(np.array(away) + shift[:, 3])
    for before, after in zip(MADE.scene.frames, back.frames, strict=True):
        assert (after.camera.centre - before.camera.centre - moved).abs().max() <= rounding
    assert (back.points.xyz - MADE.scene.points.xyz - moved).abs().max() <= rounding
    (note,) = [note for note in back.notes if "float32" in note and shift_of(shift.tolist()) is not None][-1:]
    assert f"{-shift[0, 3]:.9g}, {-shift[1, 3]:.9g}, {-shift[2, 3]:.9g}" in note


def test_what_float32_rounds_decides_at_a_thousandth_of_a_pixel():
    cameras = [frame.camera for frame in MADE.scene.frames]
    centres = torch.stack([camera.centre for camera in cameras])
    assert MADE.scene.points is not None
    depth = float((centres - MADE.scene.points.xyz.median(dim=0).values).norm(dim=1).median())
    limit = 1e-3 * depth / (2**-23 * cameras[0].fx)  # world units from the origin
    beyond = float(centres.mean(dim=0).norm())
    assert shift_to_origin(far(MADE.scene, (0.0, 0.0, limit + 2 * beyond))) is not None
    assert shift_to_origin(far(MADE.scene, (0.0, 0.0, limit - 2 * beyond))) is None


def test_only_a_pure_shift_is_one():
    assert shift_of(None) is shift_of(MOVE.tolist()) is shift_of(np.diag([2.0, 2, 2, 1])[:3].tolist()) is None


@pytest.mark.parametrize("exported_near", [True, False])
def test_another_tools_gaussians_are_probed_near_the_origin(tmp_path, exported_near):
    away = (4000.0, -60000.0, 300.0)
    write_transforms_scene(far(MADE.scene, away), tmp_path / "scene")
    shift = shift_to_origin(load_scene(tmp_path / "scene"))
    assert shift is not None
    near = carried(flat(), np.column_stack([np.eye(3), np.array(away) + shift[:, 3]]))
    file = near if exported_near else carried(flat(), np.column_stack([np.eye(3), away]))
    path = tmp_path / "a.ply"
    path.write_bytes(splat_ply(file.to(torch.float32)))
    found = open_checkpoint(path, Foreign(scene=tmp_path / "scene", guess_views=True, trained_by="gsplat-raw"), path)
    assert found.scene.similarity == shift.tolist()
    rounding = 1e-6 if exported_near else np.spacing(np.float32(60000))
    assert (found.training.gaussians.means - near.means).abs().max() <= rounding
