"""FSGS: unpooling against a loop over all pairs, the depth term against NumPy and autograd, its schedule."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splat.render.render import render
from splat.scenes.view import View
from splat.training.loop import train
from splat.training.methods.depth import FSGS, depth_loss, unpool
from splat.training.methods.methods import ThreeDGS
from splat.training.state import Training
from tests.splat.tiny import EXTENT, HEIGHT, WIDTH, a_step, both_of, tiny_config, tiny_gaussians, tiny_views, trained

WIDE = FSGS(threshold=0.2, large=0.1)  # of the tiny scene some are sources, some not


def with_depths(views: list[View]) -> list[View]:
    generator = torch.Generator().manual_seed(5)
    return [replace(view, depth=torch.rand(HEIGHT, WIDTH, generator=generator)) for view in views]


def edges_by_hand(means: np.ndarray, largest: np.ndarray, settings: FSGS) -> list[tuple[int, int]]:
    """(source, destination) from every distance there is."""
    edges = []
    for i in range(len(means)):
        others = sorted((float(np.linalg.norm(means[i] - means[j])), j) for j in range(len(means)) if j != i)
        nearest = others[: settings.neighbours]
        score = sum(distance ** (2 if settings.released else 1) for distance, _ in nearest) / len(nearest)
        if score > settings.threshold * EXTENT and largest[i] > settings.large * EXTENT:
            edges += [(i, j) for _, j in nearest]
    if settings.released:
        sources = list(dict.fromkeys(i for i, _ in edges))
        edges = [(sources[e % len(sources)], j) for e, (_, j) in enumerate(edges)]
    return edges


@pytest.mark.parametrize("released", [False, True])
@pytest.mark.parametrize("neighbours", [1, 3, 40])
def test_unpooling_grows_one_gaussian_on_every_edge_of_a_distant_large_one(neighbours, released):
    settings = replace(WIDE, neighbours=neighbours, released=released)
    gaussians = tiny_gaussians(20, sh_degree=1, dtype=torch.float64)
    change = unpool(gaussians, EXTENT, settings)
    means = gaussians.means.numpy()
    edges = edges_by_hand(means, gaussians.log_scales.exp().amax(dim=1).numpy(), settings)
    assert 0 < len({i for i, _ in edges}) < 20
    old, new = change.gaussians.select(torch.arange(20)), change.gaussians.select(torch.arange(20, 20 + len(edges)))
    assert torch.equal(old.flat, gaussians.flat) and len(change.gaussians) == 20 + len(edges)
    assert change.fresh.tolist() == [False] * 20 + [True] * len(edges)
    assert change.parents.tolist() == [*range(20), *(j for _, j in edges)]
    halfway = np.array([(means[i] + means[j]) / 2 for i, j in edges])
    np.testing.assert_allclose(new.means.numpy(), halfway, rtol=0, atol=1e-15)
    destination = gaussians.select(torch.tensor([j for _, j in edges]))
    assert torch.equal(new.log_scales, destination.log_scales)
    assert torch.equal(new.opacity_logits, destination.opacity_logits)
    assert not new.sh.any() and (new.quats == torch.tensor([1.0, 0, 0, 0])).all()


@pytest.mark.parametrize("n", [1, 2])
def test_a_scene_of_one_or_two_gaussians_is_unpooled_too(n):
    gaussians = tiny_gaussians(n)
    grown = unpool(gaussians, EXTENT, FSGS(threshold=1e-6, large=0.0)).fresh.sum()
    assert grown == {1: 0, 2: 2}[n]


def test_as_released_the_last_step_of_the_unpooling_is_left_out():
    config = replace(tiny_config(), method=replace(WIDE, unpool_until=6, depth_weight=0.0, released=True))
    assert [row["step"] for row in trained(config).method.history] == [4]


def test_unpooling_happens_at_densifications_until_its_last_step():
    config = replace(tiny_config(), method=replace(WIDE, unpool_until=6, depth_weight=0.0))
    training = Training.start(tiny_gaussians(), EXTENT, config)
    counts = [done.gaussians for done in train(training, tiny_views())]
    steps = [row["step"] for row in training.method.history]
    assert steps == [number for number in range(1, 7) if config.densify.densifies(number, 12)] == [4, 6]
    assert any(row["grown"] for row in training.method.history)
    plain = Training.start(tiny_gaussians(), EXTENT, replace(config, method=ThreeDGS()))
    before = [done.gaussians for done in train(plain, tiny_views())]
    grown = training.method.history[0]["grown"]
    assert counts[:3] == before[:3] and counts[3] == before[3] + grown


@pytest.mark.parametrize("kind", ["disparity", "depth"])
def test_the_depth_term_is_one_minus_the_correlation_with_the_map(kind):
    generator = torch.Generator().manual_seed(1)
    rendered = torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    view = with_depths(tiny_views())[0]
    for scale in (1.0, 1e3):
        assert view.depth is not None
        values = scale * view.depth
        scaled = replace(view, depth=values)
        maps = [values] if kind == "depth" else [-values, 1 / (values.double() + 200)]
        expected = 1 - max(np.corrcoef(rendered.numpy().ravel(), each.double().numpy().ravel())[0, 1] for each in maps)
        assert depth_loss(rendered, scaled, kind).item() == pytest.approx(expected, rel=1e-12)
    shifted = depth_loss(rendered, replace(view, depth=3 * values + 7), "depth")
    assert shifted.item() == pytest.approx(depth_loss(rendered, scaled, "depth").item(), rel=1e-5)  # float32 maps


def test_disparities_down_to_minus_200_are_correlated_as_they_are():
    view = tiny_views()[0]
    rendered = torch.arange(float(HEIGHT * WIDTH)).reshape(HEIGHT, WIDTH)
    assert depth_loss(rendered, replace(view, depth=-rendered), "disparity").item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("number", "weight"), [(1, 0.3), (6, 0.3), (7, 0.02)])
def test_the_gradient_is_that_of_the_loss_and_the_weighted_depth_term(number, weight):
    settings = FSGS(depth_weight=0.3, late_depth_weight=0.02, depth_until=6, depths="depth")
    step = a_step(settings, number, with_depths(tiny_views(torch.float64)))
    base, got = both_of(step)

    flat = step.gaussians.flat.detach().requires_grad_()
    shown = render(step.gaussians.with_flat(flat), step.camera, depth=True, backend="reference").depth
    assert shown is not None and step.views[1].depth is not None
    both = torch.stack([shown.flatten(), step.views[1].depth.double().flatten()])
    (expected,) = torch.autograd.grad(weight * (1 - torch.corrcoef(both)[0, 1]), flat)
    assert (got.gradient - base.gradient - expected).norm() < 1e-10 * expected.norm()


def test_where_nothing_is_seen_depth_adds_nothing_and_is_not_correlated(monkeypatch):
    monkeypatch.setattr("splat.training.methods.depth.depth_loss", None)
    step = a_step(FSGS(), views=with_depths(tiny_views(torch.float64)))
    step.gaussians.means[:, 2] = -3.0
    base, whole = both_of(step)
    assert torch.equal(whole.gradient, base.gradient)


def test_without_depth_maps_only_the_unpooling_can_be_trained():
    training = Training.start(tiny_gaussians(), EXTENT, replace(tiny_config(), method=FSGS()))
    views = with_depths(tiny_views())[:2] + tiny_views()[2:]
    with pytest.raises(ValueError, match=r"depth map of every training view for the method fsgs, got none of 'view2'"):
        next(train(training, views))
    assert training.step == 0
