"""Adaptive density control: what is cloned, split and removed, and when."""

from dataclasses import replace
from math import exp, log

import pytest
import torch

from splat.model.gaussians import ATTRIBUTES, Gaussians
from splat.projection.reference import Splats, add_screen_gradients, on_screen
from splat.render.render import render
from splat.training.densify import DensifySettings, ScreenGradients, densify, reset_opacities
from tests.refusals import refused
from tests.splat.tiny import EXTENT, HEIGHT, WIDTH, tiny_gaussians, tiny_views

SETTINGS = DensifySettings()
LIMIT = SETTINGS.clone_scale * EXTENT
HIGH, LOW = 1.0, 0.0


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def gaussians_of_sizes(*largest: float) -> Gaussians:
    """Opaque Gaussians with these largest scales, in units of the limit between clone and split."""
    gaussians = tiny_gaussians(len(largest))
    gaussians.opacity_logits.fill_(2.0)
    sizes = torch.tensor(largest)[:, None] * LIMIT * torch.tensor([0.5, 1.0, 0.1])
    gaussians.log_scales.copy_(sizes.log())
    return gaussians


def run(gaussians, gradients, prune_large=False, settings=SETTINGS):
    return densify(gaussians, torch.tensor(gradients), EXTENT, settings, generator(), prune_large=prune_large)


def test_without_high_gradients_gaussians_and_image_stay_bit_for_bit():
    gaussians, camera = tiny_gaussians(), tiny_views()[0].camera
    result = run(gaussians, [SETTINGS.gradient_threshold] * 12)
    assert torch.equal(result.gaussians.flat, gaussians.flat) and not result.fresh.any()
    assert torch.equal(render(result.gaussians, camera).image, render(gaussians, camera).image)


def test_small_gaussians_with_high_gradients_gain_an_exact_copy():
    gaussians = gaussians_of_sizes(0.9, 0.8, 0.7)
    result = run(gaussians, [LOW, HIGH, LOW])
    assert result.parents.tolist() == [0, 1, 2, 1] and result.fresh.tolist() == [False, False, False, True]
    assert torch.equal(result.gaussians.flat, gaussians.select(result.parents).flat)


def test_large_gaussians_with_high_gradients_become_two_smaller_ones():
    gaussians = gaussians_of_sizes(2.0, 3.0, 0.5)
    result = run(gaussians, [LOW, HIGH, LOW])
    assert result.parents.tolist() == [0, 2, 1, 1] and result.fresh.tolist() == [False, False, True, True]
    parents = gaussians.select(result.parents)
    assert torch.equal(result.gaussians.select(~result.fresh).flat, parents.select(~result.fresh).flat)
    for name in ("quats", "opacity_logits", "sh"):
        assert torch.equal(result.gaussians.attributes[name], parents.attributes[name])
    torch.testing.assert_close(result.gaussians.log_scales[2:].exp(), parents.log_scales[2:].exp() / 1.6)
    children = result.gaussians.means[2:]
    assert not torch.equal(children[0], children[1]) and not torch.equal(children[0], parents.means[2])


def test_children_of_a_split_are_spread_like_their_parent():
    parent = tiny_gaussians(1, dtype=torch.float64)
    count = 4000
    many = parent.select(torch.zeros(count, dtype=torch.long))
    children = run(many, [HIGH] * count).gaussians.means - parent.means[0]
    assert len(children) == 2 * count
    w, x, y, z = (parent.quats[0] / parent.quats[0].norm()).tolist()
    # R v = v + 2 w (u x v) + 2 u x (u x v), column by column
    u = torch.tensor([x, y, z], dtype=torch.float64)
    columns = []
    for v in torch.eye(3, dtype=torch.float64):
        turned = torch.linalg.cross(u, v)
        columns.append(v + 2 * w * turned + 2 * torch.linalg.cross(u, turned))
    axes = torch.stack(columns, dim=1) * parent.log_scales[0].exp()
    covariance = axes @ axes.T
    variances = covariance.diagonal()
    error = ((variances[:, None] * variances[None, :] + covariance**2) / (2 * count)).sqrt()
    assert ((children.T @ children / (2 * count) - covariance).abs() < 4 * error).all()
    assert (children.mean(0).abs() < 4 * (variances / (2 * count)).sqrt()).all()


