"""The eigenvectors of a scene with one needle are on the needle, and its picture, outline and sentence are of it."""

import msgspec
import numpy as np
import pytest
import torch

from analysis.measures.steepest import End, crop_around, outline_of, sentence, steepest
from splat.curvature.fields import scene_fields
from splat.curvature.hessian import SceneHessian
from splat.projection.reference import project
from tests.splat.curvature.test_fields import scene_of

NEEDLE = {"means": [0.9, 0.5, 4.0], "log_scales": [-0.9, -5.0, -5.0], "quats": [0.9, 0.0, 0.0, 0.4]}
ROUND = [{"means": [-0.5, 0.2, 4.0], "log_scales": [-1.0] * 3}, {}]


@pytest.fixture(scope="module")
def shown():
    objective = scene_of([ROUND[0], NEEDLE, ROUND[1]], [[0.0, 0.0, 0.0], [-0.4, 0.0, 0.0]])
    operator = SceneHessian(objective)
    values, vectors = torch.linalg.eigh(operator.apply(torch.eye(operator.dim, dtype=torch.float64)))
    end = End("e₁", "the steepest direction", vectors[:, -1], float(values[-1]))
    return objective, end, *steepest(objective, end, *scene_fields(objective), "steepest-e1")


def test_the_carrier_is_the_needle_and_the_sentence_says_so(shown):
    _, end, found, _ = shown
    first = found.carriers[0]
    assert first.gaussian == 1 and first.share > 0.9 and found.participation < 1.2
    assert sum(first.attributes.values()) == pytest.approx(first.share)
    assert first.sigmas[0] == pytest.approx(np.exp(-0.9)) and first.views == 2
    share = first.attributes["means"]
    assert share == pytest.approx(float(end.vector[3:6].square().sum()))
    assert found.sentence.startswith(f"{share:.0%} of e₁, the steepest direction, moves Gaussian 1, a needle of ")
    assert "in the lower right of" in found.sentence and "seen by both views" in found.sentence


def test_a_carrier_beyond_the_edge_is_said_to_be_there(shown):
    objective, end, found, _ = shown
    first, view = found.carriers[0], objective.views[0]
    assert "outside" not in found.sentence
    for x, said in ((-8.0, "in the lower left of"), (1e4, "in the lower right of")):
        moved = msgspec.structs.replace(first, outline=[x, *first.outline[1:]])
        assert f"{said} {view.name}, its centre outside of the picture, " in sentence(end, [moved], 1.0, view, 2)


def test_steps_change_the_loss_as_the_curvature_has_it(shown):
    objective, end, found, pictures = shown
    low, middle, high = found.losses
    assert middle == objective.loss(objective.active.flat)
    second = (high - 2 * middle + low) / found.step**2
    assert second == pytest.approx(end.curvature, rel=0.3)  # the step is finite
    assert end.curvature * found.step**2 / 2 == pytest.approx(0.01 * middle)
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


@pytest.mark.parametrize("x", [-50.0, 3.0, 80.0, 400.0])
def test_a_crop_lies_in_its_picture(x):
    left, top, right, bottom = crop_around([x, 60.0, 30.0, 1.0, 0.3], 160, 120)
    assert 0 <= left < right <= 160 and 0 <= top < bottom <= 120
    assert (right - left) / (bottom - top) == pytest.approx(4 / 3, rel=0.05)


def test_an_outline_of_an_upright_splat_points_up():
    assert outline_of(torch.tensor([5.0, 6.0, 1.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.0]))[2:4] == [4.0, 2.0]
