"""The eigenvectors of a scene with one needle are on the needle, and its picture, outline and sentence are of it."""

import msgspec
import numpy as np
import pytest
import torch

from analysis.measures.steepest import (
    NEAR,
    End,
    crop_around,
    kink_curvature,
    loss_nearby,
    outline_of,
    rendered_sentence,
    sentence,
    shown_step,
    steepest,
    weights_of,
)
from analysis.probe.record import renders_record
from analysis.records.quantities import percent
from analysis.records.schema import Renders
from landscape.slices.finite_probe import finite_probe
from splat.curvature.fields import scene_fields
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.projection.reference import project
from splat.render.render import render
from splat.render.sight import sight
from splat.scenes.view import View
from tests.splat.curvature.test_fields import scene_of
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians

NEEDLE = {"means": [0.9, 0.5, 4.0], "log_scales": [-0.9, -5.0, -5.0], "quats": [0.9, 0.0, 0.0, 0.4]}
ROUND = [{"means": [-0.5, 0.2, 4.0], "log_scales": [-1.0] * 3}, {}]


@pytest.fixture(scope="module")
def shown():
    objective = scene_of([ROUND[0], NEEDLE, ROUND[1]], [[0.0, 0.0, 0.0], [-0.4, 0.0, 0.0]])
    operator = SceneHessian(objective)
    values, vectors = torch.linalg.eigh(operator.apply(torch.eye(operator.dim, dtype=torch.float64)))
    step = 0.0002
    probe = finite_probe(
        objective.loss, objective.active.flat, vectors[:, -1], operator, [step * 2**k for k in range(8)]
    )
    renders = renders_record(probe, step)
    end = End("e₁", "the steepest direction", vectors[:, -1], float(values[-1]), renders)
    return objective, end, *steepest(objective, end, *scene_fields(objective), "steepest-e1")


def test_the_carrier_is_the_needle_and_the_sentence_says_so(shown):
    _, end, found, _ = shown
    first = found.carriers[0]
    assert first.gaussian == 1 and first.share > 0.9 and found.participation < 1.2
    assert sum(first.attributes.values()) == pytest.approx(first.share)
    assert first.sigmas[0] == pytest.approx(np.exp(-0.9)) and first.views == 2
    assert first.attributes["means"] == pytest.approx(float(end.vector[3:6].square().sum()))
    start = (
        f"{percent(first.share)} of e₁, the steepest direction, lies on Gaussian 1, most of it in position: a needle, "
    )
    assert found.sentence.startswith(start)
    assert "in the lower right of" in found.sentence and "seen by both views" in found.sentence


def test_a_carrier_beyond_the_edge_is_said_to_be_there(shown):
    objective, end, found, _ = shown
    first, view = found.carriers[0], objective.views[0]
    assert "outside" not in found.sentence
    for x, said in ((-8.0, "in the lower left of"), (1e4, "in the lower right of")):
        moved = msgspec.structs.replace(first, outline=[x, *first.outline[1:]])
        assert f"{said} {view.name}, its centre outside of the picture, " in sentence(end, [moved], 1.0, view, 2)


def test_a_disc_from_its_edge_is_a_plate_and_a_rod_is_a_needle(shown):
    objective, end, found, _ = shown
    view = objective.views[0]
    for sigmas, kind in (([2.5, 1.0, 0.004], "a plate seen edge-on"), ([7.3, 0.008, 0.0003], "a needle")):
        moved = msgspec.structs.replace(found.carriers[0], sigmas=sigmas, aspect=20.8)
        assert f": {kind}, 21 : 1 in the picture, in the " in sentence(end, [moved], 1.0, view, 2)


UNIT, AGAINST = "× the optimiser's step", [-1.9, -1.4, -0.2]
ALONG, MEAN = f"{UNIT} along e", "the mean of back and forth (by its curvature alone:"