def test_transparent_gaussians_are_removed_and_large_ones_only_when_asked():
    gaussians = gaussians_of_sizes(1.0, 1.0, 11.0)
    gaussians.opacity_logits[1] = log(0.0049 / 0.9951)
    kept = run(gaussians, [LOW] * 3)
    assert kept.parents.tolist() == [0, 2]
    assert run(gaussians, [LOW] * 3, prune_large=True).parents.tolist() == [0]
    gaussians.opacity_logits[1] = log(0.0051 / 0.9949)
    assert run(gaussians, [LOW] * 3).parents.tolist() == [0, 1, 2]


def test_without_a_prune_scale_nothing_is_removed_for_its_size():
    assert not replace(SETTINGS, prune_scale=None).prunes_large(30_000) and SETTINGS.prunes_large(30_000)


def test_only_opaque_gaussians_grow_where_an_opacity_is_asked_for():
    gaussians = gaussians_of_sizes(0.5, 0.5, 3.0, 3.0)
    gaussians.opacity_logits[[1, 3]] = log(0.09 / 0.91)
    assert run(gaussians, [HIGH] * 4).parents.tolist() == [0, 1, 0, 1, 2, 2, 3, 3]
    grown = run(gaussians, [HIGH] * 4, settings=replace(SETTINGS, grow_opacity=0.1))
    assert grown.parents.tolist() == [0, 1, 3, 0, 2, 2]


def test_large_gaussians_far_from_their_neighbours_are_split_whatever_their_gradient():
    gaussians = gaussians_of_sizes(120.0, 120.0, 80.0, 120.0, 120.0)  # the extent is 100
    away = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 9, 0], [0, 0, 8], [0, 0, 5]])
    gaussians.means.copy_(away)
    squared = torch.cdist(away, away).square().sort(dim=1).values[:, 1:4].mean(dim=1)
    settings = replace(SETTINGS, split_distance=20.0)
    assert (squared > 20 * EXTENT).tolist() == [False, False, True, True, False]
    change = run(gaussians, [LOW, HIGH, LOW, LOW, LOW], settings=settings)
    assert change.parents.tolist() == [0, 2, 4, 1, 1, 3, 3]
    assert run(gaussians, [LOW, HIGH, LOW, LOW, LOW]).parents.tolist() == [0, 2, 3, 4, 1, 1]


def test_opacity_reset_lowers_what_is_above_and_leaves_what_is_below():
    gaussians = tiny_gaussians(3)
    gaussians.opacity_logits.copy_(torch.tensor([2.0, -3.0, -6.0]))
    before = gaussians.flat.clone()
    reset_opacities(gaussians, 0.01)
    torch.testing.assert_close(gaussians.opacity_logits.sigmoid(), torch.tensor([0.01, 0.01, 1 / (1 + exp(6))]))
    changed = (gaussians.flat != before).nonzero()[:, 0]
    assert changed.tolist() == [gaussians.blocks["opacity_logits"].start, gaussians.blocks["opacity_logits"].start + 1]


def splats_at(*means: tuple[float, float], sigma: float = 1.0) -> Splats:
    n = len(means)
    conics = torch.tensor([1 / sigma**2, 0.0, 1 / sigma**2]).expand(n, 3)
    return Splats(torch.tensor(means), conics, torch.ones(n), torch.ones(n, 3), torch.ones(n), torch.ones(n).bool())


def test_gaussians_count_as_seen_when_their_3_sigma_box_meets_the_image():
    camera = tiny_views()[0].camera
    splats = splats_at((5.0, 5.0), (-2.9, 5.0), (-3.1, 5.0), (5.0, HEIGHT + 2.9), (5.0, HEIGHT + 3.1))
    assert on_screen(splats, camera).tolist() == [True, True, False, True, False]
    hidden = replace(splats, drawn=torch.tensor([False, True, True, True, True]))
    assert on_screen(hidden, camera).tolist() == [False, True, False, True, False]


def test_screen_gradients_are_mean_ndc_norms_over_renders_that_show_it():
    camera = tiny_views()[0].camera
    gradients = ScreenGradients.zero(3, torch.float32)
    for first, second_at in (([3.0, 0.0], (5.0, 5.0)), ([0.0, 1.0], (-9.0, 5.0))):
        splats = splats_at((5.0, 5.0), second_at, (-9.0, 0.0))
        gradients.add(torch.tensor([first, [1.0, 1.0], [0.0, 0.0]]), splats, camera)
    half_w, half_h = WIDTH / 2, HEIGHT / 2
    expected = torch.tensor([(3 * half_w + half_h) / 2, (half_w**2 + half_h**2) ** 0.5, 0.0])
    torch.testing.assert_close(gradients.mean, expected)


