"""Scores of views."""

from dataclasses import replace
from math import log10

import pytest
import torch
from torch import Tensor

from splat.losses.reference import psnr, ssim
from splat.render.render import render
from splat.scenes.view import View
from splat.training.score.evaluate import evaluate, have_masks, score
from tests.oracles import similarity_by_windows
from tests.refusals import refused
from tests.splat.tiny import tiny_gaussians, tiny_views


def test_scores_are_those_of_each_render_and_their_means():
    gaussians, views = tiny_gaussians(), tiny_views()
    background = torch.tensor([0.1, 0.2, 0.3])
    seen = {}
    result = evaluate(gaussians, views, background, on_image=seen.__setitem__)
    for view, its in zip(views, result.views, strict=True):
        image = render(gaussians, view.camera, background).image
        assert its.name == view.name and torch.equal(seen[view.name], image)
        assert (its.psnr, its.ssim) == (psnr(image, view.image), ssim(image, view.image))
    assert result.psnr == pytest.approx(sum(view.psnr for view in result.views) / 3, rel=1e-14)
    assert result.ssim == pytest.approx(sum(view.ssim for view in result.views) / 3, rel=1e-14)


def test_without_views_there_is_no_score():
    refused("at least one view", evaluate, tiny_gaussians(), [], error=ValueError)


def masked_view() -> View:
    view = tiny_views()[0]
    mask = torch.zeros(view.image.shape[1:], dtype=torch.bool)
    mask[3:9, 4:13] = True
    return replace(view, mask=mask)


def test_inside_a_mask_psnr_is_of_its_pixels_and_ssim_of_white_outside():
    view, image = masked_view(), torch.rand(3, 14, 20, generator=torch.Generator().manual_seed(2)) * 1.4 - 0.2
    assert view.mask is not None
    inside = [(c, i, j) for c in range(3) for i, j in view.mask.nonzero()]
    errors = [float((image[at].clamp(0, 1) - view.image[at]) ** 2) for at in inside]
    result = score(image, view)
    assert result.psnr == pytest.approx(-10 * log10(sum(errors) / len(errors)), rel=1e-6)
    white = [p.clamp(0, 1) * view.mask + ~view.mask for p in (image, view.image)]
    assert result.ssim == pytest.approx(similarity_by_windows(*(p.double().numpy() for p in white)).mean(), rel=1e-5)


def test_nothing_outside_a_mask_counts():
    view, image = masked_view(), torch.rand(3, 14, 20)
    assert view.mask is not None

    def mean(image: Tensor, target: Tensor) -> float:
        return float((image + 2 * target).mean())

    changed = torch.where(view.mask, image, torch.rand(3, 14, 20))
    other = replace(view, image=torch.where(view.mask, view.image, torch.rand(3, 14, 20)))
    assert score(image, view, mean) == score(changed, other, mean)
    inside = torch.where(view.mask, torch.rand(3, 14, 20), image)
    different = score(inside, view, mean)
    before = score(image, view, mean)
    assert different.psnr != before.psnr and different.ssim != before.ssim and different.lpips != before.lpips


def test_views_that_are_scored_together_have_all_masks_or_none():
    views = tiny_views()
    masked = [masked_view(), *views[1:]]
    refused("got 1, and none for view1", evaluate, tiny_gaussians(), masked)
    assert not have_masks(views) and have_masks(masked[:1]) and not have_masks([])
    assert evaluate(tiny_gaussians(), masked[:1]).masked and not evaluate(tiny_gaussians(), views).masked


def test_without_lpips_for_every_view_there_is_no_mean():
    views, values = tiny_views(), iter([0.5, None, 0.25, 0.5, 0.5, 0.125])
    first, second = (evaluate(tiny_gaussians(), views, lpips=lambda *_: next(values)) for _ in range(2))
    assert first.lpips is None and [view.lpips for view in first.views] == [0.5, None, 0.25]
    assert second.lpips == 0.375
    assert first.avge is None and first.views[1].avge is None and first.views[0].avge is not None
    of_each = [(10 ** (-v.psnr / 10) * (1 - v.ssim) ** 0.5 * (v.lpips or 0.0)) ** (1 / 3) for v in second.views]
    assert [view.avge for view in second.views] == pytest.approx(of_each)
    assert second.avge == pytest.approx(sum(of_each) / 3)  # the mean over the views, not of their means
    assert evaluate(tiny_gaussians(), views).lpips is None
