"""Points from the training views alone."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest
import torch

from splat.scenes.scene import load_scene
from splat.scenes.sfm.triangulation import triangulated_points
from splat.scenes.splits import split_scene
from splat.scenes.view import Frame, Points, View, pixel_coordinates
from tests.splat.scenes import textured

SHARP = 1.0  # px within which nearly all features lie


@pytest.fixture(scope="module")
def views() -> list[View]:
    return textured.views(3, off_centre=(3, -2))


@pytest.fixture(scope="module")
def points(views: list[View]) -> Points:
    return triangulated_points(frames(views))


def frames(views: Sequence[View]) -> list[Frame]:
    return [Frame(view.name, view.camera, lambda camera, view=view: view) for view in views]


def test_triangulated_points_lie_on_the_surface(points: Points) -> None:
    assert len(points) > 60
    x, _, z = points.xyz.unbind(-1)
    # what an error of a pixel in the disparity does to the depth: depth^2 / (focal length x baseline of neighbours)
    baseline = float((textured.cameras(3)[0].centre - textured.cameras(3)[1].centre).norm())
    depth_error = SHARP * textured.DISTANCE**2 / (textured.FOCAL * baseline)
    distance = (z - x.abs() / 2).abs()
    assert float((distance < depth_error).double().mean()) > 0.9


def test_triangulated_points_have_the_colour_of_their_pixels(points: Points, views: list[View]) -> None:
    assert points.names == tuple(view.name for view in views) and points.observations is not None
    assert set(points.sightings(views).tolist()) == {2, 3}  # two views are enough for a point
    for i, view in enumerate(views):
        seen = points.observations[points.observations[:, 1] == i, 0]
        pixel, depth = pixel_coordinates(view.camera, points.xyz[seen])
        assert bool((depth > 0).all()) and len(seen) > 30
        grid = (pixel / torch.tensor([textured.WIDTH, textured.HEIGHT]) * 2 - 1)[None, None].float()
        there = torch.nn.functional.grid_sample(view.image[None], grid, align_corners=False)[0, :, 0].T
        spread = (view.image - view.image.mean(dim=(1, 2), keepdim=True)).abs().mean()
        assert (there - points.rgb[seen]).abs().mean() < 0.3 * spread


def test_two_views_are_enough_to_triangulate_from(views: list[View]) -> None:
    assert len(triangulated_points(frames(views[:2]))) > 30


def test_the_same_photographs_give_the_same_points_however_they_are_reduced(points: Points, views: list[View]) -> None:
    size = (textured.WIDTH, textured.HEIGHT)
    quarter = [replace(f, camera=f.camera.resized(size[0] // 4, size[1] // 4), whole=size) for f in frames(views)]
    again = triangulated_points(quarter)
    assert torch.equal(again.xyz, points.xyz) and torch.equal(again.rgb, points.rgb)


def test_the_log_of_colmap_stays_as_it_was(views: list[View]) -> None:
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 1
    try:
        with pytest.raises(ValueError, match="none that match"):
            triangulated_points(frames([replace(view, image=torch.full_like(view.image, 0.5)) for view in views]))
        assert pycolmap.logging.minloglevel == 1
    finally:
        pycolmap.logging.minloglevel = before


def test_one_view_cannot_be_triangulated(views: list[View]) -> None:
    with pytest.raises(ValueError, match="at least 2 views to triangulate from, got 1"):
        triangulated_points(frames(views[:1]))


def test_fern_is_triangulated_from_three_views_without_the_others(fern: Path) -> None:
    scene = load_scene(fern, downscale=4)
    chosen = scene.load(split_scene(scene, 3).train)
    points, model = triangulated_points(frames(chosen)), scene.points
    assert model is not None and len(points) > 30
    # on the whole as far away as the points that all twenty photographs gave
    depth, known = (pixel_coordinates(chosen[1].camera, p.xyz)[1] for p in (points, model))
    low, high = known.quantile(torch.tensor([0.01, 0.99], dtype=torch.float64))
    assert float(((depth > low) & (depth < high)).double().mean()) > 0.9
