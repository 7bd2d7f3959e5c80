"""Dense points from the training views alone."""

from dataclasses import replace

import pytest
import torch

from splat.scenes.sfm.plane_sweep import STRIDE, dense_points
from splat.scenes.view import Points, View
from tests.splat.scenes import textured

NEAR = [1.5] * 3
PIXEL = textured.DISTANCE / textured.FOCAL  # what a pixel covers


@pytest.fixture(scope="module")
def views() -> list[View]:
    return textured.views(3, off_centre=(3, -2))


@pytest.fixture(scope="module")
def points(views: list[View]) -> Points:
    return dense_points(views, NEAR)


def test_dense_points_cover_the_surface_and_lie_on_it(points: Points, views: list[View]) -> None:
    x, _, z = points.xyz.unbind(-1)
    distance = (z - x.abs() / 2).abs()
    assert distance.quantile(0.9) < PIXEL and distance.quantile(0.99) < 4 * PIXEL
    one_view = textured.WIDTH * textured.HEIGHT / STRIDE**2
    assert 0.9 * one_view < len(points) < 1.6 * one_view  # once what all see, and what two see beside it


def test_dense_points_know_who_sees_them_and_have_its_colour(points: Points, views: list[View]) -> None:
    assert points.names == tuple(view.name for view in views)
    assert points.sightings(views).unique().tolist() == [2, 3]
    colours = torch.from_numpy(textured.texture())
    y, x = (points.xyz[:, 1] * textured.TEXELS).long(), (points.xyz[:, 0] * textured.TEXELS).long()
    there = colours[:, y % colours.shape[1], x % colours.shape[2]].T
    spread = (there - there.mean(dim=0)).abs().mean()
    assert (there - points.rgb).abs().mean() < 0.4 * spread


def test_what_is_transparent_gives_no_point(views: list[View]) -> None:
    alpha = (torch.arange(textured.WIDTH) < textured.WIDTH // 2).float().expand(textured.HEIGHT, -1)
    points = dense_points([replace(view, alpha=alpha) for view in views], NEAR)
    assert len(points) > 100 and points.xyz[:, 0].quantile(0.95) < 0.1


def test_pictures_that_do_not_match_or_one_alone_give_a_sentence(views: list[View]) -> None:
    for wrong, message in (
        ([replace(view, image=torch.full_like(view.image, 0.5)) for view in views], "none that match"),
        (views[:1], "at least 2 views for dense points, got 1"),
    ):
        with pytest.raises(ValueError, match=message):
            dense_points(wrong, NEAR)
