"""`landscape view`: what the page is given is what the scene has, and its controls do what they say."""

from pathlib import Path

import numpy as np
import pytest
import torch

from analysis.commands.cli import main
from analysis.commands.map.fields import measured_fields
from analysis.commands.map.pictures import rendered
from analysis.commands.view import viewer as view
from analysis.commands.view.command import offline_page
from analysis.measures.steepest import heaviest_view
from splat.curvature.objective import SceneObjective
from splat.projection.reference import rotation_matrices
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.training.origin.fingerprint import Fingerprint
from tests.splat.render.test_sight import weights

NOTHING = Fingerprint({}, {}, "")
MADE = synthetic_scene(SyntheticSettings(gaussians=150, views=2, width=32, height=24))


@pytest.fixture(scope="module")
def objective() -> SceneObjective:
    return SceneObjective(MADE.truth, MADE.scene.load())


@pytest.fixture
def viewer(objective):
    viser = pytest.importorskip("viser", reason="needs viser; pip install -e '.[view]'")
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield view.Viewer(server, objective)
    server.stop()


def test_without_viser_it_says_what_to_install_before_libraries_are_loaded(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("analysis.commands.cli.find_spec", lambda name: None)
    monkeypatch.setattr("analysis.commands.cli.import_module", lambda name: pytest.fail(f"{name} is loaded"))
    (tmp_path / "checkpoint.pt").touch()
    assert main(["view", str(tmp_path / "checkpoint.pt")]) == 2
    assert "pip install -e '.[view]'" in capsys.readouterr().err


def test_float16_holds_the_scaled_splats(objective):
    gaussians = objective.active.with_flat(objective.active.flat.clone())
    gaussians.means[:] = gaussians.means * 1e-4 + 7  # far from the origin, and small
    gaussians.log_scales[:] += np.log(1e-4)
    frame = view.Frame(gaussians)
    found = frame.splats(gaussians)
    axes = rotation_matrices(gaussians.quats.double()) * gaussians.log_scales.double().exp()[:, None, :] * frame.scale
    exact = (axes @ axes.mT).numpy()
    held = found["covariances"].astype(np.float16).astype(np.float64)
    assert np.linalg.norm(held - exact, axis=(1, 2)) == pytest.approx(
        0, abs=0.01 * np.linalg.norm(exact, axis=(1, 2)).min()
    )
    assert np.quantile(np.linalg.norm(found["centers"], axis=1), view.WITHIN) == pytest.approx(view.RADIUS)
    assert torch.allclose(frame.back(found["centers"][3]).float(), gaussians.means[3], atol=1e-6)


def test_a_click_finds_the_splat_with_most_weight(objective):
    camera, hits = objective.views[0].camera, 0
    w, _ = weights(objective.active, camera, objective.settings)
    for row, column in ((5, 6), (12, 16), (18, 25), (20, 10)):
        inside = torch.tensor([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
        found = view.heaviest_on_ray(objective, camera.centre, inside.double() @ camera.rotation)
        hits += found is not None and found[0] in w[:, row, column].topk(2).indices.tolist()
    assert hits >= 3  # the pixel of a click is smaller, and has another blur
    assert view.heaviest_on_ray(objective, camera.centre, -camera.forward) is None


def test_the_controls_colour_hide_and_step(viewer, objective):
    fields = measured_fields(objective, Path("nowhere"), NOTHING, [], lambda *_: None)
    viewer.add_fields(fields, "largest")
    values = fields.values["largest"].numpy()
    expected = fields.shade("largest").colours_of(values)
    assert np.abs(viewer.splats.rgbs / 255 - expected).max() < 0.01
    assert "largest curvature" in viewer.legend.content
    viewer.shown.value = (90.0, 100.0)
    viewer.recolour()
    kind, (low, high) = fields.kinds["largest"], np.percentile(values, (90, 100))
    between = f"from {view.quantity(low)} to {view.in_words(kind, high)}"
    assert between in viewer.between.content and "per unit² of the parameters" in between
    shade = fields.shade("largest")  # whose ends are the slider's at first
    colours = f"from {view.quantity(shade.value(shade.low))} to {view.in_words(kind, shade.value(shade.high))}"
    assert colours in viewer.ends.content
    viewer.scale.value = (50.0, 60.0)
    viewer.recolour()
    assert "colours from" in viewer.ends.content and colours not in viewer.ends.content
    assert (viewer.splats.opacities[:, 0] > 0).mean() == pytest.approx(0.1, abs=0.02)
    assert values[viewer.splats.opacities[:, 0] > 0].min() >= np.percentile(values, 90)
    direction = torch.zeros_like(objective.active.flat)
    direction[objective.blocks["sh"]] = 1.0
    viewer.add_steps({"e₁": (direction, 0.05)})
    viewer.sliders["e₁"].value = view.UNITS  # all the way
    viewer.step()
    there = objective.active.with_flat(objective.active.flat + 0.05 * direction)
    expected_image = view.bytes_of(rendered(objective, 0, there))
    assert np.array_equal(viewer.render.image, expected_image)
    assert f"{view.quantity(objective.loss(there.flat))}" in viewer.loss.content
    viewer.click(*_ray(viewer, objective))
    assert "Gaussian" in viewer.numbers.content and "largest curvature" in viewer.numbers.content


@pytest.mark.parametrize("start", [0, 1])
def test_the_page_opens_in_the_training_view_that_it_is_told(objective, start):
    viser = pytest.importorskip("viser", reason="needs viser; pip install -e '.[view]'")
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        found, camera = view.Viewer(server, objective, start), objective.views[start].camera
        first, frame = server.initial_camera, found.frame
        assert np.allclose(first.position, frame.place(camera.centre)) and np.allclose(first.up, -camera.rotation[1])
        ahead = first.look_at - first.position
        assert np.allclose(ahead / np.linalg.norm(ahead), camera.forward, atol=1e-6)
        assert first.fov == pytest.approx(2 * np.arctan(camera.height / 2 / camera.fy))
        assert found.view.value == objective.views[start].name
        assert np.array_equal(found.render.image, view.bytes_of(rendered(objective, start)))
    finally:
        server.stop()


def test_the_view_of_a_direction_is_that_where_its_heaviest_gaussian_weighs_most(objective):
    for index in (3, 60):
        vector = torch.zeros_like(objective.active.flat)
        objective.active.with_flat(vector).means[index] = 1.0
        heavy = [
            float(weights(objective.active, each.camera, objective.settings)[0][index].sum())
            for each in objective.views
        ]
        assert heaviest_view(objective, vector) == int(np.argmax(heavy))


def test_a_pick_is_outlined_and_lists_the_field_shown_first(viewer, objective):
    viewer.add_fields(measured_fields(objective, Path("nowhere"), NOTHING, [], lambda *_: None), "largest")
    viewer.click(*_ray(viewer, objective))
    index, _ = viewer.picked
    told = viewer.numbers.content.splitlines()
    assert told[2].startswith("**largest curvature: ") and told[2].endswith("per unit² of the parameters**")
    assert f"- views that see it: {int(viewer.fields.values['views'][index])}" in told
    viewer.field.value = "views that see it"
    viewer.recolour()
    assert viewer.numbers.content.splitlines()[2].startswith("**views that see it: ")
    assert viewer.mark.visible
    ring, at = (axes[index].double() for axes in (viewer.frame.axes(objective.active), objective.active.means))
    distance = torch.tensor(viewer.frame.outline(objective.active, index)) - torch.tensor(viewer.frame.place(at))
    assert torch.linalg.norm(torch.linalg.solve(ring, distance.mT), dim=1).sub(view.OUTLINE).abs().max() < 1e-9
    place, forward = _ray(viewer, objective)
    viewer.click(place, [-x for x in forward])
    assert not viewer.mark.visible and viewer.numbers.content == "Nothing there."


def _ray(viewer: view.Viewer, objective: SceneObjective) -> tuple[list[float], list[float]]:
    camera = objective.views[0].camera
    return viewer.frame.place(camera.centre).tolist(), camera.forward.tolist()


def test_a_page_needs_no_network(viewer):
    viewer.add_fields(measured_fields(viewer.objective, Path("nowhere"), NOTHING, [], lambda *_: None), "condition")
    written = offline_page(viewer, "condition")
    assert "__VISER_EMBED_DATA__" in written and len(written) < 2e6
    assert 'src="http' not in written and 'href="http' not in written
