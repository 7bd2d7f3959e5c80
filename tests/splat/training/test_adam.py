"""Adam over a flat vector, against torch's own."""

import torch

from splat.backend.cpu.adam import EPS
from splat.training.adam import Adam
from splat.training.state import LearningRates, learning_rates
from tests.splat.random_scenes import random_like
from tests.splat.tiny import tiny_gaussians


def test_one_flat_adam_is_torch_adam_with_a_rate_per_attribute_and_band():
    gaussians = tiny_gaussians(sh_degree=2, dtype=torch.float64)
    rates = LearningRates()
    attributes = {name: value.clone() for name, value in gaussians.attributes.items()}
    leaves = {
        "means": (attributes["means"], 3.7e-4),
        "log_scales": (attributes["log_scales"], 5e-3),
        "quats": (attributes["quats"], 1e-3),
        "opacity_logits": (attributes["opacity_logits"], 0.05),
        "sh_constant": (attributes["sh"][:, :1].clone(), 2.5e-3),
        "sh_higher": (attributes["sh"][:, 1:].clone(), 2.5e-3 / 20),
    }
    torch_adam = torch.optim.Adam([{"params": [leaf], "lr": rate} for leaf, rate in leaves.values()], eps=EPS)
    adam = Adam.zero(gaussians)
    for step in range(30):
        gradient = gaussians.with_flat(1e-6 * random_like(gaussians.flat.shape, step))
        adam.update(gaussians.flat, gradient.flat, learning_rates(gaussians, rates, 3.7e-4))
        each = gradient.attributes
        each["sh_constant"], each["sh_higher"] = each["sh"][:, :1], each["sh"][:, 1:]
        for name, (leaf, _) in leaves.items():
            leaf.grad = each[name].clone()
        torch_adam.step()
    leaves["sh"] = (torch.cat([leaves["sh_constant"][0], leaves["sh_higher"][0]], dim=1), 0.0)
    for name, value in gaussians.attributes.items():
        torch.testing.assert_close(value, leaves[name][0], rtol=1e-13, atol=1e-14)  # 30 steps of a few ulp


def test_moments_follow_their_gaussian_and_are_zero_for_new_ones():
    gaussians = tiny_gaussians(n=3, sh_degree=1)
    adam = Adam.zero(gaussians)
    adam.update(gaussians.flat, tiny_gaussians(3, 1, gaussians.sh_degree).flat, torch.ones_like(gaussians.flat))
    before = adam.first.attributes
    adam.select(torch.tensor([2, 0, 2]), torch.tensor([False, False, True]))
    for name, values in adam.first.attributes.items():
        assert torch.equal(values[:2], before[name][[2, 0]])
        assert not values[2].any()
    assert adam.second.quats[:2].all() and not adam.second.quats[2].any()


def test_bands_that_join_have_zero_moments_and_the_others_keep_theirs():
    gaussians = tiny_gaussians(n=3, sh_degree=0)
    adam = Adam.zero(gaussians)
    adam.update(gaussians.flat, tiny_gaussians(3, 1, gaussians.sh_degree).flat, torch.ones_like(gaussians.flat))
    before = adam.second.attributes
    adam.select(torch.arange(3), sh_degree=1)
    assert torch.equal(adam.second.sh[:, :1], before["sh"]) and not adam.second.sh[:, 1:].any()
    assert torch.equal(adam.second.means, before["means"])


def test_forgetting_an_attribute_leaves_the_others():
    gaussians = tiny_gaussians(n=3)
    adam = Adam.zero(gaussians)
    adam.update(gaussians.flat, torch.ones_like(gaussians.flat), torch.ones_like(gaussians.flat))
    adam.forget("opacity_logits")
    assert not adam.first.opacity_logits.any() and not adam.second.opacity_logits.any()
    assert adam.first.means.all() and adam.second.sh.all()


def test_moments_of_unseen_gaussians_never_become_subnormal_numbers():
    gaussians = tiny_gaussians(n=3)
    adam = Adam.zero(gaussians)
    zero, rates = torch.zeros_like(gaussians.flat), torch.zeros_like(gaussians.flat)
    adam.update(gaussians.flat, torch.full_like(zero, -1e-9), rates)
    smallest = torch.finfo(torch.float32).tiny
    for _ in range(700):  # 1e-10 * 0.9^700 lies below the smallest normal number
        adam.update(gaussians.flat, zero, rates)
        moments = adam.first.flat.abs()
        assert ((moments == 0) | (moments >= smallest)).all()
    assert moments.max() < 1e-33
