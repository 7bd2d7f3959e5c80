"""DNGaussian: normalisation patch by patch, which parameters each loss moves, and its schedule."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splat.model.gaussians import Gaussians
from splat.render.render import render
from splat.training.loop import train
from splat.training.methods.depth import DNGaussian, normalised
from splat.training.state import Step, TrainConfig, Training
from tests.refusals import refused
from tests.splat.tiny import EXTENT, HEIGHT, WIDTH, a_step, both_of, tiny_gaussians, tiny_views

SMALL = DNGaussian(smallest_patch=3, largest_patch=6)


def step_of(settings: DNGaussian, number: int = 1, scale: float = 1.0, shift: float = 0.0) -> Step:
    generator = torch.Generator().manual_seed(5)
    maps = [scale * torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64) + shift for _ in range(3)]
    views = [replace(view, depth=values) for view, values in zip(tiny_views(torch.float64), maps, strict=True)]
    return a_step(settings, number, views)


def added(step: Step) -> Gaussians:
    """What the method adds to the photometric gradient."""
    base, whole = both_of(step)
    return step.gaussians.with_flat(whole.gradient - base.gradient)


@pytest.mark.parametrize("side", [3, 5, 14])
@pytest.mark.parametrize("local", [True, False])
def test_depth_is_normalised_in_whole_patches_from_the_corner(side, local):
    depth = np.random.default_rng(0).normal(size=(14, 20))
    depth[:side, :side] = 2.0  # a patch without variation
    corners = [(top, left) for top in range(0, 14 - side + 1, side) for left in range(0, 20 - side + 1, side)]
    patches = [depth[top : top + side, left : left + side].ravel() for top, left in corners]
    rows = []
    for patch in patches:
        scale = (patch if local else depth).std(ddof=1) + 0.01 * np.std(patches, ddof=1)
        rows.append((patch - patch.mean()) / (scale or 1))
    got = normalised(torch.from_numpy(depth), side, local=local)
    np.testing.assert_allclose(got.numpy(), np.array(rows), rtol=1e-12, atol=1e-14)


def loss_by_hand(rendered: torch.Tensor, target: torch.Tensor, sides: list[int], tolerance: float) -> torch.Tensor:
    """0.1 E_local + E_global by unfolding, the variances by torch."""
    total = rendered.new_zeros(())
    for side, weight, local in zip(sides, (0.1, 1.0), (True, False), strict=True):
        both = []
        for depth in (rendered, target):
            patches = torch.nn.functional.unfold(depth[None, None], side, stride=side)[0].T
            spread = patches.std(dim=1, keepdim=True) if local else depth.std().detach()
            spread = spread + 0.01 * patches.std()
            both.append((patches - patches.mean(dim=1, keepdim=True)) / spread)
        difference = both[0] - both[1]
        total = total + weight * difference[difference.abs() > tolerance].square().mean()
    return total


def test_the_hard_loss_moves_means_alone_and_the_soft_loss_opacities():
    settings = replace(SMALL, tolerance=0.1, soft_start=0, depths="depth")
    step = step_of(settings)
    got = added(step)
    generator = torch.Generator().manual_seed(step.config.seed)
    sides = torch.randint(3, 7, (4,), generator=generator).tolist()
    target = step.views[1].depth
    assert target is not None
    parts = step.gaussians.attributes
    hard = {**parts, "opacity_logits": torch.full_like(parts["opacity_logits"], np.log(0.95 / 0.05))}
    for attribute, these, drawn in (("means", hard, sides[:2]), ("opacity_logits", parts, sides[2:])):
        leaf = parts[attribute].clone().requires_grad_()
        depth = render(Gaussians.pack({**these, attribute: leaf}), step.camera, depth=True, backend="reference").depth
        assert depth is not None
        (expected,) = torch.autograd.grad(loss_by_hand(depth, target, drawn, 0.1), leaf)
        error = got.attributes[attribute] - expected
        assert error.norm() < 1e-10 * expected.norm()
    for name in ("log_scales", "quats", "sh"):
        assert not got.attributes[name].any()


def test_the_hard_and_the_soft_loss_begin_after_their_starts():
    settings = replace(SMALL, hard_start=2, soft_start=4)
    for number in (2, 3, 4, 5):
        parts = added(step_of(settings, number)).attributes
        assert parts["means"].any().item() == (number > 2)
        assert parts["opacity_logits"].any().item() == (number > 4)


def test_scale_and_shift_of_a_map_do_not_matter_and_disparity_is_negated():
    settings = replace(SMALL, soft_start=0, depths="depth")
    plain = added(step_of(settings)).flat
    assert (added(step_of(settings, scale=40.0, shift=7.0)).flat - plain).norm() < 1e-10 * plain.norm()
    upside_down = added(step_of(replace(settings, depths="disparity"), scale=-1.0)).flat
    assert (upside_down - plain).norm() < 1e-10 * plain.norm()


def test_errors_within_the_tolerance_add_nothing():
    assert not added(step_of(replace(SMALL, tolerance=1e3, soft_start=0))).flat.any()


def test_a_loss_of_weight_0_adds_nothing_but_the_draws_stay_the_same():
    both = added(step_of(replace(SMALL, soft_start=0))).flat
    alone = [
        added(step_of(replace(SMALL, local_weight=local, global_weight=share, soft_start=0))).flat
        for local, share in ((0.1, 0.0), (0.0, 1.0))
    ]
    assert alone[0].any() and alone[1].any()
    assert (sum(alone) - both).norm() < 1e-10 * both.norm()


def test_where_nothing_is_seen_depth_adds_nothing_and_is_not_normalised(monkeypatch):
    monkeypatch.setattr("splat.training.methods.depth.normalised", None)
    step = step_of(DNGaussian(soft_start=0))
    step.gaussians.means[:, 2] = -3.0
    assert not added(step).flat.any()


def test_in_a_small_image_a_patch_is_as_large_as_the_image():
    wide = added(step_of(DNGaussian(soft_start=0, smallest_patch=16, largest_patch=17))).flat
    assert wide.any() and wide.isfinite().all()


def test_training_without_depth_maps_is_refused_before_it_begins():
    training = Training.start(tiny_gaussians(), EXTENT, TrainConfig(2, method=DNGaussian()))
    refused(r"for the method dngaussian, got none of 'view0' \(3 of 3 have none\)", next, train(training, tiny_views()))
    assert training.step == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"local_weight": 0.0, "global_weight": 0.0}, "local_weight or global_weight above 0"),
        ({"smallest_patch": 9, "largest_patch": 8}, "smallest_patch <= largest_patch"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(settings, message):
    refused(message, DNGaussian, **settings)