def test_the_kernel_adds_what_the_reference_adds():
    camera, g, size = tiny_views()[0].camera, generator(), torch.tensor([WIDTH, HEIGHT])
    means = torch.rand(400, 2, generator=g).double() * 3 * size - size
    a, b, c = (torch.rand(3, 400, generator=g).double() * 0.3).unbind()
    conics, gradient = torch.stack([a, b, c], dim=1), torch.randn(400, 2, generator=g).double()  # half have no ellipse
    drawn = torch.arange(400) % 5 > 0
    splats = Splats(means, conics, a, torch.rand(400, 3), torch.ones(400), drawn)
    found, expected = (ScreenGradients.zero(400, torch.float32) for _ in range(2))
    found.add(gradient, splats, camera)
    add_screen_gradients(expected.total, expected.renders, gradient, splats, camera)
    assert 100 < expected.renders.sum() < 300 and bool((a * c < b * b)[expected.renders > 0].any())
    assert torch.equal(found.renders, expected.renders)
    torch.testing.assert_close(found.total, expected.total)


def steps(iterations: int, what: str, **how: bool) -> list[int]:
    return [step for step in range(1, iterations + 1) if getattr(SETTINGS, what)(step, iterations, **how)]


def test_a_run_of_30000_steps_densifies_and_resets_when_3dgs_does():
    assert steps(30_000, "densifies") == list(range(600, 15_000, 100))
    assert steps(30_000, "resets_opacity", white=False) == [3000, 6000, 9000, 12_000]
    assert steps(30_000, "resets_opacity", white=True) == [500, 3000, 6000, 9000, 12_000]
    assert not SETTINGS.prunes_large(3000) and SETTINGS.prunes_large(3001)


def test_resets_begin_at_a_step_of_their_own_or_never():
    def resets(settings: DensifySettings) -> list[int]:
        return [step for step in range(1, 10_001) if settings.resets_opacity(step, 10_000, white=False)]

    whole = DensifySettings(stop_share=1.0)
    assert resets(whole) == [3000, 6000, 9000]
    assert resets(replace(whole, first_reset=501)) == [501, 3501, 6501, 9501]
    assert resets(replace(whole, reset_opacity=None, min_opacity=0.01)) == []
    assert not replace(whole, first_reset=501).prunes_large(501) and replace(whole, first_reset=501).prunes_large(502)


def test_short_runs_densify_in_their_second_quarter():
    assert steps(2000, "densifies") == [600, 700, 800, 900]
    assert steps(400, "densifies") == [120, 140, 160, 180]
    assert steps(4, "densifies") == []
    assert steps(2000, "resets_opacity", white=False) == []


@pytest.mark.parametrize("iterations", [20, 60, 200, 400, 1000, 3000, 5000])
def test_no_gaussian_is_added_in_the_first_tenth_of_a_run_of_up_to_5000_steps(iterations):
    rounds = steps(iterations, "densifies")
    assert rounds and min(rounds) > max(iterations / 10, iterations / 4 if iterations < 2000 else 500)


def test_a_round_of_density_control_at_most_doubles_the_gaussians():
    many = gaussians_of_sizes(0.5, 0.9, 2.0, 12.0)
    assert len(run(many, [HIGH] * 4).parents) == 2 * len(many)


@pytest.mark.parametrize(("iterations", "last"), [(2000, 500), (400, 100), (30, 7), (3, None)])
def test_on_white_opacities_are_reset_just_before_density_control_begins(iterations, last):
    assert steps(iterations, "resets_opacity", white=True) == ([] if last is None else [last])
    begun = replace(SETTINGS, every=1)
    later = [step for step in range(1, iterations + 1) if begun.densifies(step, iterations)]
    assert last is None or later[0] == last + 1


def test_density_control_that_is_switched_off_does_nothing():
    off = DensifySettings(enabled=False)
    assert not any(
        off.collects(s, 2000) or off.densifies(s, 2000) or off.resets_opacity(s, 2000, white=True)
        for s in range(1, 2001)
    )


def test_a_reset_that_would_remove_every_gaussian_is_refused():
    refused("expected min_opacity < reset_opacity", DensifySettings, min_opacity=0.02)


def test_every_attribute_of_a_densified_set_has_one_row_per_gaussian():
    result = run(gaussians_of_sizes(2.0, 0.5, 0.5, 3.0), [HIGH, HIGH, LOW, LOW])
    assert {len(result.gaussians.attributes[name]) for name in ATTRIBUTES} == {len(result.parents)} == {6}