@pytest.mark.parametrize(
    ("curvature", "ratios", "confirmed", "said"),
    [
        (4.0, [0.9, 1.0, 1.1], True, f"A step of 2 {ALONG} raises the loss by 4.4%, {MEAN} 4.0%); renders agree "),
        (4.0, [1.0, 0.9, 3.0], True, f"A step of 1 {ALONG} raises the loss by 0.90%, {MEAN} 1.0%); renders agree "),
        (-4.0, [1.0, 1.1, -1.0], True, f"A step of 1 {ALONG} lowers the loss by 1.1%, "),
        (-4.0, [0.6, 0.5, None], False, f"A step of 1 {ALONG} lowers the loss by 0.50%, {MEAN} 1.0%); not confirmed"),
        (-4.0, AGAINST, False, "The negative curvature along e is not confirmed by renders, by which it is 5.6 "),
        (4.0, AGAINST, None, "The curvature along e is not resolved: round-off hides it in renders at up to "),
    ],
)
def test_only_what_renders_bear_out_is_said_of_a_curvature(curvature, ratios, confirmed, said):
    errors: list[float | None] = [0.0 if confirmed is not None else 3.0] * 3
    renders = Renders(confirmed=confirmed, low=0.05, high=0.1, steps=[0.05, 0.1, 0.2], ratios=ratios, errors=errors)
    end = End("e", "an end", torch.zeros(1), curvature, msgspec.structs.replace(renders, optimiser_step=0.1))
    step = shown_step(renders)
    change = curvature * step**2 / 2 * ratios[renders.steps.index(step)]
    text = rendered_sentence(end, (2.0 + change, 2.0, 2.0 + change), step)
    assert text.startswith(said)
    assert confirmed is not True or text.endswith(f"renders agree within a factor of 2 at 1/2 to 1 {UNIT}.")


def test_steps_change_the_loss_as_the_curvature_has_it(shown):
    objective, end, found, pictures = shown
    low, middle, high = found.losses
    assert middle == objective.loss(objective.active.flat)
    second = (high - 2 * middle + low) / found.step**2
    assert second == pytest.approx(end.curvature, rel=0.3)  # the step is finite
    assert found.step == shown_step(end.renders) in end.renders.steps
    assert end.renders.ratios[end.renders.steps.index(found.step)] == pytest.approx(second / end.curvature, rel=1e-4)
    assert found.rendered == rendered_sentence(end, found.losses, found.step) and found.length in found.rendered
    left, top, right, bottom = found.crop
    assert pictures["zero"].shape == pictures["photograph"].shape == (bottom - top, right - left, 3)
    assert np.array_equal(pictures["photograph"], pictures["view"][top:bottom, left:right])
    assert {pictures["difference"].min(), pictures["difference"].max()} & {0, 254}


def test_the_outline_is_the_splats(shown):
    objective, _, found, _ = shown
    view = next(view for view in objective.views if view.name == found.view)
    splats = project(objective.active, view.camera, objective.settings)
    x, y, long, short, angle = found.carriers[0].outline
    assert (x, y) == pytest.approx(tuple(splats.means[1].tolist()))
    a, b, c = splats.conics[1].tolist()
    for reach, turn in ((long, angle), (short, angle + np.pi / 2)):
        dx, dy = reach * np.cos(turn), reach * np.sin(turn)
        assert a * dx**2 + 2 * b * dx * dy + c * dy**2 == pytest.approx(4)  # two standard deviations
    assert long / short == pytest.approx(found.carriers[0].aspect)


@pytest.mark.parametrize(("x", "angle"), [(80.0, 0.4), (-90.0, 0.1), (150.0, 1.9)])
def test_a_crop_has_all_of_an_outline_that_its_picture_has(x, angle):
    left, top, right, bottom = crop_around([[x, 60.0, 120.0, 2.0, angle]], 160, 120)
    along = np.linspace(-1, 1, 400) * 120
    points = np.stack([x + along * np.cos(angle), 60 + along * np.sin(angle)])
    points = points[:, ((points > 1) & (points < np.array([[159], [119]]))).all(axis=0)]
    assert points.size and (points > np.array([[left - 1], [top - 1]])).all()
    assert (points < np.array([[right + 1], [bottom + 1]])).all()
    assert (right - left) / 160 <= 1.35 * max(np.ptp(points[0]) / 160, np.ptp(points[1]) / 120) + 0.05  # tight


@pytest.mark.parametrize("x", [-50.0, 3.0, 80.0, 400.0])
def test_a_crop_lies_in_its_picture(x):
    left, top, right, bottom = crop_around([[x, 60.0, 30.0, 1.0, 0.3]], 160, 120)
    assert 0 <= left < right <= 160 and 0 <= top < bottom <= 120
    assert (right - left) / (bottom - top) == pytest.approx(4 / 3, rel=0.05)


