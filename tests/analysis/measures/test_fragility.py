"""Fragility on scenes that are made to show one of its axes each, and at a swap whose jump is known."""

import numpy as np
import pytest
import torch
from scipy.stats import rankdata

from analysis.measures.fragility import LENGTHS, fragility, fragility_sentences, opacity_one_view, swap_jump
from splat.curvature.fields import scene_fields
from splat.curvature.objective import SceneObjective
from tests.splat.curvature.test_fields import scene_of

FRONT, TWO = [[0.0, 0.0, 0.0]], [[-1.5, 0.0, 0.0], [1.5, 0.0, 0.0]]
LAYERS: list[dict] = [{"means": [0.0, 0.0, z], "log_scales": [-2.0, -2.0, -4.0]} for z in (4.0, 4.2)]
LAYERS[1] |= {"sh": [[-0.4, 0.9, 0.3]]}
ASIDE = {"means": [1.1, 0.8, 4.1]}  # between them in depth, and nowhere in the image
GAP = 60 * 0.2 / 4.2  # px


def measured(objective: SceneObjective):
    return fragility(objective, *scene_fields(objective), torch.Generator().manual_seed(0), lambda *_: None)


def test_layers_swap_at_their_distance_and_not_before():
    swaps = measured(scene_of([*LAYERS, ASIDE], FRONT)).swaps
    assert swaps.pairs == [1] and swaps.sampled == 1
    assert swaps.share == [[float(length >= GAP) for length in LENGTHS]]


def test_the_jump_is_the_difference_of_both_orders():
    objective = scene_of([*LAYERS, ASIDE], FRONT)
    active = objective.active
    together = active.means.clone()
    together[1] = together[0]  # of equal depth, Gaussians are drawn in the order in which they are stored
    losses = []
    for order in ([0, 1, 2], [1, 0, 2]):
        there = active.with_flat(active.flat.clone())
        there.means[:] = together
        losses.append(objective.evaluate_view(0, there.select(torch.tensor(order)))[0])
    jump = losses[1] - losses[0]
    assert abs(jump) > 1e-6
    assert swap_jump(objective, 0, 1, GAP) == pytest.approx(jump, rel=0.02)
    assert measured(objective).swaps.jump == pytest.approx(abs(jump), rel=0.02)


def test_a_needle_has_the_curvature_in_rotation():
    needle = {"means": [0.6, 0.3, 4.0], "log_scales": [-0.8, -5.5, -5.5], "quats": [0.9, 0.0, 0.0, 0.4]}
    found = measured(scene_of([{}, needle, {"means": [-0.6, 0.0, 4.0]}], FRONT))
    assert found.needles == pytest.approx(1 / 3) and found.needles_steepest["quats"] == 1
    assert found.needles_trace["quats"] > 0.9


def test_a_blocker_of_one_view_is_alone_in_it():
    # before the second camera alone
    near = {"means": [1.15, 0.0, 1.2], "log_scales": [-2.0] * 3, "opacity_logits": 1.0}
    objective = scene_of([{}, near, {"means": [-0.5, 0.2, 4.0]}], TWO)
    found, (values, _) = measured(objective), scene_fields(objective)
    curvature = values["trace_opacity_logits"].abs()
    assert found.one_view == pytest.approx(1 / 3)
    assert found.one_view_trace == pytest.approx(float(curvature[1] / curvature.sum()))
    assert "33% of the Gaussians have over 90% of their weight in one view" in fragility_sentences(found)[2]


def test_the_correlation_is_that_of_ranks():
    generator = np.random.default_rng(0)
    x, y = generator.normal(size=(2, 40)).round(1)  # with ties
    ranks = np.corrcoef(rankdata(x), rankdata(y))[0, 1]
    values = {"trace_opacity_logits": torch.from_numpy(x), "one_view": torch.from_numpy(y)}
    assert opacity_one_view(values) == pytest.approx(ranks)
    assert np.isnan(opacity_one_view(values | {"one_view": torch.ones(40)}))
