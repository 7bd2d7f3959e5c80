"""Scores of views."""

import pytest
import torch

from splat.evaluate import evaluate
from splat.losses import psnr, ssim
from splat.render import render
from tests.splat.tiny import tiny_gaussians, tiny_views


def test_scores_are_those_of_each_render_and_their_means():
    gaussians, views = tiny_gaussians(), tiny_views()
    background = torch.tensor([0.1, 0.2, 0.3])
    seen = {}
    result = evaluate(gaussians, views, background, on_image=seen.__setitem__)
    for view, score in zip(views, result.views, strict=True):
        image = render(gaussians, view.camera, background).image
        assert score.name == view.name and torch.equal(seen[view.name], image)
        assert (score.psnr, score.ssim) == (psnr(image, view.image), ssim(image, view.image))
    assert result.psnr == pytest.approx(sum(score.psnr for score in result.views) / 3, rel=1e-14)
    assert result.ssim == pytest.approx(sum(score.ssim for score in result.views) / 3, rel=1e-14)


def test_without_views_there_is_no_score():
    with pytest.raises(ValueError, match="at least one view"):
        evaluate(tiny_gaussians(), [])