def test_an_outline_of_an_upright_splat_points_up():
    assert outline_of(torch.tensor([5.0, 6.0, 1.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.0]))[2:4] == [4.0, 2.0]


def test_a_crop_has_the_outlines_of_all_carriers():
    left, top, right, bottom = crop_around([[40.0, 30.0, 5.0, 2.0, 0.0], [90.0, 60.0, 5.0, 2.0, 0.0]], 160, 120)
    assert left <= 35 and right >= 95 and top <= 28 and bottom >= 62


def test_the_curvature_of_kinks_is_what_the_hessian_leaves_out_of_losses_at_finite_steps():
    """Averaged over photographs whose residuals are even about 0."""
    gaussians, views, stream = random_gaussians(15, 1, logit=1.0), two_views(), torch.Generator().manual_seed(0)
    images = [render(gaussians, view.camera, BACKGROUND).image for view in views]
    seen, said, smooth = [], [], LossSettings("charbonnier")
    for _ in range(40):
        noisy = [image + 0.1 * (torch.rand(image.shape, generator=stream) - 0.5).double() for image in images]
        made = [view.with_image(image) for view, image in zip(views, noisy, strict=True)]
        objective = SceneObjective(gaussians, made, LossSettings("l1", ssim_weight=0.0), BACKGROUND)
        v = torch.randn(objective.active.flat.shape, generator=stream, dtype=torch.float64)
        v = SceneHessian(objective).project(v[:, None])[:, 0]
        v /= v.norm()
        step = 0.5 * NEAR / float(max(view.jvp(v[:, None])[0, :3].abs().max() for view in objective.linearized))
        losses = [objective.loss(objective.active.flat + sign * step * v) for sign in (-1, 0, 1)]
        known = float(v @ SceneHessian(objective).apply(v[:, None])[:, 0])
        seen.append((losses[0] - 2 * losses[1] + losses[2]) / step**2 - known)
        said.append(kink_curvature(objective, v))
    assert sum(seen) == pytest.approx(sum(said), rel=0.15) and min(said) > 0
    assert kink_curvature(SceneObjective(gaussians, views, smooth, BACKGROUND), v) == 0.0


@pytest.mark.parametrize(
    ("loss", "apart"), [(LossSettings(), 0.01), (LossSettings("l2", ssim_weight=0.5, border="valid"), 0.2)]
)
def test_the_loss_near_the_carriers_follows_the_loss(loss, apart):
    """In two views, one of them with two boxes; other Gaussians, before and behind, stand still."""
    rows = [
        {"means": [0.6, 0.3, 3.0]},
        {"means": [-0.8, -0.5, 4.0]},
        {"means": [0.75, 0.45, 4.0]},
        {"means": [-0.7, -0.5, 5.0]},
    ]
    scene = scene_of([each | {"log_scales": [-3.3, -3.0, -3.4]} for each in rows], [[0.0, 0.0, 0.0], [-0.4, 0.0, 0.0]])
    picture = torch.rand(3, 128, 160, generator=torch.Generator().manual_seed(0))
    views = [View(view.name, view.camera.resized(160, 128), picture) for view in scene.views]
    objective = SceneObjective(scene.active, views, loss, BACKGROUND.double())
    v = torch.zeros_like(objective.active.flat)
    v[:6] = torch.tensor([0.6, -0.5, 0.2, 0.3, 0.4, -0.3]) / 0.99**0.5
    places = [objective.active.flat + step * v for step in (-0.12, -0.05, 0.0, 0.07, 0.12)]
    near = loss_nearby(objective, v[:, None], [places[0], places[-1]])
    assert near is not None
    whole = np.array([objective.loss(place) for place in places])
    part = np.array([near.loss(place[near.rows]) for place in places])
    assert np.ptp(whole - part) < apart * np.ptp(whole)
    assert loss_nearby(scene, v[:, None], [places[0], places[-1]]) is None  # a large part of smaller pictures


def test_weights_of_a_view_are_those_of_the_pass_over_its_pixels(shown):
    objective = shown[0]
    for view, found in zip(objective.views, weights_of(objective), strict=True):
        torch.testing.assert_close(found, sight(objective.active, view.camera, objective.settings).weight)
